"""Weights of a biLSTM from checkpoints of other trainings: nested under a key, with a prefix, in any precision."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import torch

from modsoft.runtime.errors import ModelError

Weights = dict[str, torch.Tensor]

ANCHOR = "lstm.weight_hh_l0"  # every biLSTM has it; what precedes it is the prefix of all names
DEPTH = 4  # of nested dicts


def state_dicts(content: Any, key: str = "", depth: int = DEPTH) -> Iterator[tuple[str, Weights]]:
    """(key, state dict) of every biLSTM in a checkpoint. The key is empty for the checkpoint itself, "a.b" for a nested
    dict."""
    if not isinstance(content, dict):
        return
    names = {name: value for name, value in content.items() if isinstance(name, str)}
    if any(name.endswith(ANCHOR) and isinstance(value, torch.Tensor) for name, value in names.items()):
        yield key, {name: value for name, value in names.items() if isinstance(value, torch.Tensor)}
    elif depth:
        for name, value in names.items():
            yield from state_dicts(value, f"{key}.{name}" if key else name, depth - 1)


def weights_of(content: dict[str, Any], key: str | None, where: Path) -> Weights:
    """Weights of the biLSTM, float32, with the names of modsoft-train. key: as in `state_dicts`; None selects the only
    state dict. `ModelError` without a state dict, with several and no key, and for another network."""
    candidates = dict(state_dicts(content))
    keys = ", ".join(repr(each) for each in candidates if each)
    if key is not None and key not in candidates:
        raise ModelError(f"{where}: no state dict of a biLSTM under {key!r}; {_content(content, keys)}")
    if not candidates:
        raise ModelError(
            f"{where}: neither a checkpoint of modsoft-train nor the state dict of a biLSTM ({ANCHOR}, ..., "
            f"head.weight, head.bias); {_content(content, keys)}; save one: torch.save(network.state_dict(), FILE)"
        )
    if key is None and len(candidates) > 1:
        first = next(iter(candidates))
        raise ModelError(
            f"{where}: state dicts of biLSTMs under {keys}; choose one in the TOML of --meta, such as "
            f'weights = "{first}"'
        )
    chosen = candidates[key] if key is not None else next(iter(candidates.values()))
    prefixes = [name.removesuffix(ANCHOR) for name in chosen if name.endswith(ANCHOR)]
    if len(prefixes) > 1:
        raise ModelError(
            f"{where}: several networks in one state dict, under {', '.join(map(repr, prefixes))}; save "
            "only that of the biLSTM: torch.save(network.state_dict(), FILE)"
        )
    own = {name.removeprefix(prefixes[0]): value for name, value in chosen.items() if name.startswith(prefixes[0])}
    _check_names(own, where)
    return {name: value.detach().float() for name, value in own.items()}


def refuse(content: dict[str, Any], where: Path, missing: str) -> NoReturn:
    """Raises `ModelError` with the content of a checkpoint and how to export it. missing: what the weights lack."""
    if "identity" in content and {"optimizer", "optimiser"} & content.keys():  # "optimiser": version 0.1.0
        raise ModelError(f"{where}: the state of a training that has not ended; run modsoft-train again to finish it")
    weights_of(content, None, where)  # refuses other networks, which --meta does not help
    (key,) = (key for key, _ in state_dicts(content))
    what = f"a checkpoint of another training, with a state dict under {key!r}" if key else "a bare state dict"
    raise ModelError(f"{where}: {what}; it lacks {missing}; set them in a TOML file: --meta FILE (see --help)")


def _content(content: dict[str, Any], keys: str) -> str:
    names = [repr(name) for name in content][:5]
    rest = ", ..." if len(content) > 5 else ""
    return f"found one under {keys}" if keys else f"found {', '.join(names) or 'nothing'}{rest}"


def layers_of(weights: Weights) -> int:
    """The number of LSTM layers, from the names of the weights."""
    return sum(name.startswith("lstm.weight_hh_l") and not name.endswith("_reverse") for name in weights)


def _check_names(weights: Weights, where: Path) -> None:
    """`ModelError` unless names, types and dimensions are those of a biLSTM."""
    parts = [
        f"{part}_l{layer}{direction}"
        for part in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
        for layer in range(layers_of(weights))
        for direction in ("", "_reverse")
    ]
    expected = {"head.weight", "head.bias", *(f"lstm.{part}" for part in parts)}
    for label, names in (("no", expected - weights.keys()), ("further", weights.keys() - expected)):
        if names:
            listed = ", ".join(sorted(names)[:4]) + (", ..." if len(names) > 4 else "")
            raise ModelError(
                f"{where}: {label} {listed} in the state dict: not the biLSTM of Table S1 (torch.nn.LSTM `lstm`, "
                "bidirectional, and torch.nn.Linear `head`), the only network that is exported without modsoft-train"
            )
    for name, value in weights.items():
        if not value.is_floating_point():
            raise ModelError(f"{where}: weight {name} is {value.dtype}, expected floats")
    for name in ("lstm.weight_ih_l0", "lstm.weight_hh_l0", "head.weight"):
        if weights[name].ndim != 2:
            raise ModelError(f"{where}: {name} has the shape {tuple(weights[name].shape)}, expected a matrix")
