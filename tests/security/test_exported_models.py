"""An ONNX model from a stranger reads nothing but itself, and is refused in one line."""

import os

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper
from spoilt_models import onnx_description, sealed_at

from modsoft.export import cli as export_cli
from modsoft.export import inspect
from modsoft.hil import cli as hil_cli
from modsoft.runtime import cli as runtime_cli
from modsoft.runtime.control import model_file as model_files
from modsoft.runtime.control.model import Model
from modsoft.runtime.control.ort import onnxruntime


def largest_weight(model):
    return max(model.graph.initializer, key=lambda tensor: len(tensor.raw_data))


def outside(tensor, location):
    """Puts the tensor's numbers into the file `location`, where the harm of reading it is that the model works."""
    with open(os.path.basename(location), "wb") as file:
        file.write(tensor.raw_data)
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    for key, value in (("location", location), ("offset", "0")):
        tensor.external_data.add(key=key, value=value)


def in_a_branch(model):
    """Moves the largest weight into both branches of an If, and gives it there: onnxruntime reads files for these with
    no word of where they may be."""
    weight, graph = largest_weight(model), model.graph
    inner = TensorProto()
    inner.CopyFrom(weight)
    inner.name = "inner"
    out = helper.make_tensor_value_info("given", TensorProto.FLOAT, list(weight.dims))
    branch = helper.make_graph([helper.make_node("Identity", ["inner"], ["given"])], "branch", [], [out], [inner])
    node = helper.make_node("If", ["always"], [weight.name], then_branch=branch, else_branch=branch)
    graph.initializer.remove(weight)
    graph.initializer.append(helper.make_tensor("always", TensorProto.BOOL, [], [True]))
    nodes = [node, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)
    return [attribute.g.initializer[0] for attribute in graph.node[0].attribute]


@pytest.mark.parametrize("place", ["initializer", "branch"])
@pytest.mark.parametrize("location", ["weights.bin", "./weights.bin", "{folder}/weights.bin", "../{name}/weights.bin"])
def test_a_model_with_weights_in_another_file(tmp_path, monkeypatch, model_file, place, location, refused):
    monkeypatch.chdir(tmp_path)
    model, path = onnx.load(model_file), tmp_path / "model.onnx"
    tensors = in_a_branch(model) if place == "branch" else [largest_weight(model)]
    sealed_at(path, model, onnx_description(model))
    Model.load(path)  # so far it is only an odd model
    for tensor in tensors:
        outside(tensor, location.format(folder=tmp_path, name=tmp_path.name))
    sealed_at(path, model, onnx_description(model))
    refused(Model.load, path, "onnxruntime .* refuses it")


@pytest.mark.parametrize(
    ("main", "before", "after"),
    [
        (export_cli.main, ["--inspect"], []),
        (runtime_cli.main, ["--yes", "--robot", "pneumatic-3", "--task", "down", "--port", os.devnull, "--model"], []),
        (hil_cli.main, ["--robot", "pneumatic-3", "--task", "down", "--model"], ["--report", "out"]),
    ],
)
def test_the_commands_end_with_65(tmp_path, monkeypatch, model_file, main, before, after, ended):
    monkeypatch.chdir(tmp_path)
    model, path = onnx.load(model_file), tmp_path / "model.onnx"
    outside(largest_weight(model), "/etc/hostname")
    sealed_at(path, model, onnx_description(model))
    before_it = set(tmp_path.iterdir())
    code, said = ended(main, *before, path, *after)
    assert (code, len(said)) == (65, 1), said
    assert set(tmp_path.iterdir()) == before_it


def test_what_a_model_says_does_not_command_the_terminal(tmp_path, model_file, capfd):
    """Of all texts, those of the provenance are free."""
    clear = "\x1b[2J"
    model, path = onnx.load(model_file), tmp_path / "model.onnx"
    said = {**onnx_description(model), "provenance": {f"seed{clear}": f"1{clear}"}}
    sealed_at(path, model, said)
    inspect.print_model(path)
    out = capfd.readouterr().out
    assert "seed\\x1b[2J: 1\\x1b[2J" in out
    assert "\x1b" not in out


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (b'"provenance":{', b'"provenance":{"x":' + b"[" * 100_000 + b"]" * 100_000 + b","),
        (b'"provenance":{"', b'"provenance":{"\xff'),
        (model_files.ACTUATION.encode(), b"actuatio\xff"),
    ],
    ids=["deep", "not a text", "no name"],
)
def test_a_description_that_breaks_its_reader(tmp_path, model_file, refused, before, after):
    content = model_file.read_bytes()
    if len(before) == len(after):
        content = content.replace(before, after)
    else:  # an entry of the metadata, in which lengths have to hold
        model = onnx.load(model_file)
        mark = "@" * (len(after) - len(before))
        (entry,) = model.metadata_props
        entry.value = entry.value.replace(before.decode(), before.decode() + mark)
        content = model.SerializeToString().replace(before + mark.encode(), after)
    seal = model_files._SEAL.search(content)[1]
    (tmp_path / "model.onnx").write_bytes(
        model_files.with_checksum(content.replace(seal, model_files.UNSEALED.encode()))
    )
    refused(Model.load, tmp_path / "model.onnx", "UTF-8|description cannot be read|refuses it")


def test_a_model_with_weights_at_an_address_of_the_memory(tmp_path, monkeypatch, model_file, refused):
    monkeypatch.chdir(tmp_path)
    model, path = onnx.load(model_file), tmp_path / "model.onnx"
    tensor = largest_weight(model)
    numbers = np.frombuffer(tensor.raw_data, dtype=np.uint8).copy()
    outside(tensor, "weights.bin")
    tensor.external_data[0].value, tensor.external_data[1].value = "*/_ORT_MEM_ADDR_/*", str(numbers.ctypes.data)
    sealed_at(path, model, onnx_description(model))
    refused(Model.load, path, "onnxruntime .* refuses it")


def test_a_model_in_the_other_format_of_onnxruntime(tmp_path, model_file, refused):
    options, path = onnxruntime.SessionOptions(), tmp_path / "model.ort"
    options.optimized_model_filepath = str(path)
    options.add_session_config_entry("session.save_model_format", "ORT")
    options.log_severity_level = 4
    onnxruntime.InferenceSession(model_file, options)
    content = path.read_bytes()
    onnxruntime.InferenceSession(content)  # whoever does not say which format takes both
    seal = model_files._SEAL.search(content)[1]
    path.write_bytes(model_files.with_checksum(content.replace(seal, model_files.UNSEALED.encode())))
    refused(Model.load, path, "onnxruntime .* refuses it")
