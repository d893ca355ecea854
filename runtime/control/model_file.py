"""What stands in `model.onnx` beside its graph: the names at its border, its description and its seal.

The description is one JSON document under the metadata key `modsoft`. The seal is the SHA-256 of the whole file with
the digest's own 64 digits read as zeros: it covers graph, weights and description alike, and is proven on the bare
bytes, before anything parses them. It finds damage, it does not prove who made the file.
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

SCHEMA: Literal[1] = 1
METADATA_KEY = "modsoft"
OPSET = 18
IR_VERSION = 8

FEATURES = "features"  # (1, N, F)
FROM_NEIGHBOURS = ("h_from_base", "c_from_base", "h_from_tip", "c_from_tip")  # (L, 1, H) each
ACTUATION = "actuation"  # (1, N, A)
TO_NEIGHBOURS = ("h_to_tip", "c_to_tip", "h_to_base", "c_to_base")  # (L, 1, H) each

LABEL = "2 (i - 1) / (N - 1) - 1 for module i of N: -1 at the base, +1 at the tip (eq. 1)"
UNSEALED = "0" * 64
_SEAL = re.compile(rb'"file_sha256":"([0-9a-f]{64})"')

Size = Annotated[int, Meta(ge=1)]
Positive = Annotated[float, Meta(gt=0.0)]


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A part of the description: every key is known, nothing changes after reading."""


class Network(Record, frozen=True, omit_defaults=True):
    """Which network of Table S1, and its sizes."""

    name: NetworkName
    feature_size: Size
    action_size: Size
    layers: Size
    hidden: Size
    history: Size  # T, time steps
    modules: Size | None = None  # N that the network is bound to; the biLSTM takes any

    @property
    def sequence_axis(self) -> Literal["modules", "time"]:
        """What an element of the sequence is."""
        return "modules" if self.name == "bilstm" else "time"


class Golden(Record, frozen=True):
    """A pair that the runtime replays at start: features (N, F) and the actuation (N, A) that torch gives for them."""

    features: list[list[float]]
    actuation: list[list[float]]


class Description(Record, frozen=True):
    """What the model is, whom it fits and where it comes from."""

    schema: Literal[1]
    file_sha256: str
    weights_sha256: str
    opset: int
    ir_version: int
    sequence_axis: Literal["modules", "time"]
    kind: str
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


def describe(text: str, where: str) -> Description:
    """The description out of its JSON text; `where` is named in the errors."""
    try:
        schema = msgspec.json.decode(text, type=dict).get("schema")
        if schema != SCHEMA:
            raise ModelError(f"{where}: description schema {schema!r}, this version reads {SCHEMA}; export it again")
        return msgspec.json.decode(text, type=Description)
    except (msgspec.DecodeError, RecursionError) as error:
        raise ModelError(f"{where}: its description cannot be read ({error}); export it again") from error


def with_checksum(model: bytes) -> bytes:
    """The serialised model, whose description has `UNSEALED` for a seal, with its seal set. `ModelError` when the
    provenance, say, has another entry that looks like a seal."""
    found = list(_SEAL.finditer(model))
    if len(found) != 1 or found[0][1] != UNSEALED.encode():
        raise ModelError(f"{len(found)} entries file_sha256 in the model, expected one, unset; rename the others")
    start, end = found[0].span(1)
    return model[:start] + hashlib.sha256(model).hexdigest().encode() + model[end:]


def read(path: Path) -> bytes:
    """The bytes of a model file whose seal holds, else `ModelError`."""
    check_is_file(path, "model file", "modsoft-export model.pt makes one")
    try:
        model = path.read_bytes()
    except OSError as error:
        raise ModelError(f"{path}: cannot be read ({error.strerror}); check its permissions") from error
    if model.startswith(b"PK\x03\x04"):
        raise ModelError(f"{path}: is a checkpoint or another archive, expected ONNX; run modsoft-export on it first")
    found = list(_SEAL.finditer(model))
    if len(found) != 1:
        raise ModelError(f"{path}: no seal in it: not made by modsoft-export, or cut short; export or copy it again")
    start, end = found[0].span(1)
    digest = hashlib.sha256(model[:start])
    digest.update(UNSEALED.encode())
    digest.update(memoryview(model)[end:])
    if digest.hexdigest().encode() != found[0][1]:
        raise ModelError(
            f"{path}: damaged: its SHA-256 is {digest.hexdigest()[:12]}..., its seal says "
            f"{found[0][1][:12].decode()}...; export or copy it again"
        )
    return model
