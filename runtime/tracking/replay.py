"""The frames of a recorded run in place of a tracker, for rehearsals."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from modsoft.runtime.errors import DeviceAbsent
from modsoft.runtime.files import read_text
from modsoft.runtime.tracking.frame import TrackerFrame

LONGEST_GAP_NS = 3600 * 10**9  # between two frames of one run

Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Number = Annotated[float, Meta(ge=-1e6, le=1e6)]  # mm, or no unit; null for a tool that was not seen


class RecordedFrame(msgspec.Struct, frozen=True):
    """A frame as run.jsonl has it; other keys are left alone."""

    number: Count
    mono_ns: Count
    poses: list[list[list[Number | None]]]  # (N + 1, 4, 4)
    valid: list[bool]  # (N + 1,)
    quality: list[Number | None]  # (N + 1,)


class RecordedLine(msgspec.Struct, frozen=True):
    """A line of run.jsonl."""

    frame: RecordedFrame | None = None


class Replay:
    """The frames of a recorded run (`run.jsonl`, or its folder), at the pace of the record. `DeviceAbsent` in one line
    for a file that is none, or of a robot with other than `tools` tools."""

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
        except DeviceAbsent as error:
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
        return TrackerFrame(frame.device_frame, due_s, frame.poses, frame.valid, frame.quality)

    def close(self) -> None:
        self._frames = []
        self._next = 0


def recorded(path: Path, tools: int) -> Iterator[TrackerFrame]:
    """The frames of a run's log, each for `tools` tools; at least one. `DeviceAbsent` says which line is wrong."""
    if path.exists() and not path.is_file():
        raise DeviceAbsent(f"{path} is a device or pipe, expected the log of a run")
    lines = read_text(path, DeviceAbsent).split("\n")
    decode = msgspec.json.Decoder(RecordedLine).decode
    before: int | None = None
    for number, line in enumerate(lines, start=1):
        if not line.strip() or _is_torn(line, number == len(lines)):
            continue
        try:
            found = decode(line).frame
            if found is None:
                continue
            yield _frame(found, tools)
            if before is not None and not 0 <= found.mono_ns - before <= LONGEST_GAP_NS:
                raise ValueError(f"mono_ns goes from {before} to {found.mono_ns}, expected the next frame of one run")
            before = found.mono_ns
        except (msgspec.MsgspecError, ValueError, RecursionError) as error:
            raise DeviceAbsent(f"{path}, line {number}: not a line of a run's log ({error})") from error
    if before is None:
        raise DeviceAbsent(f"no frame in {path}")


def _is_torn(line: str, is_last: bool) -> bool:
    """Whether the writing of a line was cut: by a kill at the end of a log, by a full disk within it."""
    if not line.startswith("{") or (line.endswith("}") and not is_last):
        return False
    try:
        msgspec.json.decode(line)
    except msgspec.DecodeError:
        return True
    except RecursionError:
        pass
    return False


def _frame(found: RecordedFrame, tools: int) -> TrackerFrame:
    """ValueError where its arrays do not fit `tools` tools."""
    for name in ("poses", "valid", "quality"):
        if (count := len(getattr(found, name))) != tools:
            raise ValueError(f"{name} of {count} tools, expected {tools}: the base and {tools - 1} modules")
    if any([len(pose), *map(len, pose)] != [4] * 5 for pose in found.poses):
        raise ValueError("poses that are not all 4 x 4")
    poses, quality = (np.array(rows, dtype=np.float64) for rows in (found.poses, found.quality))  # null becomes NaN
    return TrackerFrame(found.number, found.mono_ns * 1e-9, poses, np.array(found.valid, dtype=bool), quality)
