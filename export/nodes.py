"""Building of ONNX graphs: nodes, constants, and the weights of an LSTM in the order of torch and of ONNX."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from modsoft.runtime.control.model_file import IR_VERSION, METADATA_KEY, OPSET

Weights = dict[str, NDArray[np.float32]]
TORCH_GATES, ONNX_GATES = "ifco", "iofc"  # order of the four gates' rows: input, output, forget, cell
PARTS = (("W", ["weight_ih"]), ("R", ["weight_hh"]), ("B", ["bias_ih", "bias_hh"]))  # names of ONNX and torch


class Nodes:
    """Nodes and constants of a graph under construction."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: dict[str, NDArray] = {}

    def add(self, op: str, inputs: Sequence[str], outputs: str | list[str], **attributes: Any) -> str:
        """Adds a node; returns the name of its first output."""
        outputs = [outputs] if isinstance(outputs, str) else outputs
        self.nodes.append(helper.make_node(op, inputs, outputs, name=f"{op}:{outputs[0]}", **attributes))
        return outputs[0]

    def whole_numbers(self, name: str, values: int | list[int]) -> str:
        """Adds an int64 constant (a shape, indices, an axis); returns its name."""
        self.constants[name] = np.array(values, dtype=np.int64)
        return name

    def model(
        self,
        name: str,
        inputs: Mapping[str, tuple[int | str, ...]],
        outputs: Mapping[str, tuple[int | str, ...]],
        description: str,
        what: str,
    ) -> onnx.ModelProto:
        """The model. inputs, outputs: names and shapes, float32; description: metadata, JSON text; what: comment of the
        graph, for viewers."""

        def values(shapes: Mapping[str, tuple[int | str, ...]]) -> list[onnx.ValueInfoProto]:
            return [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in shapes.items()]

        tensors = [numpy_helper.from_array(array, name) for name, array in self.constants.items()]
        graph = helper.make_graph(self.nodes, name, values(inputs), values(outputs), tensors, doc_string=what)
        opsets = [helper.make_opsetid("", OPSET)]
        model = helper.make_model(graph, opset_imports=opsets, ir_version=IR_VERSION, producer_name="modsoft-export")
        helper.set_model_props(model, {METADATA_KEY: description})
        return model


def _reordered(rows: NDArray[np.float32], old: str, new: str) -> NDArray[np.float32]:
    """Reorders the rows of four gates (4 H, ...)."""
    gates = dict(zip(old, np.split(rows, 4), strict=True))
    return np.concatenate([gates[gate] for gate in new])


def initializers(weights: Weights, layers: int, directions: Sequence[str], prefix: str = "") -> Weights:
    """Weights of a graph from torch's state dict under `prefix`: W (D, 4 H, in), R (D, 4 H, H) and B (D, 8 H) of each
    layer, and the head. directions: torch's D suffixes."""
    tensors: Weights = {}
    for layer in range(layers):
        for name, parts in PARTS:
            tensors[f"{prefix}layer_{layer + 1}_{name}"] = np.stack(
                [
                    np.concatenate(
                        [
                            _reordered(weights[f"{prefix}lstm.{part}_l{layer}{direction}"], TORCH_GATES, ONNX_GATES)
                            for part in parts
                        ]
                    )
                    for direction in directions
                ]
            )
    tensors[f"{prefix}head_weight"] = np.ascontiguousarray(weights[f"{prefix}head.weight"].T)
    tensors[f"{prefix}head_bias"] = weights[f"{prefix}head.bias"]
    return tensors


def weights_of(model: onnx.ModelProto, layers: int, directions: Sequence[str], prefix: str = "") -> Weights:
    """The state dict of a graph: the inverse of `initializers`. KeyError for a missing weight."""
    stored = {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
    weights: Weights = {}
    for layer in range(layers):
        for name, parts in PARTS:
            for direction, rows in zip(directions, stored[f"{prefix}layer_{layer + 1}_{name}"], strict=True):
                for part, half in zip(parts, np.split(rows, len(parts)), strict=True):
                    weights[f"{prefix}lstm.{part}_l{layer}{direction}"] = _reordered(half, ONNX_GATES, TORCH_GATES)
    weights[f"{prefix}head.weight"] = stored[f"{prefix}head_weight"].T
    weights[f"{prefix}head.bias"] = stored[f"{prefix}head_bias"]
    return weights
