"""Format of `model.onnx`: names of the graph's inputs and outputs, the description and the checksum.

The description is one JSON document under the metadata key `modsoft`. The checksum is the SHA-256 of the whole file,
computed with its own 64 digits set to zero. It covers graph, weights and description, and is verified on the raw bytes
before anything parses them. It detects damage; it does not authenticate the file.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from modsoft.runtime.choices import NetworkName
from modsoft.runtime.errors import ModelError
from modsoft.runtime.files import check_is_file
from modsoft.runtime.layout import KINDS, Actuators
from modsoft.runtime.robot import Robot

SCHEMA: Literal[2] = 2  # 1: releases 0.1, with the name of a kind of robot in place of the layout
METADATA_KEY = "modsoft"
OPSET = 18
IR_VERSION = 8

FEATURES = "features"  # (1, N, F)
FROM_NEIGHBOURS = ("h_from_base", "c_from_base", "h_from_tip", "c_from_tip")  # (L, 1, H) each
ACTUATION = "actuation"  # (1, N, A)
TO_NEIGHBOURS = ("h_to_tip", "c_to_tip", "h_to_base", "c_to_base")  # (L, 1, H) each

LABEL = "2 (i - 1) / (N - 1) - 1 for module i of N: -1 at the base, +1 at the tip (eq. 1)"
CHECKSUM_PLACEHOLDER = "0" * 64
_CHECKSUM_FIELD = re.compile(rb'"file_sha256":"([0-9a-f]{64})"')

Size = Annotated[int, Meta(ge=1)]
Positive = Annotated[float, Meta(gt=0.0)]


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A part of the description. Frozen; unknown keys are errors."""


class Network(Record, frozen=True, omit_defaults=True):
    """A network of Table S1 and its sizes."""

    name: NetworkName
    feature_size: Size
    action_size: Size
    layers: Size
    hidden: Size
    history: Size  # T, time steps
    modules: Size | None = None  # N, None for the biLSTM, which accepts any N

    @property
    def sequence_axis(self) -> Literal["modules", "time"]:
        """Axis that the recurrence runs along."""
        return "modules" if self.name == "bilstm" else "time"


class Layout(Record, frozen=True):
    """Motion and actuators of the robot, as in its file."""

    motion: Literal["planar", "spatial"]
    drive: Literal["chambers", "cables"]
    directions_deg: list[float]


class Golden(Record, frozen=True):
    """A reference pair that the runtime evaluates at start: features (N, F) and torch's actuation (N, A) for them."""

    features: list[list[float]]
    actuation: list[list[float]]


class Description(Record, frozen=True):
    """What the model is, which robots it fits and how it was generated."""

    schema: Literal[2]
    file_sha256: str
    weights_sha256: str
    opset: int
    ir_version: int
    sequence_axis: Literal["modules", "time"]
    layout: Layout
    state_size: Size
    action_size: Size
    period_s: Positive
    modules_trained_on: list[int]
    features: list[str]  # ordered names of the F features
    label: str
    network: Network
    tolerance: Positive  # largest permitted difference from `golden`, in units of actuation
    golden: list[Golden]
    robot: dict[str, Any]  # the robot file of the data set
    provenance: dict[str, Any]


def layout_of(robot: Robot) -> Layout:
    """Motion and actuators of a robot."""
    return _layout(robot.motion, robot.actuators)


def _layout(motion: str, actuators: Actuators) -> Layout:
    table = {"motion": motion, **msgspec.to_builtins(actuators)}
    return msgspec.convert(table, Layout)


def describe(text: str, where: str) -> Description:
    """Parses a description, JSON text. `where` names the file in the `ModelError`."""
    try:
        table = msgspec.json.decode(text, type=dict)
        schema = table.get("schema")
        if schema == 1:
            table = _from_schema_1(table, where)
        elif schema != SCHEMA:
            raise ModelError(
                f"{where}: description schema {schema!r}, this version reads 1 and {SCHEMA}; export it again"
            )
        return msgspec.convert(table, Description)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ModelError(f"{where}: its description cannot be read ({error}); export it again") from error


def _from_schema_1(table: dict[str, Any], where: str) -> dict[str, Any]:
    """A description of schema 1 in the present form."""
    others, kind = {key: value for key, value in table.items() if key != "kind"}, table.get("kind")
    if not isinstance(kind, str) or kind not in KINDS:
        raise ModelError(f"{where}: for a robot of kind {kind!r}, expected one of {', '.join(KINDS)}")
    return {**others, "schema": SCHEMA, "layout": msgspec.to_builtins(_layout(*KINDS[kind]))}


def with_checksum(model: bytes) -> bytes:
    """A serialised model with its checksum in the place of `CHECKSUM_PLACEHOLDER`. `ModelError` unless the model has
    exactly one entry `file_sha256`, with the placeholder in it."""
    fields = list(_CHECKSUM_FIELD.finditer(model))
    if len(fields) != 1 or fields[0][1] != CHECKSUM_PLACEHOLDER.encode():
        raise ModelError(f"{len(fields)} entries file_sha256 in the model, expected one, unset; rename the others")
    start, end = fields[0].span(1)
    return model[:start] + hashlib.sha256(model).hexdigest().encode() + model[end:]


def read(path: Path) -> bytes:
    """Reads a model file and verifies its checksum. `ModelError` where it cannot be read or is damaged."""
    check_is_file(path, "model file", "run modsoft-export model.pt")
    try:
        model = path.read_bytes()
    except OSError as error:
        raise ModelError(f"{path}: cannot be read ({error.strerror}); check its permissions") from error
    if model.startswith(b"PK\x03\x04"):
        raise ModelError(f"{path}: found a checkpoint or archive, expected ONNX; run modsoft-export on it first")
    fields = list(_CHECKSUM_FIELD.finditer(model))
    if len(fields) != 1:
        raise ModelError(f"{path}: no checksum: not written by modsoft-export, or truncated; export or copy it again")
    start, end = fields[0].span(1)
    digest = hashlib.sha256(model[:start])
    digest.update(CHECKSUM_PLACEHOLDER.encode())
    digest.update(memoryview(model)[end:])
    if digest.hexdigest().encode() != fields[0][1]:
        raise ModelError(
            f"{path}: damaged: found SHA-256 {digest.hexdigest()[:12]}..., expected "
            f"{fields[0][1][:12].decode()}... from its checksum; export or copy it again"
        )
    return model
