"""ONNX graphs of the networks whose sequence is time: LSTM (all modules in one), and one LSTM for each module.

Both have a fixed number of modules N. Standard operators, one LSTM node for each layer and unit.
"""

from __future__ import annotations

import onnx

from modsoft.export import nodes
from modsoft.export.nodes import Nodes, Weights
from modsoft.runtime.control.model_file import ACTUATION, FEATURES, Network

DIRECTIONS = ("",)  # torch's suffix: forward in time


def _prefixes(sizes: Network) -> list[str]:
    """Prefixes in the state dict of each unit: one for all modules, or one for each module, base first."""
    return [""] if sizes.name == "lstm" else [f"networks.{i}." for i in range(sizes.modules or 0)]


def weights_of(model: onnx.ModelProto, sizes: Network) -> Weights:
    """The state dict of a graph, bit for bit. KeyError for a missing weight."""
    weights: Weights = {}
    for prefix in _prefixes(sizes):
        weights |= nodes.weights_of(model, sizes.layers, DIRECTIONS, prefix)
    return weights


def build(weights: Weights, sizes: Network, description: str) -> onnx.ModelProto:
    """Builds the model from the state dict, float32, of `LSTM` or `ModuleLSTM`; description: metadata, JSON text."""
    modules, units = sizes.modules, _prefixes(sizes)
    if modules is None:
        raise ValueError(f"{sizes.name} without its number of modules")
    label = sizes.feature_size - 1
    slot_size = label // sizes.history  # S + A
    graph = Nodes()

    # 0 if all features are finite, else NaN: an LSTM kernel may turn a NaN into a plausible actuation.
    graph.add("ReduceSum", [FEATURES], "sum_of_features", keepdims=0)
    nan_term = graph.add("Sub", ["sum_of_features", "sum_of_features"], "nan_guard")

    ends = [graph.whole_numbers(name, [value]) for name, value in (("first", 0), ("label", label), ("axis", 2))]
    graph.add("Slice", [FEATURES, *ends], "window")  # (1, N, T (S + A))
    slots_shape = graph.whole_numbers("slots_shape", [modules, sizes.history, slot_size])
    graph.add("Reshape", ["window", slots_shape], "slots_by_module")
    graph.add("Transpose", ["slots_by_module"], "slots", perm=[1, 0, 2])  # (T, N, S + A)
    if sizes.name == "lstm":
        side_by_side = graph.whole_numbers("side_by_side", [sizes.history, 1, modules * slot_size])
        sequences = [graph.add("Reshape", ["slots", side_by_side], "layer_0")]
    else:
        sequences = [f"{prefix}layer_0" for prefix in units]  # (T, 1, S + A) each
        graph.add("Split", ["slots"], sequences, axis=1, num_outputs=modules)

    hidden_shape = graph.whole_numbers("hidden_shape", [-1, 1, sizes.hidden])
    last = graph.whole_numbers("last", sizes.history - 1)
    for prefix, sequence in zip(units, sequences, strict=True):
        graph.constants |= nodes.initializers(weights, sizes.layers, DIRECTIONS, prefix)
        for layer in range(sizes.layers):
            name = f"{prefix}layer_{layer + 1}"
            inputs = [sequence, f"{name}_W", f"{name}_R", f"{name}_B"]
            graph.add("LSTM", inputs, [f"{name}_Y"], hidden_size=sizes.hidden)  # Y (T, 1, 1, H)
            sequence = graph.add("Reshape", [f"{name}_Y", hidden_shape], name)  # (T, 1, H)
        graph.add("Gather", [sequence, last], f"{prefix}last_slot", axis=0)  # (1, H)
        graph.add("MatMul", [f"{prefix}last_slot", f"{prefix}head_weight"], f"{prefix}head_product")
        graph.add("Add", [f"{prefix}head_product", f"{prefix}head_bias"], f"{prefix}head")

    graph.add("Concat", [f"{prefix}head" for prefix in units], "heads", axis=1)  # (1, N A)
    actuation_shape = (1, modules, sizes.action_size)
    graph.add("Reshape", ["heads", graph.whole_numbers("actuation_shape", list(actuation_shape))], "unguarded")
    graph.add("Add", ["unguarded", nan_term], ACTUATION)
    return graph.model(
        sizes.name.replace("-", "_"),
        {FEATURES: (1, modules, sizes.feature_size)},
        {ACTUATION: actuation_shape},
        description,
        f"{sizes.name} over {sizes.history} time steps of {modules} modules, index 0 nearest the base.",
    )
