"""Export of a checkpoint to a model file, which is verified under a temporary name and then renamed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from modsoft.export import bilstm_graph, load, parity
from modsoft.export.nodes import Weights
from modsoft.runtime import robot as robot_file
from modsoft.runtime.control import model_file
from modsoft.runtime.control.model import Model
from modsoft.runtime.control.model_file import Description, Golden, Network
from modsoft.runtime.errors import ModelError, UsageError
from modsoft.runtime.files import check_not_input, check_writable, written
from modsoft.training import checkpoint as checkpoints

GOLDEN_MODULES = (2, 4)  # for a network for any number


@dataclass(frozen=True)
class Exported:
    """A verified model file."""

    path: Path
    description: Description
    report: parity.Report


def export(model: str | Path, out: str | Path | None = None, meta: str | Path | None = None) -> Exported:
    """Exports the checkpoint `model` to `out`, by default `model.onnx` beside it.

    Raises `ModelError` if the checkpoint or the exported file fails a check; an existing file at `out` is then left
    unchanged. `UsageError` and `OutputError` for an unsuitable `out`.
    """
    model = Path(model)
    out, is_default = (model.with_suffix(".onnx"), True) if out is None else (Path(out), False)
    check_writable(out)
    if model.suffix == ".onnx":
        raise UsageError(f"{model}: is ONNX already; did you mean modsoft-export --inspect {model}?")
    check_not_input(out, model, *([] if meta is None else load.files_of(Path(meta))))
    if is_default and out.exists() and out != model:
        _check_own(out)
    checkpoint = load.read(model, None if meta is None else Path(meta))
    network, sizes = checkpoints.network_of(checkpoint), load.network_of(checkpoint)
    expected = parity.reference(network, sizes)
    weights = {name: tensor.numpy() for name, tensor in network.state_dict().items()}
    described = describe(checkpoint, sizes, weights, expected)
    try:
        text = msgspec.json.encode(described).decode()
    except TypeError as error:
        raise ModelError(f"{model}: provenance with a value that JSON does not have ({error})") from error
    content = model_file.with_checksum(bilstm_graph.build(weights, sizes, text).SerializeToString())

    with written(out) as temporary:
        temporary.write_bytes(content)
        try:
            report = parity.verify(temporary, network, sizes, expected)
            described = Model.load(temporary).description  # as at the start of a run
        except ModelError as error:
            raise ModelError(f"{out} not written: {str(error).replace(str(temporary), out.name)}") from error
    return Exported(out, described, report)


def _check_own(out: Path) -> None:
    """`UsageError` if the file at the default output is not a model of modsoft-export."""
    try:
        model_file.read(out)
    except ModelError as error:
        raise UsageError(f"{out}: exists, not a model of modsoft-export; give --out {out}, or delete it") from error


def describe(checkpoint: dict[str, Any], sizes: Network, weights: Weights, expected: parity.Reference) -> Description:
    """The description of the exported model, with the placeholder of the checksum."""
    robot = robot_file.from_dict(checkpoint["robot"])
    return Description(
        schema=model_file.SCHEMA,
        file_sha256=model_file.CHECKSUM_PLACEHOLDER,
        weights_sha256=parity.weights_sha256(weights),
        opset=model_file.OPSET,
        ir_version=model_file.IR_VERSION,
        sequence_axis=sizes.sequence_axis,
        layout=model_file.layout_of(robot),
        state_size=robot.state_size,
        action_size=robot.action_size,
        period_s=robot.loop.period_s,
        modules_trained_on=[robot.modules],
        features=list(checkpoint["features"]),
        label=model_file.LABEL,
        network=sizes,
        tolerance=expected.tolerance,
        golden=[
            Golden(features=expected.features[n][0].tolist(), actuation=expected.actuation[n][0].tolist())
            for n in (GOLDEN_MODULES if sizes.modules is None else [sizes.modules])
        ],
        robot=checkpoint["robot"],
        provenance=checkpoint["provenance"],
    )
