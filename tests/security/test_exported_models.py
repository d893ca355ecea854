"""An untrusted ONNX model reads no other file, and is refused in one line."""

import os

import numpy as np
import onnx
import pytest
from corrupted_models import onnx_description, write_model
from onnx import TensorProto, helper

from modsoft.export import cli as export_cli
from modsoft.export import inspect
from modsoft.hil import cli as hil_cli
from modsoft.runtime import cli as runtime_cli
from modsoft.runtime.control import model_file as model_files
from modsoft.runtime.control.model import Model
from modsoft.runtime.control.ort import onnxruntime


def largest_weight(model):
    return max(model.graph.initializer, key=lambda tensor: len(tensor.raw_data))


def make_external(tensor, location):
    """Moves the tensor's values into the file `location`; the model works if that file is read."""
    with open(os.path.basename(location), "wb") as file:
        file.write(tensor.raw_data)
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    for key, value in (("location", location), ("offset", "0")):
        tensor.external_data.add(key=key, value=value)


def move_into_branch(model):
    """Moves the largest weight into both branches of an If, where onnxruntime does not restrict the location of
    external data. Returns the tensors of the branches."""
    weight, graph = largest_weight(model), model.graph
    inner = TensorProto()
    inner.CopyFrom(weight)
    inner.name = "inner"
    out = helper.make_tensor_value_info("value", TensorProto.FLOAT, list(weight.dims))
    branch = helper.make_graph([helper.make_node("Identity", ["inner"], ["value"])], "branch", [], [out], [inner])
    node = helper.make_node("If", ["always"], [weight.name], then_branch=branch, else_branch=branch)
    graph.initializer.remove(weight)
    graph.initializer.append(helper.make_tensor("always", TensorProto.BOOL, [], [True]))
    nodes = [node, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)
    return [attribute.g.initializer[0] for attribute in graph.node[0].attribute]


@pytest.mark.parametrize("place", ["initializer", "branch"])
@pytest.mark.parametrize("location", ["weights.bin", "./weights.bin", "{folder}/weights.bin", "../{name}/weights.bin"])
def test_weights_in_another_file_are_refused(tmp_path, monkeypatch, model_file, place, location, refused):
    monkeypatch.chdir(tmp_path)
    model, path = onnx.load(model_file), tmp_path / "model.onnx"
    tensors = move_into_branch(model) if place == "branch" else [largest_weight(model)]
    write_model(path, model, onnx_description(model))
    Model.load(path)  # valid so far
    for tensor in tensors:
        make_external(tensor, location.format(folder=tmp_path, name=tmp_path.name))
    write_model(path, model, onnx_description(model))
    refused(Model.load, path, "onnxruntime .* refuses it")


@pytest.mark.parametrize(
    ("main", "before", "after"),
    [
        (export_cli.main, ["--inspect"], []),
        (runtime_cli.main, ["--yes", "--robot", "pneumatic-3", "--task", "down", "--port", os.devnull, "--model"], []),
        (hil_cli.main, ["--robot", "pneumatic-3", "--task", "down", "--model"], ["--report", "out"]),
    ],
)
def test_commands_exit_with_65(tmp_path, monkeypatch, model_file, main, before, after, ended):
    monkeypatch.chdir(tmp_path)
    model, path = onnx.load(model_file), tmp_path / "model.onnx"
    make_external(largest_weight(model), "/etc/hostname")
    write_model(path, model, onnx_description(model))
    files_before = set(tmp_path.iterdir())
    code, lines = ended(main, *before, path, *after)
    assert (code, len(lines)) == (65, 1), lines
    assert set(tmp_path.iterdir()) == files_before


def test_control_characters_in_the_provenance_are_escaped(tmp_path, model_file, capfd):
    clear = "\x1b[2J"
    model, path = onnx.load(model_file), tmp_path / "model.onnx"
    description = {**onnx_description(model), "provenance": {f"seed{clear}": f"1{clear}"}}
    write_model(path, model, description)
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
def test_unreadable_description_is_refused(tmp_path, model_file, refused, before, after):
    content = model_file.read_bytes()
    if len(before) == len(after):
        content = content.replace(before, after)
    else:  # an entry of the metadata, whose length is part of the file
        model = onnx.load(model_file)
        padding = "@" * (len(after) - len(before))
        (entry,) = model.metadata_props
        entry.value = entry.value.replace(before.decode(), before.decode() + padding)
        content = model.SerializeToString().replace(before + padding.encode(), after)
    checksum = model_files._CHECKSUM_FIELD.search(content)[1]
    (tmp_path / "model.onnx").write_bytes(
        model_files.with_checksum(content.replace(checksum, model_files.CHECKSUM_PLACEHOLDER.encode()))
    )
    refused(Model.load, tmp_path / "model.onnx", "UTF-8|description cannot be read|refuses it")


def test_weights_at_a_memory_address_are_refused(tmp_path, monkeypatch, model_file, refused):
    monkeypatch.chdir(tmp_path)
    model, path = onnx.load(model_file), tmp_path / "model.onnx"
    tensor = largest_weight(model)
    values = np.frombuffer(tensor.raw_data, dtype=np.uint8).copy()
    make_external(tensor, "weights.bin")
    tensor.external_data[0].value, tensor.external_data[1].value = "*/_ORT_MEM_ADDR_/*", str(values.ctypes.data)
    write_model(path, model, onnx_description(model))
    refused(Model.load, path, "onnxruntime .* refuses it")


def test_ort_format_is_refused(tmp_path, model_file, refused):
    options, path = onnxruntime.SessionOptions(), tmp_path / "model.ort"
    options.optimized_model_filepath = str(path)
    options.add_session_config_entry("session.save_model_format", "ORT")
    options.log_severity_level = 4
    onnxruntime.InferenceSession(model_file, options)
    content = path.read_bytes()
    onnxruntime.InferenceSession(content)  # accepted while the format is not restricted
    checksum = model_files._CHECKSUM_FIELD.search(content)[1]
    path.write_bytes(model_files.with_checksum(content.replace(checksum, model_files.CHECKSUM_PLACEHOLDER.encode())))
    refused(Model.load, path, "onnxruntime .* refuses it")
