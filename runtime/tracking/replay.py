"""The frames of a recorded run in place of a tracker, for rehearsals."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from modsoft.runtime.errors import DeviceAbsent, ModelError
from modsoft.runtime.log_reader import read_records
from modsoft.runtime.log_record import FrameRecord, TickRecord
from modsoft.runtime.tracking.frame import TrackerFrame

LONGEST_GAP_NS = 3600 * 10**9  # between two frames of one run
LARGEST_NUMBER = 1e6  # mm, or without a unit


class Replay:
    """The frames of a recorded run (`run.jsonl`, or its folder), at the pace of the record. `DeviceAbsent` in one line
    for a file that is none, or of a robot with other than `tools` tools."""

    device = "recorded run"

    def __init__(
        self,
        path: Path,
        tools: int,
        now: Callable[[], float] = time.monotonic,
        wait: Callable[[float], object] = time.sleep,
    ):
        self._now, self._wait = now, wait
        path = path / "run.jsonl" if path.is_dir() else path
        try:
            self._frames = list(recorded(path, tools))
        except ModelError as error:
            raise DeviceAbsent(f"tracker source replay: {error}; give the folder of a run of this robot") from error
        self._start_s = now()
        self._next = 0

    def read(self) -> TrackerFrame | None:
        if self._next == len(self._frames):
            self._wait(0.05)
            return None
        frame = self._frames[self._next]
        due_s = self._start_s + frame.monotonic_s - self._frames[0].monotonic_s
        if due_s > self._now():
            self._wait(min(due_s - self._now(), 0.05))
            return None
        self._next += 1
        return replace(frame, monotonic_s=due_s)

    def close(self) -> None:
        self._frames = []
        self._next = 0


def recorded(path: Path, tools: int) -> Iterator[TrackerFrame]:
    """The frames of a run's log, each for `tools` tools; at least one. Raises `ModelError` with the wrong line."""
    before_ns: int | None = None
    for number, record in read_records(path):
        if not isinstance(record, TickRecord) or record.frame is None:
            continue
        frame = record.frame
        try:
            yield _frame(frame, tools)
            if before_ns is not None and not 0 <= frame.mono_ns - before_ns <= LONGEST_GAP_NS:
                raise ValueError(f"mono_ns from {before_ns} to {frame.mono_ns}, expected the next frame of one run")
        except ValueError as error:
            raise ModelError(f"{path}, line {number}: not a line of a run's log ({error})") from error
        before_ns = frame.mono_ns
    if before_ns is None:
        raise ModelError(f"no frame in {path}")


def _frame(recorded: FrameRecord, tools: int) -> TrackerFrame:
    """Raises ValueError where the arrays do not fit `tools` tools."""
    for name in ("poses", "valid", "quality"):
        values = getattr(recorded, name)
        if (count := len(values)) != tools:
            raise ValueError(f"{name} of {count} tools, expected {tools}: the base and {tools - 1} modules")
        if (np.abs(values) > LARGEST_NUMBER).any():
            raise ValueError(f"{name} beyond {LARGEST_NUMBER:g}")
        if values.shape[1:] != ((4, 4) if name == "poses" else ()):
            raise ValueError(f"{name} of shape {values.shape}, expected {tools} poses of 4 x 4 with one value a tool")
    if recorded.port_status is not None and len(recorded.port_status) != tools:
        raise ValueError(f"port_status of {len(recorded.port_status)} tools, expected {tools}")
    return TrackerFrame(
        recorded.number,
        recorded.mono_ns * 1e-9,
        recorded.poses,
        recorded.valid,
        recorded.quality,
        port_status=recorded.port_status,
    )
