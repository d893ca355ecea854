"""What is exported: a checkpoint of modsoft-train, or a bare state dict with a meta file that says the rest."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, Literal

import msgspec
import torch

from modsoft.export import foreign
from modsoft.runtime import robot as robots
from modsoft.runtime.control.features import feature_names
from modsoft.runtime.control.model_file import Network
from modsoft.runtime.errors import ModelError, RobotFileError
from modsoft.runtime.files import read_text
from modsoft.runtime.robot import Robot
from modsoft.training import checkpoint as checkpoints

UNTOLD = (
    "robot (file or shipped name: kind, period, modules trained on), history (time steps T), label (base-to-tip), "
    "feature order (kind)"
)


class MetaFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """TOML beside a bare state dict: what the shapes of its tensors cannot tell."""

    robot: str  # a robot file, relative to the meta file, or a shipped robot's name
    history: int
    label: Literal["base -1, tip +1"]
    features: Literal["states and actions by time step, then label"]
    weights: str | None = None  # which state dict of a checkpoint that holds several, such as "ema.state_dict"
    provenance: dict[str, Any] = {}


def read(path: Path, meta: Path | None = None) -> dict[str, Any]:
    """The checkpoint at `path`, checked against itself; with `meta`, one made of a bare state dict."""
    if meta is None:
        content = checkpoints.read(path)
        if len(content.keys() & checkpoints.KEYS.keys()) < len(checkpoints.KEYS) - 1:
            foreign.refuse(content, path, UNTOLD)
        found = checkpoints.load(path)
    else:
        found = _with_meta(path, meta)
    _check(found, path)
    return found


def files_of(meta: Path) -> list[Path]:
    """What is read with --meta: that file, and the robot file that it names, if any."""
    return [meta, meta.parent / _meta(meta).robot]


def _meta(meta: Path) -> MetaFile:
    try:
        return msgspec.convert(tomllib.loads(read_text(meta)), MetaFile)
    except (tomllib.TOMLDecodeError, msgspec.ValidationError) as error:
        raise ModelError(f"{meta}: {error}; expected {UNTOLD}") from error


def _robot(meta: Path, name: str) -> Robot:
    """The robot file that a meta file names, which is beside it, or a shipped robot."""
    path = meta.parent / name
    if path.is_file():
        return robots.load(path)
    try:
        return robots.shipped(name)
    except RobotFileError as error:
        raise RobotFileError(f"{meta}: no robot file {path}, and no shipped robot {name!r}") from error


def _with_meta(path: Path, meta: Path) -> dict[str, Any]:
    said = _meta(meta)
    content = checkpoints.read(path)
    if content.keys() >= checkpoints.KEYS.keys():
        raise ModelError(f"{path}: a checkpoint that says all itself, expected a bare state dict; leave --meta out")
    weights = foreign.weights_of(content, said.weights, path)
    layers = sum(name.startswith("lstm.weight_hh_l") and not name.endswith("_reverse") for name in weights)
    robot = _robot(meta, said.robot)
    return {
        "schema": checkpoints.SCHEMA,
        "robot": robot.to_dict(),
        "network": {
            "name": "bilstm",
            "feature_size": weights["lstm.weight_ih_l0"].shape[1],
            "action_size": weights["head.weight"].shape[0],
            "layers": layers,
            "hidden": weights["lstm.weight_hh_l0"].shape[1],
            "dropout": 0.0,
            "history": said.history,
        },
        "features": feature_names(robot.kind, said.history),
        "weights": weights,
        "provenance": said.provenance,
    }


def network_of(checkpoint: dict[str, Any], where: str = "checkpoint") -> Network:
    """Which network the checkpoint says it holds, and its sizes; `ModelError` for one that is not exported."""
    try:
        found = {name: value for name, value in checkpoint["network"].items() if name in Network.__struct_fields__}
        return msgspec.convert(found, Network)
    except (AttributeError, msgspec.ValidationError) as error:
        raise ModelError(f"{where}: network: {error}; expected a network of modsoft-train and its sizes") from error


def _check(checkpoint: dict[str, Any], path: Path) -> None:
    """What the checkpoint says of itself holds together, and its weights are finite float32."""
    try:
        robot = robots.from_dict(checkpoint["robot"], f"{path}: robot")
    except RobotFileError as error:  # of this file, not of a robot file that the user can mend
        raise ModelError(f"{error}; train it again with this version") from error
    network = network_of(checkpoint, str(path))
    kind, history = robot.kind, network.history
    bound = None if network.name == "bilstm" else robot.modules
    if network.modules != bound:
        raise ModelError(f"{path}: {network.name} of {network.modules} modules, expected {bound}; train it again")
    expected = feature_names(kind, history)
    if list(checkpoint["features"]) != expected:
        raise ModelError(f"{path}: features {list(checkpoint['features'])}, expected for {kind} {expected}")
    for name, found, wanted in (
        ("feature_size", network.feature_size, len(expected)),
        ("action_size", network.action_size, robot.action_size),
    ):
        if found != wanted:
            raise ModelError(f"{path}: {name} {found}, expected {wanted} for {kind} and history {history}")
    for name, tensor in checkpoint["weights"].items():
        if tensor.dtype != torch.float32:
            raise ModelError(f"{path}: weight {name} is {tensor.dtype}, expected torch.float32")
        if not torch.isfinite(tensor).all():
            raise ModelError(f"{path}: weight {name} is not finite; train it again")
