"""Reads run logs: whole ones, those of older releases, and those that are still being written."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from modsoft.runtime.errors import ModelError
from modsoft.runtime.files import decoded, read_text
from modsoft.runtime.log_record import (
    SCHEMA,
    EndRecord,
    HeaderRecord,
    Record,
    StartRecord,
    TickRecord,
    decode,
)

# Schema 1: keys that have other names now, and the values of keys that such a log may lack.
_RENAMED = {"verdict": "frame_status", "detail": "frame_detail", "aim": "reference", "link": "connection"}
_RENAMED |= {"still_bar": "residual_bar"}
_NOT_ACKNOWLEDGED = {"tick": -1, "ms": None}
_ABSENT: dict[str, dict[str, Any]] = {
    "tick": {
        **{"tick": -1, "mono_ns": 0, "due_ns": 0, "wall": "", "late_ms": 0.0, "missed": 0},
        **{"frame_status": "", "frame_detail": "", "frame": None, "configuration": None, "desired": []},
        **{"board": None, "acknowledged": _NOT_ACKNOWLEDGED, "connection": {}, "actuation": []},
    },
    "start": {"mono_ns": 0, "commanded_bar": []},
    "done": {"mono_ns": 0, "acknowledged": _NOT_ACKNOWLEDGED},
    "end": {"residual_bar": {}},
}


class Run(NamedTuple):
    """A run as it was logged."""

    meta: dict[str, Any]  # see `log.RunLog`
    ticks: list[TickRecord]
    events: list[Record]  # the other records

    @property
    def start(self) -> StartRecord | None:
        return next((event for event in self.events if isinstance(event, StartRecord)), None)

    @property
    def end(self) -> EndRecord | None:
        """None for a run that was killed."""
        return next((event for event in self.events if isinstance(event, EndRecord)), None)

    @property
    def acknowledged_ms(self) -> dict[int, float | None]:
        """By control step, how long the board took to acknowledge its set-points; None where it did not."""
        return {
            record.acknowledged.tick: record.acknowledged.ms
            for record in (*self.ticks, *self.events)
            if hasattr(record, "acknowledged")
        }


def read(folder: Path) -> Run:
    """Reads a run's folder. Raises `ModelError`."""
    try:
        meta = msgspec.json.decode(decoded((folder / "meta.json").read_bytes()), type=dict[str, Any])
    except (OSError, ValueError, RecursionError) as error:
        raise ModelError(f"{folder} is not the folder of a run: meta.json: {error}") from error
    records = [record for _, record in read_records(folder / "run.jsonl")]
    ticks = [record for record in records if isinstance(record, TickRecord)]
    return Run(meta, ticks, [record for record in records if not isinstance(record, TickRecord)])


def read_records(path: Path) -> Iterator[tuple[int, Record]]:
    """The records of a `run.jsonl` with their line numbers, from 1. Lines that a kill or a full disk cut are left out.
    Raises `ModelError` with the line that is no record, and for a log of a newer schema."""
    if path.exists() and not path.is_file():
        what = "a folder" if path.is_dir() else "a device or pipe"
        raise ModelError(f"{path}: found {what}, expected the log of a run")
    lines = read_text(path).split("\n")
    decoder = _Decoder(path)
    for number, line in enumerate(lines, start=1):
        record = decoder.record(line, is_last=number == len(lines))
        if record is not None:
            yield number, record


class Follower:
    """The ticks of a log that is still being written. `count`: of the ticks so far; `last`: the newest one."""

    def __init__(self, path: Path):
        self.path = path
        self.count = 0
        self.last: TickRecord | None = None
        self._offset = 0  # of the first byte that is not yet read
        self._rest = b""  # the beginning of a line whose end is not yet written
        self._decoder = _Decoder(path)

    def new(self) -> list[TickRecord]:
        """The ticks that were completed since the last call."""
        with self.path.open("rb") as file:
            file.seek(self._offset)
            data = file.read()
        self._offset += len(data)
        *lines, self._rest = (self._rest + data).split(b"\n")
        records = [self._decoder.record(line.decode("utf-8", "replace")) for line in lines]
        ticks = [record for record in records if isinstance(record, TickRecord)]
        self.count += len(ticks)
        self.last = ticks[-1] if ticks else self.last
        return ticks


class _Decoder:
    """Decodes the lines of one log in their order."""

    def __init__(self, path: Path):
        self._path = path
        self._schema = 1  # until a header is read
        self._number = 0

    def record(self, line: str, is_last: bool = False) -> Record | None:
        """The record of the next line; None for an empty or torn one. Raises `ModelError`."""
        self._number += 1
        if not line.strip() or _is_torn(line, is_last):
            return None
        try:
            entries = msgspec.json.decode(line, type=dict[str, Any])
            if self._schema == 1:
                _upgrade(entries)
            record = decode(entries)
        except (msgspec.MsgspecError, ValueError, RecursionError) as error:
            raise ModelError(f"{self._path}, line {self._number}: not a line of a run's log ({error})") from error
        if isinstance(record, HeaderRecord):
            if not 1 <= record.schema <= SCHEMA:
                raise ModelError(
                    f"{self._path}: found a run log of schema {record.schema}, expected 1 to {SCHEMA}; "
                    "read it with the release of modsoft that wrote it, or a newer one"
                )
            self._schema = record.schema
        return record


def _upgrade(entries: dict[str, Any]) -> None:
    """Makes a line of schema 1 one of schema 2."""
    for old, new in _RENAMED.items():
        if old in entries:
            entries[new] = entries.pop(old)
    event = entries.setdefault("event", "tick")
    for key, value in _ABSENT.get(event, {}).items() if isinstance(event, str) else ():
        entries.setdefault(key, value)


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
