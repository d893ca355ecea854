"""The checkpoint `model.pt`: a dict of tensors and plain Python values that says all about the model it holds.

    schema      int, SCHEMA
    robot       the robot file of the data set, as plain values
    network     {"name": one of networks.NETWORKS, "feature_size", "action_size", "layers", "hidden", "dropout",
                "history", and "modules" where it is bound to a number of modules}
    features    ordered names of the F features
    weights     state dict
    provenance  {"data_sha256", "seed", "code_version", "date", "split", "samples", "iterations", "errors_percent", ...}
    resume      what training needs to go on (optimiser, random states); absent in a finished model

It is read with `weights_only=True`, so that a file from a stranger runs no code, and only when every checksum holds.
"""

from __future__ import annotations

import pickle
import zipfile
import zlib
from pathlib import Path
from typing import Any

import torch
from torch import nn

from modsoft.runtime.errors import ModelError
from modsoft.runtime.files import written
from modsoft.training import networks

SCHEMA = 1
KEYS = ("schema", "robot", "network", "features", "weights", "provenance")
# What zipfile and torch raise for other files and for damaged ones.
NOT_READABLE = (OSError, EOFError, RuntimeError, ValueError, LookupError, zipfile.BadZipFile, zlib.error)


def save(checkpoint: dict[str, Any], path: Path) -> None:
    """Writes to a temporary name beside `path` and renames, so that a kill leaves the old file or the new one."""
    with written(path) as temporary:
        try:
            torch.save(checkpoint, temporary)
        except RuntimeError as error:  # what torch makes of a full disk
            raise OSError(str(error).splitlines()[0]) from error


def read(path: Path) -> dict[str, Any]:
    """Whatever dict torch stored at `path`, unchecked: a checkpoint, or a bare state dict."""
    if not path.is_file():
        raise ModelError(f"no model file {path}; modsoft-train --out {path} makes one")
    try:
        with zipfile.ZipFile(path) as archive:  # torch reads old formats too, and does not look at the checksums
            damaged = archive.testzip()
        if damaged is not None:
            raise ModelError(f"{path}: damaged: {damaged} in it fails its checksum; copy or train it again")
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:  # torch's own message recommends loading it with code and all
        raise ModelError(
            f"{path}: not a checkpoint of modsoft-train (it holds other than tensors and plain values)"
        ) from error
    except NOT_READABLE as error:
        first = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise ModelError(f"{path}: not a checkpoint of modsoft-train, or damaged ({first})") from error
    if not isinstance(checkpoint, dict):
        raise ModelError(f"{path}: holds a {type(checkpoint).__name__}, expected a checkpoint of modsoft-train")
    return checkpoint


def load(path: Path) -> dict[str, Any]:
    """Reads a checkpoint; `ModelError` says what was found when it is none."""
    checkpoint = read(path)
    missing = [key for key in KEYS if key not in checkpoint]
    if missing:
        raise ModelError(f"{path}: no {', '.join(missing)} in it, expected a checkpoint of modsoft-train")
    if checkpoint["schema"] != SCHEMA:
        raise ModelError(f"{path}: schema {checkpoint['schema']}, this version reads {SCHEMA}; train it again")
    return checkpoint


def network_of(checkpoint: dict[str, Any]) -> nn.Module:
    """The network with its weights, in evaluation mode."""
    network = networks.build(checkpoint["network"])
    try:
        network.load_state_dict(checkpoint["weights"])
    except RuntimeError as error:
        raise ModelError(f"the checkpoint's weights do not fit its own description: {error}") from error
    return network.eval()
