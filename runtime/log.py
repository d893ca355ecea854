"""The run log: `runs/<utc>-<name>/` with `run.jsonl`, `meta.json` and the robot file that was used.

`run.jsonl` has one JSON object a line, written and flushed by a thread of its own as soon as it is handed over, so
that the loop never waits for a disk and a killed process loses nothing. A tick:

    tick                  control step k, from 0
    mono_ns, due_ns       CLOCK_MONOTONIC when it began, and when it was due
    wall                  UTC, ISO 8601
    late_ms, missed       lateness; control steps that were skipped just before this one
    sent                  whether set-points went out (false: the step took more than half a period, or ended the run)
    verdict               "good", or why the frame was not used; then the command before was held
    frame                 null, or number (the device's), mono_ns (before it was asked), age_ms, poses (N + 1, 4, 4) in
                          mm, valid (N + 1), quality (N + 1)
    configuration         (N, 3) measured at the start of this step, [v_x, v_y, v_z]; null without a good frame
    desired               (N, 3) what is desired at the start of this step
    aim                   (N, 3) what the model is asked for: what is desired at the start of the next step, shifted by
                          the correction; null without a good frame
    raw                   (N, A) the model's answer; null without a good frame
    actuation             (N, A) after every limit: what was sent
    commanded_bar         (channels) set-points that were sent
    board                 the board's last word when the step began: state, faults, tick (control step + 1), applied_bar
                          and measured_bar (channels; null where there is no sensor), age_ms
    acknowledged          the set-points before these: {"tick", "ms"}, ms null if the board never acknowledged them
    link                  counts since the port was opened

Other lines have "event" in place of "tick": "start" (mono_ns, commanded_bar: actuation 0, one period before step 0),
"done" (mono_ns, acknowledged: one period after the last step), "end" (mono_ns when venting began, exit_code, reason,
vented: whether the board said so, vented_ns: when), "warm-up failed" (reason: the error that ended the warm-up of the
caches; the control steps go on). What is not a number is null.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import platform
import queue
import threading
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from modsoft.runtime.errors import ModelError, UsageError
from modsoft.runtime.files import decoded

Line = dict[str, Any]

QUEUE_LINES = 256  # 100 s of the loop; beyond it lines are dropped and counted, since control goes before its record
CLOSE_WAIT_S = 2.0


def plain(value: Any) -> Any:
    """Arrays, numpy scalars and NaN as what JSON knows: lists, numbers (nine decimals are enough for all), null."""
    if isinstance(value, dict):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, float):
        return round(value, 9) if math.isfinite(value) else None
    return value


class Writer:
    """Lines to a file, by a thread. An error of the disk is kept in `error` and its lines are counted in `lost`."""

    def __init__(self, path: Path, write: Callable[[int, bytes], int] = os.write):
        self.lost = 0
        self.error: str | None = None
        self._handed = self._done = 0  # lines taken, and lines that the disk took or refused
        self._write = write
        binary = getattr(os, "O_BINARY", 0)  # Windows would make two bytes of each line's end
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | binary, 0o644)
        self._torn = False  # the file ends in the middle of a line
        self._queue: queue.Queue[Line | None] = queue.Queue(QUEUE_LINES)
        self._thread = threading.Thread(target=self._run, name="log", daemon=True)
        self._thread.start()

    def put(self, line: Line) -> None:
        """Hands a line over; never waits. The line may not be changed any more."""
        try:
            self._queue.put_nowait(line)
            self._handed += 1
        except queue.Full:
            self.lost += 1

    def close(self) -> None:
        """Writes what is left. A disk that hangs is not waited for longer than four seconds; what it still owes by then
        counts as lost."""
        with contextlib.suppress(queue.Full):
            self._queue.put(None, timeout=CLOSE_WAIT_S)
            self._thread.join(CLOSE_WAIT_S)
        self.lost += self._handed - self._done  # by a disk that hangs, or by a thread that a bug ended

    def _run(self) -> None:
        while (line := self._queue.get()) is not None:
            self._out(json.dumps(plain(line), separators=(",", ":"), allow_nan=False).encode() + b"\n")
            self._done += 1
        os.close(self._file)

    def _out(self, data: bytes) -> None:
        if self._torn:
            data = b"\n" + data
        left = data
        try:
            while left:
                left = left[self._write(self._file, left) :]
            self._torn = False
        except OSError as error:
            self._torn = self._torn or len(left) < len(data)
            self.lost += 1
            self.error = error.strerror or str(error)


class RunLog:
    """The folder of one run. `put` a line at any time; `close` says how it ended."""

    def __init__(self, runs: Path, name: str, robot_text: str, meta: Line, now: datetime | None = None):
        """`runs`: where the folder is made; `name`: of the robot; `robot_text`: the robot file; `meta`: robot, model,
        task and so on. Raises `UsageError` where nothing can be written."""
        now = now or datetime.now(UTC)
        try:
            self.folder = _new_folder(runs, f"{now:%Y%m%dT%H%M%SZ}-{name}")
            (self.folder / "robot.toml").write_text(robot_text, encoding="utf-8")
            self._meta = {"started": now.isoformat(), **meta, "versions": versions(), "host": host()}
            self._write_meta({"exit_code": None, "reason": None})
            self._writer = Writer(self.folder / "run.jsonl")
        except OSError as error:
            raise UsageError(
                f"no run log can be written in {runs} ({error}); give another folder: --runs-dir"
            ) from error

    @property
    def trouble(self) -> str | None:
        """What is wrong with the log, in words, or None."""
        if not self._writer.lost:
            return None
        return f"{self._writer.lost} log lines lost ({self._writer.error or 'the disk is too slow'})"

    def put(self, line: Line) -> None:
        self._writer.put(line)

    def close(self, exit_code: int, reason: str, more: Line) -> None:
        """Ends the log; never raises, since a run that has ended must not fail for its record."""
        self._writer.close()
        ended = {"ended": datetime.now(UTC).isoformat(), "exit_code": exit_code, "reason": reason}
        try:
            self._write_meta({**ended, "lines_lost": self._writer.lost, "log_error": self._writer.error, **more})
        except OSError as error:
            self._writer.lost += 1
            self._writer.error = error.strerror or str(error)

    def _write_meta(self, end: Line) -> None:
        """Whole or not at all: a full disk leaves no half beside the meta.json before."""
        made = self.folder / "meta.json.new"
        text = json.dumps(plain({**self._meta, **end}), indent=1, allow_nan=False)
        try:
            made.write_text(text + "\n", encoding="utf-8")
            made.replace(self.folder / "meta.json")
        except OSError:
            with contextlib.suppress(OSError):
                made.unlink(missing_ok=True)
            raise


def _new_folder(runs: Path, name: str) -> Path:
    """Makes a folder that did not exist: two runs may start in the same second."""
    Path(os.path.realpath(runs)).mkdir(parents=True, exist_ok=True)  # also where a link's target is missing
    for folder in (runs / name, *(runs / f"{name}-{again}" for again in range(2, 100))):
        try:
            folder.mkdir()
        except FileExistsError:
            continue
        return folder
    raise FileExistsError(f"{runs / name} and 98 more exist")


def versions() -> dict[str, str]:
    """What ran: Python and the packages that decide the numbers."""
    from importlib.metadata import PackageNotFoundError, version

    found = {"python": platform.python_version()}
    for package in ("modsoft", "numpy", "onnxruntime", "pyserial"):
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "unknown"
    return found


def host() -> dict[str, str | int | None]:
    """Where it ran."""
    return {"name": platform.node(), "system": platform.platform(), "cores": os.cpu_count()}


class Run(NamedTuple):
    """A run as it was logged. `ticks`: the lines of the control steps; each "acknowledged" is here that of its own
    set-points, {"ms"} or null where it was never told."""

    meta: Line
    ticks: list[Line]
    events: list[Line]


def read(folder: Path) -> Run:
    """Reads a run's folder; the last line of a killed run may be torn and is left out. Raises `ModelError`."""
    decode = msgspec.json.Decoder(Line).decode
    lines = []
    try:
        meta = decode(decoded((folder / "meta.json").read_bytes()))
        for text in decoded((folder / "run.jsonl").read_bytes()).split("\n"):
            try:
                lines.append(decode(text))
            except msgspec.DecodeError:
                continue
    except (OSError, ValueError, RecursionError) as error:
        raise ModelError(f"{folder} is no folder of a run ({error})") from error
    told = [line["acknowledged"] for line in lines if line.get("acknowledged")]
    try:
        acknowledged = {entry["tick"]: entry["ms"] for entry in told}
        ticks = [{**line, "acknowledged": {"ms": acknowledged.get(line["tick"])}} for line in lines if "tick" in line]
    except (KeyError, TypeError) as error:
        raise ModelError(f"{folder}: run.jsonl is not the log of a run ({error!r})") from error
    return Run(meta, ticks, [line for line in lines if "event" in line])
