"""Checks of a model file against the network that it was exported from. Each raises `ModelError`.

A file must pass all of them, because each detects other errors. A comparison of outputs, for instance, does not detect
most single changed weights, and a run over all modules does not use the neighbours' states.
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

MODULES = (2, 3, 4, 5, 6, 7, 8, 16, 64)  # for a network for any number
REQUIRED_MODULES = 4  # modules up to which a comparison is required
COMPARABLE_ERROR = 1e-4  # largest error of torch in float32 for a meaningful comparison, relative to the output range
DRAWS = 4  # random feature sets for each of MODULES; a network for a fixed number gets all of them
SLOT_SPREAD = 0.1  # half of the largest difference between the slots of a window
SEED = 20240229

Draws = dict[int, list[Array]]  # by number of modules


@dataclass(frozen=True)
class Reference:
    """Output of torch in float64, and the permitted error of float32."""

    features: Draws  # DRAWS of (N, F), float32 values
    actuation: Draws  # DRAWS of (N, A)
    torch_error: float  # of torch in float32, relative to the output range
    output_range: float  # largest minus smallest actuation

    @property
    def bound(self) -> float:
        """Largest permitted error, relative to the output range. Trained weights amplify the rounding of float32, so
        that a small constant would refuse correct files; beyond 1e-3 every file is refused."""
        return min(max(1e-5, 10.0 * self.torch_error), 1e-3)

    @property
    def tolerance(self) -> float:
        """The bound in units of actuation."""
        return self.bound * self.output_range

    def error(self, outputs: Draws) -> dict[int, float]:
        """Largest error for each number of modules, relative to the output range."""
        return {
            modules: max(np.abs(a - b).max() for a, b in zip(draws, self.actuation[modules], strict=True))
            / self.output_range
            for modules, draws in outputs.items()
        }


@dataclass(frozen=True)
class Report:
    """Errors by number of modules, relative to the output range: of one run over all modules, of the chain of single
    modules, and of the chain without its last sweep."""

    bound: float
    torch_error: float
    whole: dict[int, float]
    chain: dict[int, float]
    one_sweep_fewer: dict[int, float]


def draw(modules: int, sizes: Network, generator: np.random.Generator) -> Array:
    """Random features (N, F) with true labels, exact in float32. States and actions are uniform in [-1, 1], and the
    slots of a window are close to each other, as for a moving robot. For independent slots, which do not occur, a
    trained network over 64 modules can be chaotic, which prevents a comparison of float32 with float64."""
    slots = generator.uniform(-1.0, 1.0, (modules, 1, (sizes.feature_size - 1) // sizes.history))
    slots = slots + generator.uniform(-SLOT_SPREAD, SLOT_SPREAD, (modules, sizes.history, slots.shape[-1]))
    features = np.concatenate([slots.reshape(modules, -1), labels(modules)[:, None]], axis=1)
    return features.astype(np.float32).astype(np.float64)


def reference(network: torch.nn.Module, sizes: Network) -> Reference:
    """Runs the network in float64 and float32 on random features, for each number of modules."""
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
            f"the network's actuation has the range {output_range} over random features, expected finite values that "
            f"depend on the features; train it again"
        )
    unscaled = Reference(features, actuation, 0.0, output_range)
    return Reference(features, actuation, float(max(unscaled.error(rounded).values())), output_range)


def _comparable(features: Draws, actuation: Draws, rounded: Draws) -> tuple[Draws, Draws, Draws]:
    """Drops the numbers of modules beyond `REQUIRED_MODULES` for which torch in float32 is far from float64: there the
    network amplifies rounding too much for a comparison."""
    comparable = {
        n
        for n, draws in actuation.items()
        if n <= REQUIRED_MODULES
        or max(np.abs(r - a).max() for r, a in zip(rounded[n], draws, strict=True)) <= COMPARABLE_ERROR * np.ptp(draws)
    }

    def kept(draws: Draws) -> Draws:
        return {n: draws[n] for n in draws if n in comparable}

    return kept(features), kept(actuation), kept(rounded)


def weights_sha256(weights: Weights) -> str:
    """SHA-256 over names, shapes and bytes of a state dict, in the order of the names."""
    digest = hashlib.sha256()
    for name in sorted(weights):
        digest.update(f"{name} {weights[name].shape}\n".encode())
        digest.update(np.ascontiguousarray(weights[name], dtype="<f4").tobytes())
    return digest.hexdigest()


def verify(path: Path, network: torch.nn.Module, sizes: Network, expected: Reference) -> Report:
    """Runs all checks of the file at `path` against the network; expected: `reference(network, sizes)`."""
    weights = {name: tensor.numpy() for name, tensor in network.state_dict().items()}
    check_graph(path)
    check_weights(path, weights, sizes)
    unit = open_unit(path.read_bytes(), str(path))
    whole = check_whole(unit, expected)
    # A network for a fixed number of modules has no neighbours.
    chain, one_sweep_fewer = check_chain(unit, expected) if isinstance(unit, Unit) else ({}, {})
    check_nan(unit, expected)
    return Report(expected.bound, expected.torch_error, whole, chain, one_sweep_fewer)


def check_graph(path: Path) -> None:
    """The file is valid ONNX, with inferred shapes, and has the declared opset and IR version."""
    try:
        onnx.checker.check_model(path, full_check=True)
        model = onnx.load(path, load_external_data=False)
    except (onnx.checker.ValidationError, onnx.shape_inference.InferenceError, ValueError) as error:
        raise ModelError(f"the graph is not valid ONNX: {str(error).splitlines()[0]}") from error
    versions = (model.ir_version, [(entry.domain, entry.version) for entry in model.opset_import])
    if versions != (IR_VERSION, [("", OPSET)]):
        raise ModelError(f"the graph is of IR version and opset {versions}, expected {IR_VERSION} and {OPSET}")


def check_weights(path: Path, weights: Weights, sizes: Network) -> None:
    """Every weight of the graph equals that of the checkpoint, bit for bit."""
    try:
        stored = bilstm_graph.weights_of(onnx.load(path, load_external_data=False), sizes)
    except (KeyError, ValueError) as error:
        raise ModelError(f"the graph lacks weights that the checkpoint has: {error}") from error
    if sorted(stored) != sorted(weights):
        raise ModelError(f"the graph has the weights {sorted(stored)}, expected {sorted(weights)}")
    for name, expected in weights.items():
        if stored[name].dtype != expected.dtype or stored[name].shape != expected.shape:
            raise ModelError(f"weight {name}: {stored[name].dtype} {stored[name].shape}, expected {expected.shape}")
        changed = int((stored[name].view(np.uint32) != expected.view(np.uint32)).sum())
        if changed:
            raise ModelError(f"weight {name}: {changed} of {expected.size} values differ from the checkpoint")


def check_whole(unit: Unit | FixedSizeUnit, expected: Reference) -> dict[int, float]:
    """One run over all modules gives the actuation of torch."""
    outputs = {n: [unit.whole(x) for x in draws] for n, draws in expected.features.items()}
    return _within(expected.error(outputs), expected.bound, "all modules in one run")


def check_chain(unit: Unit, expected: Reference) -> tuple[dict[int, float], dict[int, float]]:
    """A chain of single modules gives the actuation of torch after L + 1 sweeps, and another one after L, which shows
    that the neighbours' states are used. Returns the errors of both."""
    first = {n: draws[0] for n, draws in expected.features.items()}
    one = Reference(expected.features, {n: a[:1] for n, a in expected.actuation.items()}, 0.0, expected.output_range)
    outputs = {n: [unit.chain(x)] for n, x in first.items()}
    chain = _within(one.error(outputs), expected.bound, "a chain of single modules")
    fewer = one.error({n: [unit.chain(x, sweeps=unit.layers)] for n, x in first.items()})
    noise, difference = max(chain.values()), max(fewer.values())
    if not difference > 10.0 * noise:
        raise ModelError(
            f"a chain of single modules has the error {difference:.1e} after {unit.layers} sweeps, expected more than "
            f"{10.0 * noise:.1e} before the last sweep: the neighbours' states make no difference"
        )
    return chain, fewer


def check_nan(unit: Unit | FixedSizeUnit, expected: Reference) -> None:
    """NaN or infinity in any feature or neighbour's state gives NaN in all outputs of all modules."""
    draws = expected.features[3 if unit.modules is None else unit.modules]
    features = draws[0].astype(np.float32)
    states: dict[str, NDArray[np.float32]] = {}
    if isinstance(unit, Unit):
        states = {name: np.zeros((unit.layers, 1, unit.hidden), dtype=np.float32) for name in FROM_NEIGHBOURS}
    for bad in (np.nan, np.inf, -np.inf):
        for index in range(unit.feature_size):
            corrupted = features.copy()
            corrupted[index % len(corrupted), index] = bad
            _all_nan(unit, {FEATURES: corrupted[None]}, f"feature {index}")
        for name, state in states.items():
            for layer, values in enumerate(state):
                corrupted = state.copy()
                corrupted[layer, 0, layer % values.size] = bad
                _all_nan(unit, {FEATURES: features[None], **states, name: corrupted}, f"{name} of layer {layer + 1}")


def _all_nan(unit: Unit | FixedSizeUnit, inputs: dict[str, NDArray[np.float32]], where: str) -> None:
    names = [output.name for output in unit.session.get_outputs()]
    for name, output in zip(names, unit.session.run(None, inputs), strict=True):
        if not np.isnan(output).all():
            raise ModelError(f"a value that is not finite in {where} leaves {name} finite, expected NaN")


def _within(errors: dict[int, float], bound: float, what: str) -> dict[int, float]:
    for modules, error in errors.items():
        if not error <= bound:
            raise ModelError(
                f"{what}: {modules} modules differ from torch by {error:.1e} of the output range, "
                f"expected at most {bound:.1e}"
            )
    return errors
