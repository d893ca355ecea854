"""The checkpoint `model.pt`: a dict of tensors and plain Python values that describes the model completely.

    schema      int, SCHEMA
    robot       the robot file of the data set, as plain values
    network     {"name": one of runtime.choices.NETWORKS, "feature_size", "action_size", "layers", "hidden", "dropout",
                "history", and "modules" where it is bound to a number of modules}
    features    ordered names of the F features
    weights     state dict
    provenance  {"data_sha256", "seed", "code_version", "date", "split", "samples", "iterations", "errors_percent", ...}

Checkpoints are untrusted: they are read with `weights_only=True`, so that no code in them runs, and refused where a
checksum is wrong, the archive is not one of torch.save, or a tensor is larger than its bytes in the file.
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
OLD_FORMAT = b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19."  # first bytes of a file of torch.save before version 1.6
# Errors of zipfile and torch for other files and for damaged ones.
NOT_READABLE = (OSError, EOFError, RuntimeError, ValueError, LookupError, zipfile.BadZipFile, zlib.error)


def save(checkpoint: dict[str, Any], path: Path) -> None:
    """Writes to a temporary file beside `path` and renames it, so that a kill leaves the old file or the new one."""
    with written(path) as temporary:
        try:
            torch.save(checkpoint, temporary)
        except RuntimeError as error:  # torch's error for a full disk
            raise OSError(str(error).splitlines()[0]) from error


def read(path: Path) -> dict[str, Any]:
    """The dict that torch stored at `path`, with unchecked content: a checkpoint, or a bare state dict."""
    check_is_file(path, "model file", f"modsoft-train --out {path} makes one")
    try:
        _check_archive(path)  # torch reads old formats too, and does not check the checksums
        checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:  # torch's own message recommends loading it with its code
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
    """`ModelError` for a zip archive that is damaged or not one of torch.save: one folder, no compression, no entry
    twice, no TorchScript."""
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
    """False for a tensor whose strides give it more numbers than were read for it."""
    is_plain = tensor.layout == torch.strided and not tensor.is_quantized
    return is_plain and tensor.numel() * tensor.element_size() <= tensor.untyped_storage().nbytes()


def load(path: Path) -> dict[str, Any]:
    """Reads a checkpoint; `ModelError` for any other file."""
    checkpoint = read(path)
    missing = [key for key in KEYS if key not in checkpoint]
    if missing:
        raise ModelError(f"{path}: {', '.join(missing)} missing, expected a checkpoint of modsoft-train")
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
        with torch.device("meta"):  # needs no memory for the sizes that the file claims
            networks.build(description).load_state_dict(weights, assign=True)
        network = networks.build(description)
        network.load_state_dict(weights)
    except (RuntimeError, TypeError, ValueError, KeyError) as error:
        reason = " ".join(str(error).split())
        raise ModelError(f"the checkpoint's weights do not fit its own description: {reason}") from error
    return network.eval()
