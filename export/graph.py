"""The biLSTM unit as an ONNX graph over a segment of contiguous modules, built node by node.

Standard operators, one bidirectional LSTM node a layer; it opens in a viewer as the paper's Figure 1-(D). The states
that arrive from the two neighbours are inputs with zero defaults, so that an end of the robot feeds nothing and the
whole robot is one run. (Tracing torch freezes the number of modules at the traced one.)
"""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from modsoft.runtime.artefact import (
    ACTUATION,
    FEATURES,
    FROM_NEIGHBOURS,
    IR_VERSION,
    METADATA_KEY,
    OPSET,
    TO_NEIGHBOURS,
)

Weights = dict[str, NDArray[np.float32]]
DIRECTIONS = ("", "_reverse")  # torch's suffixes: base to tip, tip to base
TORCH_GATES, ONNX_GATES = "ifco", "iofc"  # order of the four gates' rows: input, output, forget, cell


def _regated(rows: NDArray[np.float32], old: str, new: str) -> NDArray[np.float32]:
    """Rows of four gates (4 H, ...) from one order of gates to another."""
    gates = dict(zip(old, np.split(rows, 4), strict=True))
    return np.concatenate([gates[gate] for gate in new])


def initializers(weights: Weights, layers: int) -> Weights:
    """torch's state dict to the graph's weights: W (2, 4 H, in), R (2, 4 H, H), B (2, 8 H) a layer, and the head."""
    found: Weights = {}
    for layer in range(layers):
        for name, parts in (("W", ["weight_ih"]), ("R", ["weight_hh"]), ("B", ["bias_ih", "bias_hh"])):
            found[f"layer_{layer + 1}_{name}"] = np.stack([
                np.concatenate([
                    _regated(weights[f"lstm.{part}_l{layer}{direction}"], TORCH_GATES, ONNX_GATES) for part in parts
                ])
                for direction in DIRECTIONS
            ])
    found["head_weight"] = np.ascontiguousarray(weights["head.weight"].T)
    found["head_bias"] = weights["head.bias"]
    return found


def weights_of(model: onnx.ModelProto, layers: int) -> Weights:
    """The state dict read back out of a graph: the inverse of `initializers`. KeyError where one is missing."""
    stored = {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
    weights: Weights = {}
    for layer in range(layers):
        for name, parts in (("W", ["weight_ih"]), ("R", ["weight_hh"]), ("B", ["bias_ih", "bias_hh"])):
            for direction, rows in zip(DIRECTIONS, stored[f"layer_{layer + 1}_{name}"], strict=True):
                for part, half in zip(parts, np.split(rows, len(parts)), strict=True):
                    weights[f"lstm.{part}_l{layer}{direction}"] = _regated(half, ONNX_GATES, TORCH_GATES)
    weights["head.weight"] = stored["head_weight"].T
    weights["head.bias"] = stored["head_bias"]
    return weights


def build(weights: Weights, layers: int, description: str) -> onnx.ModelProto:
    """State dict of `BiLSTM`, float32, to the model; `description` is its metadata, JSON text."""
    hidden = weights["lstm.weight_hh_l0"].shape[1]
    feature_size = weights["lstm.weight_ih_l0"].shape[1]
    action_size = weights["head.weight"].shape[0]
    constants: dict[str, NDArray] = dict(initializers(weights, layers))
    nodes: list[onnx.NodeProto] = []

    def add(op: str, inputs: list[str], outputs: str | list[str], **attributes: Any) -> str:
        outputs = [outputs] if isinstance(outputs, str) else outputs
        nodes.append(helper.make_node(op, inputs, outputs, name=f"{op}:{outputs[0]}", **attributes))
        return outputs[0]

    def whole_numbers(name: str, values: list[int]) -> str:
        constants[name] = np.array(values, dtype=np.int64)
        return name

    # z is 0 while every input is finite, and NaN otherwise: an LSTM kernel may turn a NaN into a plausible actuation.
    received = add("Concat", list(FROM_NEIGHBOURS), "received", axis=0)  # (4 L, 1, H)
    add("ReduceSum", [FEATURES], "sum_of_features", keepdims=0)
    add("ReduceSum", [received], "sum_of_received", keepdims=0)
    add("Add", ["sum_of_features", "sum_of_received"], "sum_of_inputs")
    guard = add("Sub", ["sum_of_inputs", "sum_of_inputs"], "nan_guard")

    sequence = add("Reshape", [FEATURES, whole_numbers("sequence_shape", [-1, 1, feature_size])], "layer_0")  # N, 1, F
    final_h, final_c = [], []
    pair_shape = whole_numbers("both_directions", [-1, 1, 2 * hidden])
    for layer in range(layers):
        here = f"layer_{layer + 1}"
        h_rows = whole_numbers(f"{here}_h_rows", [layer, 2 * layers + layer])
        c_rows = whole_numbers(f"{here}_c_rows", [layers + layer, 3 * layers + layer])
        h_initial = add("Gather", [received, h_rows], f"{here}_h_initial", axis=0)  # (2, 1, H): base, tip
        c_initial = add("Gather", [received, c_rows], f"{here}_c_initial", axis=0)
        final_h.append(f"{here}_h")
        final_c.append(f"{here}_c")
        add(
            "LSTM",
            [sequence, f"{here}_W", f"{here}_R", f"{here}_B", "", h_initial, c_initial],
            [f"{here}_Y", final_h[-1], final_c[-1]],  # Y (N, 2, 1, H)
            direction="bidirectional",
            hidden_size=hidden,
        )
        sequence = add("Reshape", [f"{here}_Y", pair_shape], here)  # (N, 1, 2 H)

    add("MatMul", [sequence, "head_weight"], "head_product")
    add("Add", ["head_product", "head_bias"], "head")  # (N, 1, A)
    add("Reshape", ["head", whole_numbers("actuation_shape", [1, -1, action_size])], "unguarded")
    add("Add", ["unguarded", guard], ACTUATION)

    add("Concat", final_h + final_c, "final_states", axis=0)  # (4 L, 1, H): h then c, each by layer: to tip, to base
    sent = add("Add", ["final_states", guard], "sent")
    for name in TO_NEIGHBOURS:
        first = 2 * layers * name.startswith("c") + name.endswith("base")
        rows = whole_numbers(f"{name}_rows", [first + 2 * layer for layer in range(layers)])
        add("Gather", [sent, rows], name, axis=0)

    def value(name: str, *shape: int | str) -> onnx.ValueInfoProto:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)

    defaults = {name: np.zeros((layers, 1, hidden), dtype=np.float32) for name in FROM_NEIGHBOURS}
    graph = helper.make_graph(
        nodes,
        "bilstm_unit",
        inputs=[value(FEATURES, 1, "N", feature_size), *(value(name, layers, 1, hidden) for name in FROM_NEIGHBOURS)],
        outputs=[value(ACTUATION, 1, "N", action_size), *(value(name, layers, 1, hidden) for name in TO_NEIGHBOURS)],
        initializer=[numpy_helper.from_array(array, name) for name, array in {**constants, **defaults}.items()],
        doc_string="The biLSTM unit over N contiguous modules, index 0 nearest the base; N = 1 is one module's unit.",
    )
    model = helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION, producer_name="modsoft-export"
    )
    helper.set_model_props(model, {METADATA_KEY: description})
    return model
