"""Networks with a fixed number of modules: graphs compared with torch and onnx, and injected faults."""

import numpy as np
import onnx
import pytest
import torch
from onnx import numpy_helper
from onnx.reference import ReferenceEvaluator

from modsoft.export import load, write
from modsoft.export.write import export
from modsoft.runtime import robot as robot_file
from modsoft.runtime.control.model import Model
from modsoft.runtime.control.model_file import ACTUATION, FEATURES
from modsoft.runtime.errors import ModelError
from modsoft.training import checkpoint as checkpoints

pytestmark = pytest.mark.instructions

FIXED = ("lstm", "module-lstm")
N, F = 4, 16  # cable-4 with three time steps


@pytest.fixture(scope="module")
def exported(tmp_path_factory, make_checkpoint):
    """Checkpoint and export, by the name of the network."""
    folder = tmp_path_factory.mktemp("fixed")
    paths = {name: make_checkpoint(folder / f"{name}.pt", "cable-4", name=name) for name in FIXED}
    return {name: (path, export(path)) for name, path in paths.items()}


def features(modules=N, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (modules, F)).astype(np.float32)


@pytest.mark.parametrize("name", FIXED)
def test_torch_onnxruntime_and_onnx_agree(exported, name):
    checkpoint, result = exported[name]
    network = checkpoints.network_of(checkpoints.load(checkpoint))
    evaluator, model = ReferenceEvaluator(onnx.load(result.path)), Model.load(result.path)
    for seed in range(5):
        x = features(seed=seed)
        with torch.no_grad():
            expected = network(torch.from_numpy(x)[None])[0].numpy()
        np.testing.assert_allclose(model.actuate(x), expected, atol=2e-6)
        np.testing.assert_allclose(evaluator.run([ACTUATION], {FEATURES: x[None]})[0][0], expected, atol=2e-6)


@pytest.mark.parametrize("name", FIXED)
def test_description_has_the_number_of_modules(exported, name):
    description = exported[name][1].description
    assert (description.network.name, description.network.modules, description.sequence_axis) == (name, N, "time")
    assert [len(pair.features) for pair in description.golden] == [N]
    assert list(exported[name][1].report.whole) == [N]


@pytest.mark.parametrize("name", FIXED)
@pytest.mark.parametrize("modules", [2, 3, 5, 6])
def test_another_number_of_modules_is_refused(exported, name, modules):
    model = Model.load(exported[name][1].path)
    with pytest.raises(ModelError, match=f"of {modules} modules, expected 4: the network {name} has a fixed number"):
        model.actuate(features(modules))


def test_check_refuses_a_robot_of_another_number_of_modules(exported):
    model = Model.load(exported["lstm"][1].path)
    model.check(robot_file.load("cable-4"))
    with pytest.raises(ModelError, match="trained for modules 4; robot cable-6 has modules 6"):
        model.check(robot_file.load("cable-6"))


@pytest.mark.parametrize("name", FIXED)
def test_network_of_table_s1_is_exported_within_the_bound(tmp_path, make_checkpoint, name):
    """Also with weights large enough to saturate it."""
    result = export(make_checkpoint(tmp_path / "model.pt", "cable-4", 5, layers=4, hidden=128, gain=3.0, name=name))
    assert max(result.report.whole.values()) <= result.report.bound


def change(model, name, function):
    """Replaces the initializer `name` by function(array)."""
    tensor = next(tensor for tensor in model.graph.initializer if tensor.name == name)
    array = np.ascontiguousarray(function(numpy_helper.to_array(tensor).copy()))
    tensor.CopyFrom(numpy_helper.from_array(array, name))


def node_of(model, output):
    return next(node for node in model.graph.node if output in node.output)


def first_slot_instead_of_the_last(model):
    change(model, "last", lambda index: index * 0)


def one_changed_weight(model):
    def nudge(weights):
        weights[0, 3, 1] = np.nextafter(weights[0, 3, 1], np.float32(9))
        return weights

    name = next(tensor.name for tensor in model.graph.initializer if tensor.name.endswith("layer_2_R"))
    change(model, name, nudge)


def time_and_modules_mixed_up(model):
    node_of(model, "slots").attribute[0].ints[:] = [0, 1, 2]
    change(model, "slots_shape", lambda shape: shape[[1, 0, 2]])


def modules_in_the_other_order(model):
    heads = node_of(model, "heads").input
    if len(heads) > 1:
        heads[:] = heads[::-1]
    else:  # outputs of the base for the tip
        change(model, "head_weight", lambda w: w.reshape(len(w), N, -1)[:, ::-1].reshape(w.shape))


def bypassed_guard(model):
    node_of(model, ACTUATION).input[1] = "zero"
    model.graph.initializer.append(numpy_helper.from_array(np.zeros((), np.float32), "zero"))


def guard_without_the_label(model):
    node = node_of(model, "sum_of_features")
    node.input[0] = "window"
    at, window = list(model.graph.node).index(node), list(model.graph.node).index(node_of(model, "window"))
    model.graph.node.insert(at, model.graph.node.pop(window))


def backwards_in_time(model):
    for node in model.graph.node:
        if node.op_type == "LSTM":
            node.attribute.append(onnx.helper.make_attribute("direction", "reverse"))


FAULTS = [
    first_slot_instead_of_the_last,
    one_changed_weight,
    time_and_modules_mixed_up,
    modules_in_the_other_order,
    bypassed_guard,
    guard_without_the_label,
    backwards_in_time,
]


@pytest.mark.parametrize("name", FIXED)
@pytest.mark.parametrize("fault", FAULTS)
def test_export_refuses_each_fault_and_leaves_no_file(exported, name, fault, tmp_path, monkeypatch):
    build = write.bilstm_graph.build

    def build_with_fault(*arguments):
        model = build(*arguments)
        fault(model)
        return model

    monkeypatch.setattr(write.bilstm_graph, "build", build_with_fault)
    with pytest.raises(ModelError, match="not written"):
        export(exported[name][0], tmp_path / "model.onnx")
    assert list(tmp_path.iterdir()) == []


def test_network_for_another_number_than_its_robot_is_refused(exported, tmp_path):
    stored = checkpoints.load(exported["lstm"][0])
    checkpoints.save({**stored, "network": {**stored["network"], "modules": 5}}, tmp_path / "model.pt")
    with pytest.raises(ModelError, match="lstm of 5 modules, expected 4"):
        load.read(tmp_path / "model.pt")
