"""Input of the export: a checkpoint of modsoft-train, or a state dict with a meta file."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, Literal

import msgspec
import torch

from modsoft.export import foreign
from modsoft.runtime import robot as robot_file
from modsoft.runtime.control.features import check_planar_state, feature_names
from modsoft.runtime.control.model_file import Network
from modsoft.runtime.errors import ModelError, RobotFileError
from modsoft.runtime.files import read_text
from modsoft.runtime.robot import Robot
from modsoft.training import checkpoint as checkpoints

META_KEYS = (
    "robot (file or shipped name: kind, period, modules trained on), history (time steps T), label (base-to-tip), "
    "feature order (kind)"
)


class MetaFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """TOML for a bare state dict: what its tensors do not contain."""

    robot: str  # a robot file, relative to the meta file, or a shipped robot's name
    history: int
    label: Literal["base -1, tip +1"]
    features: Literal["states and actions by time step, then label"]
    weights: str | None = None  # key in a checkpoint with several state dicts, such as "ema.state_dict"
    provenance: dict[str, Any] = {}


def read(path: Path, meta: Path | None = None) -> dict[str, Any]:
    """The checkpoint at `path`; with `meta`, a checkpoint of the state dict at `path` and the values in `meta`.
    `ModelError` for any other file and for inconsistent content."""
    if meta is None:
        content = checkpoints.read(path)
        # With one entry missing it is a damaged checkpoint of modsoft-train, which `checkpoints.load` refuses.
        if len(content.keys() & checkpoints.KEYS.keys()) < len(checkpoints.KEYS) - 1:
            foreign.refuse(content, path, META_KEYS)
        checkpoint = checkpoints.load(path)
    else:
        checkpoint = _with_meta(path, meta)
    _check(checkpoint, path)
    return checkpoint


def files_of(meta: Path) -> list[Path]:
    """The files that --meta reads: the meta file, and its robot file, which may not exist."""
    return [meta, meta.parent / _meta(meta).robot]


def _meta(meta: Path) -> MetaFile:
    try:
        return msgspec.convert(tomllib.loads(read_text(meta)), MetaFile)
    except (tomllib.TOMLDecodeError, msgspec.ValidationError) as error:
        raise ModelError(f"{meta}: {error}; expected {META_KEYS}") from error


def _robot(meta: Path, name: str) -> Robot:
    """The robot of a meta file: a file relative to it, or a shipped robot."""
    path = meta.parent / name
    if path.is_file():
        return robot_file.load(path)
    try:
        return robot_file.shipped(name)
    except RobotFileError as error:
        raise RobotFileError(f"{meta}: no robot file {path}, and no shipped robot {name!r}") from error


def _with_meta(path: Path, meta: Path) -> dict[str, Any]:
    options = _meta(meta)
    content = checkpoints.read(path)
    if content.keys() >= checkpoints.KEYS.keys():
        raise ModelError(f"{path}: found a complete checkpoint, expected a bare state dict; leave --meta out")
    weights = foreign.weights_of(content, options.weights, path)
    robot = _robot(meta, options.robot)
    return {
        "schema": checkpoints.SCHEMA,
        "robot": robot.to_dict(),
        "network": {
            "name": "bilstm",
            "feature_size": weights["lstm.weight_ih_l0"].shape[1],
            "action_size": weights["head.weight"].shape[0],
            "layers": foreign.layers_of(weights),
            "hidden": weights["lstm.weight_hh_l0"].shape[1],
            "dropout": 0.0,
            "history": options.history,
        },
        "features": feature_names(robot.motion, options.history),
        "weights": weights,
        "provenance": options.provenance,
    }


def network_of(checkpoint: dict[str, Any], where: str = "checkpoint") -> Network:
    """The network of a checkpoint and its sizes; `ModelError` for a network that is not exported."""
    try:
        sizes = {name: value for name, value in checkpoint["network"].items() if name in Network.__struct_fields__}
        return msgspec.convert(sizes, Network)
    except (AttributeError, msgspec.ValidationError) as error:
        raise ModelError(f"{where}: network: {error}; expected a network of modsoft-train and its sizes") from error


def _check(checkpoint: dict[str, Any], path: Path) -> None:
    """`ModelError` unless the checkpoint is consistent and its weights are finite float32."""
    try:
        robot = robot_file.from_dict(checkpoint["robot"], f"{path}: robot")
    except RobotFileError as error:  # in this file, not in a robot file that the user can correct
        raise ModelError(f"{error}; train it again with this version") from error
    network = network_of(checkpoint, str(path))
    motion, history = robot.motion, network.history
    fixed = None if network.name == "bilstm" else robot.modules
    if network.modules != fixed:
        raise ModelError(f"{path}: {network.name} of {network.modules} modules, expected {fixed}; train it again")
    check_planar_state([str(name) for name in checkpoint["features"]], motion, path)
    expected = feature_names(motion, history)
    if list(checkpoint["features"]) != expected:
        raise ModelError(f"{path}: features {list(checkpoint['features'])}, expected for {motion} motion {expected}")
    for name, size, required in (
        ("feature_size", network.feature_size, len(expected)),
        ("action_size", network.action_size, robot.action_size),
    ):
        if size != required:
            raise ModelError(f"{path}: {name} {size}, expected {required} for {motion} motion and history {history}")
    for name, tensor in checkpoint["weights"].items():
        if tensor.dtype != torch.float32:
            raise ModelError(f"{path}: weight {name} is {tensor.dtype}, expected torch.float32")
        if not torch.isfinite(tensor).all():
            raise ModelError(f"{path}: weight {name} is not finite; train it again")
