"""The networks bound to their number of modules: graph against torch and a third opinion, planted faults, the loop."""

import numpy as np
import onnx
import pytest
import torch
from onnx import numpy_helper
from onnx.reference import ReferenceEvaluator

from modsoft.export import load, write
from modsoft.export.write import export
from modsoft.runtime import robot as robots
from modsoft.runtime.control.model import Model
from modsoft.runtime.control.model_file import ACTUATION, FEATURES
from modsoft.runtime.errors import ModelError
from modsoft.training import checkpoint as checkpoints

pytestmark = pytest.mark.instructions

BOUND = ("lstm", "module-lstm")
N, F = 4, 16  # cable-4 with three time steps


@pytest.fixture(scope="module")
def exported(tmp_path_factory, make_checkpoint):
    """By name of the network: its checkpoint and the export of it."""
    folder = tmp_path_factory.mktemp("bound")
    made = {name: make_checkpoint(folder / f"{name}.pt", "cable-4", name=name) for name in BOUND}
    return {name: (path, export(path)) for name, path in made.items()}


def features(modules=N, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (modules, F)).astype(np.float32)


@pytest.mark.parametrize("name", BOUND)
def test_torch_onnxruntime_and_onnx_agree(exported, name):
    checkpoint, made = exported[name]
    network = checkpoints.network_of(checkpoints.load(checkpoint))
    evaluator, controller = ReferenceEvaluator(onnx.load(made.path)), Model.load(made.path)
    for seed in range(5):
        x = features(seed=seed)
        with torch.no_grad():
            expected = network(torch.from_numpy(x)[None])[0].numpy()
        np.testing.assert_allclose(controller.actuate(x), expected, atol=2e-6)
        np.testing.assert_allclose(evaluator.run([ACTUATION], {FEATURES: x[None]})[0][0], expected, atol=2e-6)


@pytest.mark.parametrize("name", BOUND)
def test_description_says_what_it_is_bound_to(exported, name):
    said = exported[name][1].description
    assert (said.network.name, said.network.modules, said.sequence_axis) == (name, N, "time")
    assert [len(pair.features) for pair in said.golden] == [N]
    assert list(exported[name][1].report.fused) == [N]


@pytest.mark.parametrize("name", BOUND)
@pytest.mark.parametrize("modules", [2, 3, 5, 6])
def test_another_number_of_modules_is_refused(exported, name, modules):
    controller = Model.load(exported[name][1].path)
    with pytest.raises(ModelError, match=f"of {modules} modules, expected 4: the network {name} has a fixed number"):
        controller.actuate(features(modules))


def test_check_refuses_a_robot_of_another_number_of_modules(exported):
    controller = Model.load(exported["lstm"][1].path)
    controller.check(robots.load("cable-4"))
    with pytest.raises(ModelError, match="trained for modules 4; robot cable-6 has modules 6"):
        controller.check(robots.load("cable-6"))


@pytest.mark.parametrize("name", BOUND)
def test_full_size(tmp_path, make_checkpoint, name):
    """Table S1's network, also with weights large enough to saturate it."""
    made = export(make_checkpoint(tmp_path / "model.pt", "cable-4", 5, layers=4, hidden=128, gain=3.0, name=name))
    assert max(made.report.fused.values()) <= made.report.bound


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
    else:  # the base's outputs for the tip
        change(model, "head_weight", lambda w: w.reshape(len(w), N, -1)[:, ::-1].reshape(w.shape))


def bypassed_guard(model):
    node_of(model, ACTUATION).input[1] = "zero"
    model.graph.initializer.append(numpy_helper.from_array(np.zeros((), np.float32), "zero"))


def guard_deaf_to_the_label(model):
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
    guard_deaf_to_the_label,
    backwards_in_time,
]


@pytest.mark.parametrize("name", BOUND)
@pytest.mark.parametrize("fault", FAULTS)
def test_export_refuses_each_fault_and_leaves_nothing(exported, name, fault, tmp_path, monkeypatch):
    build = write.bilstm_graph.build

    def spoilt(*arguments):
        model = build(*arguments)
        fault(model)
        return model

    monkeypatch.setattr(write.bilstm_graph, "build", spoilt)
    with pytest.raises(ModelError, match="not written"):
        export(exported[name][0], tmp_path / "model.onnx")
    assert list(tmp_path.iterdir()) == []


def test_bound_to_another_number_than_its_robot_has(exported, tmp_path):
    stored = checkpoints.load(exported["lstm"][0])
    checkpoints.save({**stored, "network": {**stored["network"], "modules": 5}}, tmp_path / "model.pt")
    with pytest.raises(ModelError, match="lstm of 5 modules, expected 4"):
        load.read(tmp_path / "model.pt")
