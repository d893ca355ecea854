"""Writes the run log: `runs/<utc>-<name>/` with `run.jsonl`, `meta.json`, and the robot file and the calibration that
were used.

`run.jsonl` has one record a line (`log_record.py` documents every field). A thread of its own writes and flushes each
record at once, so that the loop never waits for a disk and a killed process loses nothing.
"""

from __future__ import annotations

import contextlib
import os
import platform
import queue
import threading
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec

from modsoft.runtime.errors import OutputError
from modsoft.runtime.log_record import SCHEMA, HeaderRecord, Record, encode

QUEUE_LINES = 256  # 100 s of the loop; beyond it records are dropped and counted: control has priority
CLOSE_WAIT_S = 2.0


class Writer:
    """Writes records to a file, in a thread. `error` keeps the last error of the disk, `lost` counts the records that
    were not written."""

    def __init__(self, path: Path, write: Callable[[int, bytes], int] = os.write):
        self.lost = 0
        self.error: str | None = None
        self._queued = self._done = 0  # records taken, and records that the disk took or refused
        self._write = write
        binary = getattr(os, "O_BINARY", 0)  # Windows would write two bytes for each end of a line
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | binary, 0o644)
        self._torn = False  # the file ends in the middle of a line
        self._queue: queue.Queue[Record | None] = queue.Queue(QUEUE_LINES)
        self._thread = threading.Thread(target=self._run, name="log", daemon=True)
        self._thread.start()

    def put(self, record: Record) -> None:
        """Queues a record; never waits. The record must not change after this call."""
        try:
            self._queue.put_nowait(record)
            self._queued += 1
        except queue.Full:
            self.lost += 1

    def close(self) -> None:
        """Writes what is left. Waits at most four seconds for a disk that hangs; records that are not written by then
        count as lost."""
        with contextlib.suppress(queue.Full):
            self._queue.put(None, timeout=CLOSE_WAIT_S)
            self._thread.join(CLOSE_WAIT_S)
        self.lost += self._queued - self._done  # by a disk that hangs, or by a thread that a bug ended

    def _run(self) -> None:
        while (record := self._queue.get()) is not None:
            self._write_line(encode(record) + b"\n")
            self._done += 1
        os.close(self._file)

    def _write_line(self, data: bytes) -> None:
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
    """The log of one run. `put` adds a record at any time, `close` the outcome.

    meta.json holds what the caller passes (the session: command, robot, task, steps, correction, model, board, port,
    calibration), and `schema`, `started` and `ended` (UTC), `versions`, `host`, `exit_code` and `reason` (null while
    the run lasts), `lines_lost`, `log_error`, `figures` (of `TickStatistics`), `tracker` and `connection` (counts),
    `vented`.
    """

    def __init__(
        self,
        runs: Path,
        name: str,
        robot_text: str,
        meta: dict[str, Any],
        now: datetime | None = None,
        calibration: str | None = None,
    ):
        """`runs`: where the folder is made; `name`: of the robot; `robot_text`: the robot file; `meta`: robot, model,
        task and so on; `calibration`: text of the calibration file in use. Raises `OutputError` where nothing can be
        written."""
        now = now or datetime.now(UTC)
        try:
            self.folder = _new_folder(runs, f"{now:%Y%m%dT%H%M%SZ}-{name}")
            (self.folder / "robot.toml").write_text(robot_text, encoding="utf-8")
            if calibration is not None:
                (self.folder / "calibration.toml").write_text(calibration, encoding="utf-8")
            self._meta = {"schema": SCHEMA, "started": now.isoformat(), **meta, "versions": versions(), "host": host()}
            self._write_meta({"exit_code": None, "reason": None})
            self._writer = Writer(self.folder / "run.jsonl")
        except OSError as error:
            raise OutputError(
                f"no run log can be written in {runs} ({error.strerror or error}); give another folder: --runs-dir"
            ) from error
        self.put(HeaderRecord(SCHEMA))

    @property
    def trouble(self) -> str | None:
        """What is wrong with the log, in words, or None."""
        if not self._writer.lost:
            return None
        return f"{self._writer.lost} log lines lost ({self._writer.error or 'the disk is too slow'})"

    def put(self, record: Record) -> None:
        self._writer.put(record)

    def close(self, exit_code: int, reason: str, more: dict[str, Any]) -> None:
        """Ends the log. Never raises: a run that has ended must not fail because of its log."""
        self._writer.close()
        ended = {"ended": datetime.now(UTC).isoformat(), "exit_code": exit_code, "reason": reason}
        try:
            self._write_meta({**ended, "lines_lost": self._writer.lost, "log_error": self._writer.error, **more})
        except OSError as error:
            self._writer.lost += 1
            self._writer.error = error.strerror or str(error)

    def _write_meta(self, end: dict[str, Any]) -> None:
        """Whole or not at all: a full disk leaves the meta.json before."""
        temporary = self.folder / "meta.json.new"
        text = msgspec.json.format(encode({**self._meta, **end}), indent=1).decode()
        try:
            temporary.write_text(text + "\n", encoding="utf-8")
            temporary.replace(self.folder / "meta.json")
        except OSError:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise


def _new_folder(runs: Path, name: str) -> Path:
    """Creates a folder that did not exist: two runs may start in the same second."""
    Path(os.path.realpath(runs)).mkdir(parents=True, exist_ok=True)  # also where a link's target is missing
    for folder in (runs / name, *(runs / f"{name}-{number}" for number in range(2, 100))):
        try:
            folder.mkdir()
        except FileExistsError:
            continue
        return folder
    raise FileExistsError(f"{runs / name} and 98 more exist")


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that determine the numbers."""
    from importlib.metadata import PackageNotFoundError, version

    names = {"python": platform.python_version()}
    for package in ("modsoft", "numpy", "onnxruntime", "pyserial"):
        try:
            names[package] = version(package)
        except PackageNotFoundError:
            names[package] = "unknown"
    return names


def host() -> dict[str, str | int | None]:
    """The computer of the run."""
    return {"name": platform.node(), "system": platform.platform(), "cores": os.cpu_count()}
