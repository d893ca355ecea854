"""The biLSTM's weights in checkpoints of other trainings: nested under a key, with a prefix, in another precision."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import torch

from modsoft.runtime.errors import ModelError

Weights = dict[str, torch.Tensor]

ANCHOR = "lstm.weight_hh_l0"  # what stands before it in its name stands before every name
DEPTH = 4  # of the dicts in a checkpoint


def state_dicts(content: Any, key: str = "", depth: int = DEPTH) -> Iterator[tuple[str, Weights]]:
    """(key, state dict) of every biLSTM in a checkpoint; the key is empty for the checkpoint itself, "a.b" for one in
    a dict in a dict."""
    if not isinstance(content, dict):
        return
    names = {name: value for name, value in content.items() if isinstance(name, str)}
    if any(name.endswith(ANCHOR) and isinstance(value, torch.Tensor) for name, value in names.items()):
        yield key, {name: value for name, value in names.items() if isinstance(value, torch.Tensor)}
    elif depth:
        for name, value in names.items():
            yield from state_dicts(value, f"{key}.{name}" if key else name, depth - 1)


def weights_of(content: dict[str, Any], key: str | None, where: Path) -> Weights:
    """The biLSTM's weights, float32, under the names of modsoft-train. `key`: which, as in `state_dicts`, None where
    there is only one. `ModelError` where there is none, or a network of another kind."""
    found = dict(state_dicts(content))
    keys = ", ".join(repr(each) for each in found if each)
    if key is not None and key not in found:
        raise ModelError(f"{where}: no state dict of a biLSTM under {key!r}; {_held(content, keys)}")
    if not found:
        raise ModelError(
            f"{where}: neither a checkpoint of modsoft-train nor the state dict of a biLSTM ({ANCHOR}, ..., "
            f"head.weight, head.bias); {_held(content, keys)}; save such a one: torch.save(network.state_dict(), FILE)"
        )
    if key is None and len(found) > 1:
        first = next(iter(found))
        raise ModelError(
            f"{where}: state dicts of biLSTMs under {keys}; choose one in the TOML of --meta, such as "
            f'weights = "{first}"'
        )
    held = found[key] if key is not None else next(iter(found.values()))
    prefixes = [name.removesuffix(ANCHOR) for name in held if name.endswith(ANCHOR)]
    if len(prefixes) > 1:
        raise ModelError(
            f"{where}: several networks in one state dict, under {', '.join(map(repr, prefixes))}; save "
            "that of the biLSTM alone: torch.save(network.state_dict(), FILE)"
        )
    own = {name.removeprefix(prefixes[0]): value for name, value in held.items() if name.startswith(prefixes[0])}
    _check_names(own, where)
    return {name: value.detach().float() for name, value in own.items()}


def refuse(content: dict[str, Any], where: Path, untold: str) -> NoReturn:
    """`ModelError` with what a checkpoint holds and how to export it; `untold`: what has to be added to the weights."""
    if "identity" in content and {"optimizer", "optimiser"} & content.keys():  # "optimiser": version 0.1.0
        raise ModelError(f"{where}: the state of a training that has not ended; start modsoft-train again to end it")
    weights_of(content, None, where)  # another network is not exported with --meta either
    (key,) = (key for key, _ in state_dicts(content))
    what = f"a checkpoint of another training, with a state dict under {key!r}" if key else "a bare state dict"
    raise ModelError(
        f"{where}: {what}; its shapes cannot tell {untold}; say them in a TOML file: --meta FILE (--help shows one)"
    )


def _held(content: dict[str, Any], keys: str) -> str:
    names = [repr(name) for name in content][:5]
    rest = ", ..." if len(content) > 5 else ""
    return f"found one under {keys}" if keys else f"found {', '.join(names) or 'nothing'}{rest}"


def _check_names(weights: Weights, where: Path) -> None:
    """`ModelError` unless the names are exactly those of a biLSTM of some layers, and all are floats."""
    layers = sum(name.startswith("lstm.weight_hh_l") and not name.endswith("_reverse") for name in weights)
    parts = [
        f"{part}_l{layer}{way}"
        for part in ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
        for layer in range(layers)
        for way in ("", "_reverse")
    ]
    expected = {"head.weight", "head.bias", *(f"lstm.{part}" for part in parts)}
    for word, names in (("no", expected - weights.keys()), ("further", weights.keys() - expected)):
        if names:
            listed = ", ".join(sorted(names)[:4]) + (", ..." if len(names) > 4 else "")
            raise ModelError(
                f"{where}: {word} {listed} in the state dict: not the biLSTM of Table S1 (torch.nn.LSTM `lstm`, "
                "bidirectional, and torch.nn.Linear `head`), the only network that is exported without modsoft-train"
            )
    for name, value in weights.items():
        if not value.is_floating_point():
            raise ModelError(f"{where}: weight {name} is {value.dtype}, expected floats")
    for name in ("lstm.weight_ih_l0", "lstm.weight_hh_l0", "head.weight"):
        if weights[name].ndim != 2:
            raise ModelError(f"{where}: {name} has the shape {tuple(weights[name].shape)}, expected a matrix")
