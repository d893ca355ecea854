"""The folder of a report. The rig writes only to a folder that is new, empty or marked as its own, so that it never
replaces or deletes a file that it did not write."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path

from modsoft.runtime.errors import OutputError, UsageError
from modsoft.runtime.files import make_folder
from modsoft.runtime.locks import locked

FINISHED = "report.json"  # written last: where it exists, the other files are complete
MARKER = ".modsoft-hil"
MARKER_TEXT = "modsoft-hil wrote the report in this folder and may replace it.\n"
RUN_FILES = ("run.jsonl", "meta.json")  # the runtime's log
CALIBRATION = "calibration.toml"  # of the fake tracker's tools
CALIBRATION_FILES = (CALIBRATION, "calibration.png", "calibration.out")
TRACES = (*RUN_FILES, *CALIBRATION_FILES, "board.jsonl", "plant.jsonl", "runtime.out", "runtime.err")
WRITTEN = (*TRACES, "report.md", FINISHED, "angles.png")
LOG_PREFIX = "runtime-log-"  # of the folder that the runtime logs to while it runs


def check(folder: Path) -> None:
    """`UsageError` where `folder` holds a finished report, or files while the rig did not mark it as its own;
    `OutputError` where it cannot be read."""
    try:
        names = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
        own = MARKER in names and (folder / MARKER).read_text(encoding="utf-8", errors="replace") == MARKER_TEXT
    except OSError as error:
        raise OutputError(f"{folder}: cannot be read ({error.strerror}); choose another --report") from error
    if FINISHED in names:
        raise UsageError(f"{folder}: holds the report of a run already; give another --report, or delete it")
    if names and not own:
        raise UsageError(
            f"{folder}: holds files that modsoft-hil did not write (such as {min(names)}); "
            "give a new or empty folder as --report"
        )


@contextlib.contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Checks, makes and marks `folder`, deletes what an interrupted run of the rig left in it, and keeps other runs of
    the rig out (`InUse`) for as long as the context lasts."""
    check(folder)
    make_folder(folder)
    try:
        (folder / MARKER).write_text(MARKER_TEXT, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{folder}: cannot be written ({error.strerror}); choose another --report") from error
    with locked(folder / f"{MARKER}.lock", folder, "modsoft-hil"):
        try:
            _clear(folder)
        except OSError as error:
            raise OutputError(f"{folder}: cannot be cleared ({error.strerror}); choose another --report") from error
        yield


def drop_report(folder: Path) -> None:
    """Deletes a finished report, so that the rig may write its next one; `UsageError` where it is not the rig's."""
    if (folder / FINISHED).exists() and (folder / MARKER).is_file():
        (folder / FINISHED).unlink()
    check(folder)


def _clear(folder: Path) -> None:
    for name in WRITTEN:
        (folder / name).unlink(missing_ok=True)
    for log in folder.glob(f"{LOG_PREFIX}*"):
        shutil.rmtree(log, ignore_errors=True)
