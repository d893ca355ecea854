"""Injected faults: each check detects its faults, and the export refuses all of them."""

import numpy as np
import onnx
import pytest
import torch
from onnx import helper, numpy_helper

from modsoft.export import bilstm_graph, load, parity, write
from modsoft.export.write import export
from modsoft.runtime.control.model import open_unit
from modsoft.runtime.errors import ModelError
from modsoft.training import checkpoint as checkpoints

pytestmark = pytest.mark.instructions


def change(model, name, function):
    """Replaces the initializer `name` by function(array)."""
    for tensor in model.graph.initializer:
        if tensor.name == name:
            array = numpy_helper.to_array(tensor).copy()
            tensor.CopyFrom(numpy_helper.from_array(np.ascontiguousarray(function(array)), name))
            return
    raise KeyError(name)


def node_of(model, output):
    return next(node for node in model.graph.node if output in node.output)


def swapped_gates(model):
    def swap(w):
        i, o, f, c = np.split(w, 4, axis=1)
        return np.concatenate([i, f, o, c], axis=1)

    change(model, "layer_2_W", swap)


def swapped_directions(model):
    for part in "WRB":
        change(model, f"layer_1_{part}", lambda array: array[::-1])


def dropped_recurrent_bias(model):
    change(model, "layer_1_B", lambda b: b * (np.arange(b.shape[1]) < b.shape[1] // 2).astype(np.float32))


def another_layers_weights(model):
    node_of(model, "layer_2_Y").input[2] = "layer_1_R"


def one_changed_weight(model):
    def nudge(w):
        w[0, 3, 1] = np.nextafter(w[0, 3, 1], np.float32(9))
        return w

    change(model, "layer_2_R", nudge)


def swapped_neighbours(model):
    change(model, "layer_1_h_rows", lambda rows: rows[::-1])


def swapped_outputs(model):
    for one, other in (("h_to_tip_rows", "h_to_base_rows"), ("c_to_tip_rows", "c_to_base_rows")):
        a, b = node_of(model, one[:-5]), node_of(model, other[:-5])
        a.input[1], b.input[1] = b.input[1], a.input[1]


def layer_without_neighbours(model):
    lstm = node_of(model, "layer_2_Y")
    lstm.input[5], lstm.input[6] = "", ""


def bypassed_guard(model):
    node_of(model, "actuation").input[1] = "zero"
    model.graph.initializer.append(numpy_helper.from_array(np.zeros((), np.float32), "zero"))


def guard_without_neighbours(model):
    node_of(model, "sum_of_inputs").input[1] = "sum_of_features"


def guard_without_the_label(model):
    """Sums all features but the last."""
    node = node_of(model, "sum_of_features")
    size = model.graph.input[0].type.tensor_type.shape.dim[2].dim_value
    at = list(model.graph.node).index(node)
    for name, value in (("ends", [size - 1]), ("starts", [0]), ("axes", [2])):
        model.graph.initializer.append(numpy_helper.from_array(np.array(value, np.int64), name))
    model.graph.node.insert(at, helper.make_node("Slice", ["features", "starts", "ends", "axes"], ["some"]))
    node.input[0] = "some"


def frozen_module_number(model):
    for value in (model.graph.input[0], model.graph.output[0]):
        value.type.tensor_type.shape.dim[1].dim_value = 3


def missing_weight(model):
    tensor = next(tensor for tensor in model.graph.initializer if tensor.name == "layer_1_W")
    model.graph.initializer.remove(tensor)


def another_opset(model):
    model.opset_import[0].version = 20


FAULTS = {
    fault.__name__: fault
    for fault in (
        swapped_gates,
        swapped_directions,
        dropped_recurrent_bias,
        another_layers_weights,
        one_changed_weight,
        swapped_neighbours,
        swapped_outputs,
        layer_without_neighbours,
        bypassed_guard,
        guard_without_neighbours,
        guard_without_the_label,
        frozen_module_number,
        missing_weight,
        another_opset,
    )
}

# Faults that each check detects on its own.
CHECKS = {
    "graph": {"missing_weight", "another_opset"},
    "weights": {
        "swapped_gates",
        "swapped_directions",
        "dropped_recurrent_bias",
        "one_changed_weight",
        "missing_weight",
    },
    "whole": {
        "swapped_gates",
        "swapped_directions",
        "dropped_recurrent_bias",
        "another_layers_weights",
        "frozen_module_number",  # refused when the graph's interface is checked
    },
    "chain": {"swapped_neighbours", "swapped_outputs", "layer_without_neighbours"},
    "guard": {"bypassed_guard", "guard_without_neighbours", "guard_without_the_label"},
}


def loaded(checkpoint):
    """The network in a checkpoint, and its sizes."""
    stored = checkpoints.load(checkpoint)
    return checkpoints.network_of(stored), load.network_of(stored)


@pytest.fixture(scope="module")
def exported(tmp_path_factory, make_checkpoint):
    """A valid export: its checkpoint, network, sizes, reference and model file."""
    checkpoint = make_checkpoint(tmp_path_factory.mktemp("exported") / "model.pt")
    network, sizes = loaded(checkpoint)
    return checkpoint, network, sizes, parity.reference(network, sizes), export(checkpoint).path


def run(check, path, network, sizes, expected):
    weights = {name: tensor.numpy() for name, tensor in network.state_dict().items()}
    if check == "graph":
        return parity.check_graph(path)
    if check == "weights":
        return parity.check_weights(path, weights, sizes)
    if check == "whole":
        return parity.check_whole(open_unit(path.read_bytes()), expected)
    if check == "chain":
        return parity.check_chain(open_unit(path.read_bytes()), expected)
    return parity.check_nan(open_unit(path.read_bytes()), expected)


@pytest.mark.parametrize("check", CHECKS)
def test_valid_file_passes_each_check(check, exported):
    _, network, sizes, expected, path = exported
    run(check, path, network, sizes, expected)


@pytest.mark.parametrize(("check", "fault"), [(check, fault) for check in CHECKS for fault in sorted(CHECKS[check])])
def test_each_check_detects_its_faults(check, fault, exported, tmp_path):
    _, network, sizes, expected, path = exported
    model = onnx.load(path)
    FAULTS[fault](model)
    corrupted = tmp_path / "corrupted.onnx"
    corrupted.write_bytes(model.SerializeToString())
    with pytest.raises(ModelError):
        run(check, corrupted, network, sizes, expected)


def test_every_fault_is_detected_by_a_check():
    assert set(FAULTS) == set().union(*CHECKS.values())


@pytest.mark.parametrize("fault", FAULTS)
def test_export_refuses_each_fault_and_leaves_no_file(fault, exported, tmp_path, monkeypatch):
    checkpoint, *_ = exported
    build = bilstm_graph.build

    def build_with_fault(*arguments):
        model = build(*arguments)
        FAULTS[fault](model)
        return model

    monkeypatch.setattr(write.bilstm_graph, "build", build_with_fault)
    with pytest.raises(ModelError, match="not written"):
        export(checkpoint, tmp_path / "model.onnx")
    assert list(tmp_path.iterdir()) == []


def test_bound_is_at_least_1e_5_and_at_most_1e_3():
    for torch_error, bound in ((0.0, 1e-5), (1e-7, 1e-5), (2e-5, 2e-4), (1.0, 1e-3)):
        assert parity.Reference({}, {}, torch_error, 2.0).bound == pytest.approx(bound)
    assert parity.Reference({}, {}, 2e-5, 2.0).tolerance == pytest.approx(4e-4)


def test_tolerance_is_a_python_float(make_checkpoint, tmp_path):
    """The bound is a constant for small weights, and a value of numpy where rounding is larger."""
    network, sizes = loaded(make_checkpoint(tmp_path / "model.pt", gain=30.0))
    expected = parity.reference(network, sizes)
    assert type(expected.torch_error) is type(expected.tolerance) is float
    assert expected.torch_error > 0.0


def test_network_that_ignores_its_neighbours_is_refused(exported, tmp_path, make_checkpoint):
    """Negative control: without recurrent weights a chain is exact without the last sweep."""
    network, sizes = loaded(make_checkpoint(tmp_path / "model.pt"))
    with torch.no_grad():
        for name, weight in network.named_parameters():
            if "weight_hh" in name:
                weight.zero_()
            elif "bias" in name and "lstm" in name:  # forget gate closed: no cell state is passed on
                weight[weight.shape[0] // 4 : weight.shape[0] // 2] = -100.0
    expected = parity.reference(network, sizes)
    weights = {name: tensor.numpy() for name, tensor in network.state_dict().items()}
    unit = open_unit(bilstm_graph.build(weights, sizes, "{}").SerializeToString())
    parity.check_whole(unit, expected)
    with pytest.raises(ModelError, match="no difference"):
        parity.check_chain(unit, expected)


def test_network_that_ignores_its_features_is_refused(make_checkpoint, tmp_path):
    with pytest.raises(ModelError, match="depend on the features"):
        export(make_checkpoint(tmp_path / "model.pt", gain=0.0))
    assert [entry.name for entry in tmp_path.iterdir()] == ["model.pt"]


def test_chaotic_network_is_not_compared_over_many_modules(make_checkpoint, tmp_path):
    """With large recurrent weights, rounding errors grow from module to module."""
    network, sizes = loaded(make_checkpoint(tmp_path / "model.pt", layers=4, hidden=64))
    regular = parity.reference(network, sizes)
    assert list(regular.features) == list(parity.MODULES)
    with torch.no_grad():
        for name, weight in network.named_parameters():
            if "weight_hh" in name:
                weight.mul_(40.0)
    chaotic = parity.reference(network, sizes)
    assert list(chaotic.features) == list(chaotic.actuation)
    assert {2, 3, 4} <= set(chaotic.features)
    assert 64 not in chaotic.features
