"""The checks between a written model file and the network it was made from. Each raises `ModelError`.

A file passes all of them or is not kept: one alone is not enough. Comparing outputs alone, for instance, overlooks
most single changed weights, and the fused form alone never feeds a neighbour's state.
"""

from __future__ import annotations

import copy
import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
import torch
from numpy.typing import NDArray

from modsoft.export import bilstm_graph
from modsoft.export.nodes import Weights
from modsoft.runtime.arrays import Array
from modsoft.runtime.control.features import labels
from modsoft.runtime.control.model import FixedSizeUnit, Unit, open_unit
from modsoft.runtime.control.model_file import FEATURES, FROM_NEIGHBOURS, IR_VERSION, OPSET, Network
from modsoft.runtime.errors import ModelError

MODULES = (2, 3, 4, 5, 6, 7, 8, 16, 64)  # where the network takes any number
ALWAYS = 4  # modules up to which a network has to agree, whatever it does over more
TELLING = 1e-4  # torch's own error in float32 up to which a comparison tells something, share of the output range
DRAWS = 4  # feature sets for each of them, and as many in all where it takes one
WITHIN = 0.1  # what the slots of a drawn window differ by, at most twice
SEED = 20240229

Draws = dict[int, list[Array]]


@dataclass(frozen=True)
class Reference:
    """What torch says in float64, and how far float32 may be from it."""

    features: dict[int, list[Array]]  # by number of modules: DRAWS of (N, F), float32 values
    actuation: dict[int, list[Array]]  # the same of (N, A)
    torch_error: float  # float32's own error in torch, share of the output range
    output_range: float  # largest minus smallest actuation

    @property
    def bound(self) -> float:
        """Largest permitted error, share of the output range: trained weights amplify float32's rounding, so a fixed
        small bound would refuse correct files; beyond 1e-3 no file is good enough."""
        return min(max(1e-5, 10.0 * self.torch_error), 1e-3)

    @property
    def tolerance(self) -> float:
        """The bound in units of actuation."""
        return self.bound * self.output_range

    def error(self, found: dict[int, list[Array]]) -> dict[int, float]:
        """Largest error for each number of modules, share of the output range."""
        return {
            modules: max(np.abs(f - a).max() for f, a in zip(draws, self.actuation[modules], strict=True))
            / self.output_range
            for modules, draws in found.items()
        }


@dataclass(frozen=True)
class Report:
    """What the checks measured, share of the output range, by number of modules."""

    bound: float
    torch_error: float
    fused: dict[int, float]
    chain: dict[int, float]
    one_sweep_fewer: dict[int, float]


def draw(modules: int, sizes: Network, generator: np.random.Generator) -> Array:
    """Features (N, F) with true labels, in float32's values: states and actions uniform in [-1, 1], the slots of a
    window near each other, as a robot moves. On windows of independent numbers, which no robot makes, a well trained
    network over 64 modules can be chaotic: float32 then differs from float64 as much as from anything else."""
    slots = generator.uniform(-1.0, 1.0, (modules, 1, (sizes.feature_size - 1) // sizes.history))
    slots = slots + generator.uniform(-WITHIN, WITHIN, (modules, sizes.history, slots.shape[-1]))
    features = np.concatenate([slots.reshape(modules, -1), labels(modules)[:, None]], axis=1)
    return features.astype(np.float32).astype(np.float64)


def reference(network: torch.nn.Module, sizes: Network) -> Reference:
    """Runs the network in float64 and float32 on the drawn features of every number of modules that it takes."""
    generator = np.random.default_rng(SEED)
    exact = copy.deepcopy(network).double()
    counts = MODULES if sizes.modules is None else (sizes.modules,)
    draws_each = DRAWS * len(MODULES) // len(counts)
    features = {n: [draw(n, sizes, generator) for _ in range(draws_each)] for n in counts}
    with torch.no_grad():
        actuation = {n: [exact(torch.from_numpy(x)[None])[0].numpy() for x in draws] for n, draws in features.items()}
        rounded = {
            n: [network(torch.from_numpy(x).float()[None])[0].double().numpy() for x in draws]
            for n, draws in features.items()
        }
    if sizes.modules is None:
        features, actuation, rounded = _comparable(features, actuation, rounded)
    everything = np.concatenate([a for draws in actuation.values() for a in draws])
    output_range = float(np.ptp(everything))
    if not np.isfinite(everything).all() or not output_range > 0.0:
        raise ModelError(
            f"the network's actuation spans {output_range} over all drawn features, expected it to be finite and to "
            f"depend on them; train it again"
        )
    unscaled = Reference(features, actuation, 0.0, output_range)
    return Reference(features, actuation, float(max(unscaled.error(rounded).values())), output_range)


def _comparable(features: Draws, actuation: Draws, rounded: Draws) -> tuple[Draws, Draws, Draws]:
    """Without the numbers of modules beyond `ALWAYS` for which torch's own float32 is far from its float64: over that
    many modules this network amplifies rounding until a comparison tells nothing."""
    told = {
        n
        for n, draws in actuation.items()
        if n <= ALWAYS
        or max(np.abs(r - a).max() for r, a in zip(rounded[n], draws, strict=True)) <= TELLING * np.ptp(draws)
    }
    kept = ({n: draws for n, draws in each.items() if n in told} for each in (features, actuation, rounded))
    return next(kept), next(kept), next(kept)


def weights_sha256(weights: Weights) -> str:
    """SHA-256 over names, shapes and bytes of a state dict, in the order of the names."""
    digest = hashlib.sha256()
    for name in sorted(weights):
        digest.update(f"{name} {weights[name].shape}\n".encode())
        digest.update(np.ascontiguousarray(weights[name], dtype="<f4").tobytes())
    return digest.hexdigest()


def verify(path: Path, network: torch.nn.Module, sizes: Network, expected: Reference) -> Report:
    """All checks of the file at `path` against the network; `expected` is `reference(network, sizes)`."""
    weights = {name: tensor.numpy() for name, tensor in network.state_dict().items()}
    check_graph(path)
    check_weights(path, weights, sizes)
    unit = open_unit(path.read_bytes(), str(path))
    fused = check_fused(unit, expected)
    # A network bound to its number of modules has no neighbours that hand it states.
    chain, one_sweep_fewer = check_chain(unit, expected) if isinstance(unit, Unit) else ({}, {})
    check_guard(unit, expected)
    return Report(expected.bound, expected.torch_error, fused, chain, one_sweep_fewer)


def check_graph(path: Path) -> None:
    """The file is ONNX by the standard's own checker, shapes inferred, of the declared opset and IR version."""
    try:
        onnx.checker.check_model(path, full_check=True)
        model = onnx.load(path, load_external_data=False)
    except (onnx.checker.ValidationError, onnx.shape_inference.InferenceError, ValueError) as error:
        raise ModelError(f"the graph is not valid ONNX: {str(error).splitlines()[0]}") from error
    found = (model.ir_version, [(entry.domain, entry.version) for entry in model.opset_import])
    if found != (IR_VERSION, [("", OPSET)]):
        raise ModelError(f"the graph is of IR version and opset {found}, expected {IR_VERSION} and {OPSET}")


def check_weights(path: Path, weights: Weights, sizes: Network) -> None:
    """Every weight, read back with the gate order undone, is bitwise the checkpoint's."""
    try:
        found = bilstm_graph.weights_of(onnx.load(path, load_external_data=False), sizes)
    except (KeyError, ValueError) as error:
        raise ModelError(f"the graph lacks weights that the checkpoint has: {error}") from error
    if sorted(found) != sorted(weights):
        raise ModelError(f"the graph holds the weights {sorted(found)}, expected {sorted(weights)}")
    for name, expected in weights.items():
        if found[name].dtype != expected.dtype or found[name].shape != expected.shape:
            raise ModelError(f"weight {name}: {found[name].dtype} {found[name].shape}, expected {expected.shape}")
        changed = int((found[name].view(np.uint32) != expected.view(np.uint32)).sum())
        if changed:
            raise ModelError(f"weight {name}: {changed} of {expected.size} values are not the checkpoint's")


def check_fused(unit: Unit | FixedSizeUnit, expected: Reference) -> dict[int, float]:
    """All modules in one run give torch's actuation."""
    found = {n: [unit.whole(x) for x in draws] for n, draws in expected.features.items()}
    return _within(expected.error(found), expected.bound, "all modules in one run")


def check_chain(unit: Unit, expected: Reference) -> tuple[dict[int, float], dict[int, float]]:
    """A chain of single modules gives the same after L + 1 sweeps, and, so that this proves that neighbours are
    heard at all, something else after L."""
    first = {n: draws[0] for n, draws in expected.features.items()}
    one = Reference(expected.features, {n: a[:1] for n, a in expected.actuation.items()}, 0.0, expected.output_range)
    found = {n: [unit.chain(x)] for n, x in first.items()}
    chain = _within(one.error(found), expected.bound, "a chain of single modules")
    fewer = one.error({n: [unit.chain(x, sweeps=unit.layers)] for n, x in first.items()})
    noise, difference = max(chain.values()), max(fewer.values())
    if not difference > 10.0 * noise:
        raise ModelError(
            f"a chain of single modules is within {difference:.1e} of the output range after {unit.layers} sweeps "
            f"already, expected more than {10.0 * noise:.1e} before the last: neighbours' states make no difference"
        )
    return chain, fewer


def check_guard(unit: Unit | FixedSizeUnit, expected: Reference) -> None:
    """A NaN or an infinity in any feature or any neighbour's state gives NaN in every output at every module."""
    draws = expected.features[3 if unit.modules is None else unit.modules]
    features = draws[0].astype(np.float32)
    states: dict[str, NDArray[np.float32]] = {}
    if isinstance(unit, Unit):
        states = {name: np.zeros((unit.layers, 1, unit.hidden), dtype=np.float32) for name in FROM_NEIGHBOURS}
    for bad in (np.nan, np.inf, -np.inf):
        for index in range(unit.feature_size):
            spoilt = features.copy()
            spoilt[index % len(spoilt), index] = bad
            _all_nan(unit, {FEATURES: spoilt[None]}, f"feature {index}")
        for name, state in states.items():
            for layer, values in enumerate(state):
                spoilt = state.copy()
                spoilt[layer, 0, layer % values.size] = bad
                _all_nan(unit, {FEATURES: features[None], **states, name: spoilt}, f"{name} of layer {layer + 1}")


def _all_nan(unit: Unit | FixedSizeUnit, inputs: dict[str, NDArray[np.float32]], where: str) -> None:
    names = [output.name for output in unit.session.get_outputs()]
    for name, output in zip(names, unit.session.run(None, inputs), strict=True):
        if not np.isnan(output).all():
            raise ModelError(f"a value that is not finite in {where} leaves {name} looking sound, expected NaN")


def _within(errors: dict[int, float], bound: float, what: str) -> dict[int, float]:
    for modules, error in errors.items():
        if not error <= bound:
            raise ModelError(
                f"{what}: {modules} modules differ from torch by {error:.1e} of the output range, "
                f"expected at most {bound:.1e}"
            )
    return errors
