"""The records of a run log: a type for each kind of line in `run.jsonl`, with the unit and the meaning of every field.

A line is one JSON object; its key "event" names the type. The first line is the header with the schema version. N:
modules; A: action size; times end in `_ns` and are those of CLOCK_MONOTONIC; NaN is written as null. `log_reader` reads
these records, and logs of older schemas as the same types.
"""

from __future__ import annotations

import math
from typing import Annotated, Any

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from modsoft.runtime.arrays import Array

SCHEMA = 2  # 1: release 0.1.0, without a header; `frame_status`, `reference` and others had other keys

Flags = NDArray[np.bool_]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]


class FrameRecord(msgspec.Struct, frozen=True, eq=False):
    """A tracker frame."""

    number: Count  # counted by the tracker
    mono_ns: Count  # just before the frame was requested
    poses: Array  # (N + 1, 4, 4) poses of the tools in the tracker's frame, base first; positions in mm
    valid: Flags  # (N + 1,) false for a tool that was not seen
    quality: Array  # (N + 1,) the tracker's own measure (NDI: RMS error, mm); NaN for a tool that was not seen
    age_ms: float | None = None  # when the step checked the frame
    port_status: tuple[Count, ...] | None = None  # (N + 1,) NDI's port status of each tool; None without one


class BoardRecord(msgspec.Struct, frozen=True, eq=False):
    """The newest status of the board."""

    state: str  # as the protocol names it, such as RUNNING
    faults: int  # bits of the protocol; 0: none
    tick: int  # control step + 1 of the set-points in force
    applied_bar: Array  # (channels,) pressures that the board commands to the valves
    measured_bar: Array  # (channels,) pressures at the sensors; NaN where there is no sensor
    age_ms: float  # since the status arrived
    supply_v: float | None = None  # supply of the board; None in logs before firmware version 2


class Acknowledgement(msgspec.Struct, frozen=True):
    """How long the board took to acknowledge the set-points of a step."""

    tick: int  # the step that sent them; -1: actuation 0 before the first step
    ms: float | None  # from writing to the acknowledgement; None: not acknowledged before the next step


class HeaderRecord(msgspec.Struct, frozen=True, tag_field="event", tag="header"):
    """The first line of a log."""

    schema: int


class StartRecord(msgspec.Struct, frozen=True, eq=False, tag_field="event", tag="start"):
    """The first set-points, actuation 0, one period before step 0."""

    mono_ns: int  # just before they were sent
    commanded_bar: Array  # (channels,)


class TickRecord(msgspec.Struct, eq=False, tag_field="event", tag="tick"):
    """One control step. It is written when the step has ended, also by an error."""

    tick: int  # control step k, from 0
    mono_ns: int  # when the step began
    due_ns: int  # when it was due
    wall: str  # UTC when it began, ISO 8601
    late_ms: float  # mono_ns - due_ns
    missed: int  # control steps skipped just before this one
    frame_status: str  # "good", or why the frame was not used; the actuation before is then held
    frame_detail: str  # the values behind frame_status, such as the tool that was hidden; empty for a good frame
    frame: FrameRecord | None  # the newest frame; None before the first
    configuration: Array | None  # (N, 3) measured [v_x, v_y, v_z] at the start of the step; None without a good frame
    desired: Array  # (N, 3) desired configuration at the start of the step; NaN: none, the actuations are given
    board: BoardRecord | None  # before this step's set-points; None before the first status and in a dry run
    acknowledged: Acknowledgement  # of the set-points before this step's
    connection: dict[str, int]  # counts of the board's connection since the port was opened, before the set-points
    actuation: Array  # (N, A) in force after the step, within every limit
    reference: Array | None = None  # (N, 3) given to the model: desired at the end of the step plus the correction
    raw: Array | None = None  # (N, A) output of the model for it, before every limit; both None without a good frame
    commanded_bar: Array | None = None  # (channels,) set-points sent by this step; None: nothing was sent
    sent: bool = False  # false: the step took more than half a period, or an error ended the run
    step_ms: float = math.nan  # duration of the step, set-points and checks included


class DoneRecord(msgspec.Struct, frozen=True, tag_field="event", tag="done"):
    """The task has ended, one period after its last step."""

    mono_ns: int
    acknowledged: Acknowledgement  # of the last step's set-points


class WarmUpFailedRecord(msgspec.Struct, frozen=True, tag_field="event", tag="warm-up failed"):
    """An error ended the warm-up of the caches; the control steps continue without it."""

    reason: str


class EndRecord(msgspec.Struct, frozen=True, tag_field="event", tag="end"):
    """The end of the run, after the venting."""

    mono_ns: int  # when venting began
    exit_code: int
    reason: str  # "done", or the message of the error
    vented: bool  # the board confirmed it
    vented_ns: int | None  # when it did
    residual_bar: dict[int, float]  # channel: pressure above the threshold that a sensor still measured then


Record = HeaderRecord | StartRecord | TickRecord | DoneRecord | WarmUpFailedRecord | EndRecord


def encode(value: object) -> bytes:
    """A record, or anything made of dicts, lists, arrays and numbers, as JSON in one line. Arrays are rounded to nine
    decimals; NaN and infinity become null; bytes of a file name that are not UTF-8 become `\\\\udcXX`."""
    try:
        return _ENCODER.encode(value)
    except UnicodeEncodeError:
        return _ENCODER.encode(_printable(msgspec.to_builtins(value, enc_hook=_builtin, str_keys=True)))


def decode(line: dict[str, Any]) -> Record:
    """The record of a decoded line of JSON. Raises `msgspec.ValidationError`."""
    record: Record = msgspec.convert(line, Record, dec_hook=_array, str_keys=True)
    return record


def _builtin(value: object) -> object:
    if isinstance(value, np.ndarray):
        return (np.round(value, 9) if value.dtype.kind == "f" else value).tolist()
    if isinstance(value, np.generic):
        return value.item()
    raise NotImplementedError(f"a run log cannot hold {type(value).__name__}")


_ENCODER = msgspec.json.Encoder(enc_hook=_builtin)


def _printable(value: Any) -> Any:
    """With every text as UTF-8."""
    if isinstance(value, dict):
        return {_printable(key): _printable(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_printable(entry) for entry in value]
    return value.encode("utf-8", "backslashreplace").decode() if isinstance(value, str) else value


def _array(kind: Any, value: object) -> np.ndarray:
    """Nested lists of numbers or null, or of truth values, as an array. Text is no number, nor is a truth value."""
    entry: Any = bool if kind == Flags else float | None
    depth, inner = 0, value
    while isinstance(inner, list) and depth < 4:
        depth, inner = depth + 1, inner[0] if inner else None
        entry = list[entry]
    if depth == 0:
        raise ValueError(f"expected an array, found {type(value).__name__}")
    return np.array(msgspec.convert(value, entry), dtype=np.bool_ if kind == Flags else np.float64)
