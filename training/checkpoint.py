"""The checkpoint `model.pt`: a dict of tensors and plain Python values that says all about the model it holds.

    schema      int, SCHEMA
    robot       the robot file of the data set, as plain values
    network     {"name": one of runtime.choices.NETWORKS, "feature_size", "action_size", "layers", "hidden", "dropout",
                "history", and "modules" where it is bound to a number of modules}
    features    ordered names of the F features
    weights     state dict
    provenance  {"data_sha256", "seed", "code_version", "date", "split", "samples", "iterations", "errors_percent", ...}
    resume      what training needs to go on (optimiser, random states); absent in a finished model

It is read with `weights_only=True`, so that a file from a stranger runs no code, and only when every checksum holds,
the archive is one that torch.save writes, and the tensors are no larger than the file.
"""

from __future__ import annotations

import pickle
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import nn

from modsoft.runtime.errors import ModelError
from modsoft.runtime.files import check_is_file, written
from modsoft.training import networks

SCHEMA = 1
KEYS = {"schema": int, "robot": dict, "network": dict, "features": list, "weights": dict, "provenance": dict}
OLD_FORMAT = b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19."  # how torch.save began before version 1.6
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
    check_is_file(path, "model file", f"modsoft-train --out {path} makes one")
    try:
        _check_archive(path)  # torch reads old formats too, and does not look at the checksums
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:  # torch's own message recommends loading it with code and all
        raise ModelError(
            f"{path}: not a checkpoint of modsoft-train (it holds other than tensors and plain values); where it was "
            "made, save the weights alone: torch.save(network.state_dict(), FILE)"
        ) from error
    except NOT_READABLE as error:
        first = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise ModelError(f"{path}: not a checkpoint of modsoft-train, or damaged ({first})") from error
    if not isinstance(checkpoint, dict):
        raise ModelError(f"{path}: holds a {type(checkpoint).__name__}, expected a checkpoint of modsoft-train")
    if not all(_fills_its_storage(tensor) for tensor in _tensors(checkpoint)):
        raise ModelError(f"{path}: not a checkpoint of modsoft-train (a tensor larger than what the file holds of it)")
    return checkpoint


def _check_archive(path: Path) -> None:
    """`ModelError` for a zip archive that is damaged or other than torch.save writes them: one folder, nothing
    compressed, nothing twice, no TorchScript."""
    with path.open("rb") as file:
        if file.read(len(OLD_FORMAT)) == OLD_FORMAT:
            raise ModelError(
                f"{path}: not a checkpoint of modsoft-train (in the format of torch before 1.6); where it "
                "was made, save it again without _use_new_zipfile_serialization=False"
            )
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        if damaged := archive.testzip():
            raise ModelError(f"{path}: damaged: {damaged} in it fails its checksum; copy or train it again")
    names = [entry.filename for entry in entries]
    folder, times = names[0].partition("/")[0] if names else "", Counter(names)
    for entry, name in zip(entries, names, strict=True):
        inside = name.removeprefix(f"{folder}/")
        is_within = folder not in ("", "..") and inside != name and not {"..", ""} & set(inside.split("/"))
        is_plain = entry.compress_type == zipfile.ZIP_STORED and name == entry.orig_filename and "\\" not in name
        if not (is_within and is_plain) or times[name] > 1 or inside == "constants.pkl":
            raise ModelError(f"{path}: not a checkpoint of modsoft-train (an archive with the entry {name!r})")


def _tensors(value: Any) -> Iterator[torch.Tensor]:
    """All tensors in nested dicts and lists."""
    if isinstance(value, torch.Tensor):
        yield value
    elif isinstance(value, dict | list | tuple):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from _tensors(inner)


def _fills_its_storage(tensor: torch.Tensor) -> bool:
    """False for a tensor whose strides make it look larger than the numbers that were read for it."""
    is_plain = tensor.layout == torch.strided and not tensor.is_quantized
    return is_plain and tensor.numel() * tensor.element_size() <= tensor.untyped_storage().nbytes()


def load(path: Path) -> dict[str, Any]:
    """Reads a checkpoint; `ModelError` says what was found when it is none."""
    checkpoint = read(path)
    missing = [key for key in KEYS if key not in checkpoint]
    if missing:
        raise ModelError(f"{path}: no {', '.join(missing)} in it, expected a checkpoint of modsoft-train")
    if checkpoint["schema"] != SCHEMA:
        raise ModelError(f"{path}: schema {checkpoint['schema']}, this version reads {SCHEMA}; train it again")
    wrong = [key for key, kind in KEYS.items() if not isinstance(checkpoint[key], kind)]
    if wrong or not all(isinstance(value, torch.Tensor) for value in checkpoint["weights"].values()):
        raise ModelError(f"{path}: {(wrong or ['weights'])[0]} is not what modsoft-train writes; train it again")
    return checkpoint


def network_of(checkpoint: dict[str, Any]) -> nn.Module:
    """The network with its weights, in evaluation mode."""
    description, weights = checkpoint["network"], checkpoint["weights"]
    try:
        with torch.device("meta"):  # takes no memory, whatever sizes the file claims
            networks.build(description).load_state_dict(weights, assign=True)
        network = networks.build(description)
        network.load_state_dict(weights)
    except (RuntimeError, TypeError, ValueError, KeyError) as error:
        told = " ".join(str(error).split())
        raise ModelError(f"the checkpoint's weights do not fit its own description: {told}") from error
    return network.eval()
