"""Printing of the content of a model file."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import msgspec
import onnx

from modsoft.runtime.control.model import Model
from modsoft.runtime.entry_point import printable


def print_model(path: Path) -> None:
    """Verifies the file as the runtime does (`ModelError`), then prints its graph and its description."""
    description = Model.load(path).description
    model = onnx.load(path, load_external_data=False)
    operators = Counter(node.op_type for node in model.graph.node)
    print(f"{path}: {path.stat().st_size} bytes; checksum, description and golden pairs are valid")
    print(f"graph: IR version {model.ir_version}, opset {model.opset_import[0].version}, {operators.total()} nodes")
    print(f"  operators: {', '.join(f'{count} {name}' for name, count in sorted(operators.items()))}")
    defaults = {tensor.name for tensor in model.graph.initializer}
    for direction, values in (("in ", model.graph.input), ("out", model.graph.output)):
        for value in values:
            shape = ", ".join(d.dim_param or str(d.dim_value) for d in value.type.tensor_type.shape.dim)
            print(f"  {direction} {value.name} [{shape}]{' default 0' if value.name in defaults else ''}")
    plain = msgspec.to_builtins(description)
    golden = plain.pop("golden")
    _print_table(plain, 0)
    for pair in golden:
        _print_table({f"golden pair, {len(pair['features'])} modules": pair}, 0)


def _print_table(table: dict[str, Any], depth: int) -> None:
    for name, value in ((printable(name), value) for name, value in table.items()):
        if isinstance(value, dict):
            print(f"{'  ' * depth}{name}:")
            _print_table(value, depth + 1)
        elif isinstance(value, list) and value and isinstance(value[0], list | dict):
            print(f"{'  ' * depth}{name}:")
            for row in value:
                print(f"{'  ' * (depth + 1)}{_short(row)}")
        else:
            print(f"{'  ' * depth}{name}: {_short(value)}")


def _short(value: Any) -> str:
    if isinstance(value, list):
        return ", ".join(_short(entry) for entry in value)
    return f"{value:.6g}" if isinstance(value, float) else printable(str(value))
