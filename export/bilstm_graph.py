"""ONNX graph of the biLSTM over a segment of contiguous modules.

Standard operators, one bidirectional LSTM node for each layer, as in Figure 1-(D) of the paper. The states from the two
neighbours are inputs with zero defaults, which apply at the ends of the robot, so that one run covers the whole robot.
(A trace of torch would fix the number of modules.)
"""

from __future__ import annotations

import numpy as np
import onnx

from modsoft.export import fixed_graph, nodes
from modsoft.export.nodes import Nodes, Weights
from modsoft.runtime.control.model_file import ACTUATION, FEATURES, FROM_NEIGHBOURS, TO_NEIGHBOURS, Network

DIRECTIONS = ("", "_reverse")  # torch's suffixes: base to tip, tip to base


def weights_of(model: onnx.ModelProto, sizes: Network) -> Weights:
    """The state dict of a graph, bit for bit. KeyError for a missing weight."""
    if sizes.modules is not None:
        return fixed_graph.weights_of(model, sizes)
    return nodes.weights_of(model, sizes.layers, DIRECTIONS)


def build(weights: Weights, sizes: Network, description: str) -> onnx.ModelProto:
    """Builds the model from a state dict, float32; description: metadata, JSON text. Networks with a fixed number of
    modules are built by `fixed_graph`."""
    if sizes.modules is not None:
        return fixed_graph.build(weights, sizes, description)
    layers, hidden = sizes.layers, sizes.hidden
    graph = Nodes()
    graph.constants |= nodes.initializers(weights, layers, DIRECTIONS)

    # 0 if all inputs are finite, else NaN: an LSTM kernel may turn a NaN into a plausible actuation.
    received = graph.add("Concat", FROM_NEIGHBOURS, "received", axis=0)  # (4 L, 1, H)
    graph.add("ReduceSum", [FEATURES], "sum_of_features", keepdims=0)
    graph.add("ReduceSum", [received], "sum_of_received", keepdims=0)
    graph.add("Add", ["sum_of_features", "sum_of_received"], "sum_of_inputs")
    nan_term = graph.add("Sub", ["sum_of_inputs", "sum_of_inputs"], "nan_guard")

    sequence_shape = graph.whole_numbers("sequence_shape", [-1, 1, sizes.feature_size])
    sequence = graph.add("Reshape", [FEATURES, sequence_shape], "layer_0")  # (N, 1, F)
    final_h, final_c = [], []
    pair_shape = graph.whole_numbers("both_directions", [-1, 1, 2 * hidden])
    for layer in range(layers):
        name = f"layer_{layer + 1}"
        h_rows = graph.whole_numbers(f"{name}_h_rows", [layer, 2 * layers + layer])
        c_rows = graph.whole_numbers(f"{name}_c_rows", [layers + layer, 3 * layers + layer])
        h_initial = graph.add("Gather", [received, h_rows], f"{name}_h_initial", axis=0)  # (2, 1, H): base, tip
        c_initial = graph.add("Gather", [received, c_rows], f"{name}_c_initial", axis=0)
        final_h.append(f"{name}_h")
        final_c.append(f"{name}_c")
        graph.add(
            "LSTM",
            [sequence, f"{name}_W", f"{name}_R", f"{name}_B", "", h_initial, c_initial],
            [f"{name}_Y", final_h[-1], final_c[-1]],  # Y (N, 2, 1, H)
            direction="bidirectional",
            hidden_size=hidden,
        )
        sequence = graph.add("Reshape", [f"{name}_Y", pair_shape], name)  # (N, 1, 2 H)

    graph.add("MatMul", [sequence, "head_weight"], "head_product")
    graph.add("Add", ["head_product", "head_bias"], "head")  # (N, 1, A)
    graph.add("Reshape", ["head", graph.whole_numbers("actuation_shape", [1, -1, sizes.action_size])], "unguarded")
    graph.add("Add", ["unguarded", nan_term], ACTUATION)

    graph.add("Concat", final_h + final_c, "final_states", axis=0)  # (4 L, 1, H): h, then c; by layer: tip, base
    sent = graph.add("Add", ["final_states", nan_term], "sent")
    for name in TO_NEIGHBOURS:
        first = (2 * layers if name.startswith("c") else 0) + (1 if name.endswith("base") else 0)
        rows = graph.whole_numbers(f"{name}_rows", [first + 2 * layer for layer in range(layers)])
        graph.add("Gather", [sent, rows], name, axis=0)

    state = (layers, 1, hidden)
    graph.constants |= {name: np.zeros(state, dtype=np.float32) for name in FROM_NEIGHBOURS}
    return graph.model(
        "bilstm_unit",
        {FEATURES: (1, "N", sizes.feature_size), **dict.fromkeys(FROM_NEIGHBOURS, state)},
        {ACTUATION: (1, "N", sizes.action_size), **dict.fromkeys(TO_NEIGHBOURS, state)},
        description,
        "The biLSTM unit over N contiguous modules, index 0 nearest the base; N = 1 is one module's unit.",
    )
