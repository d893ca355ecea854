"""The graph, compared with torch and with the reference evaluator of onnx."""

import numpy as np
import onnx
import pytest
import torch
from onnx.reference import ReferenceEvaluator

from modsoft.export import bilstm_graph
from modsoft.runtime.control.model import open_unit
from modsoft.runtime.control.model_file import ACTUATION, FEATURES, FROM_NEIGHBOURS, TO_NEIGHBOURS, Network
from modsoft.training.networks import BiLSTM

pytestmark = pytest.mark.instructions

F, A = 7, 2


def sizes(layers, hidden):
    return Network(name="bilstm", feature_size=F, action_size=A, layers=layers, hidden=hidden, history=1)


def network_and_weights(layers, hidden, seed=0):
    torch.manual_seed(seed)
    network = BiLSTM(F, A, layers, hidden).eval()
    return network, {name: tensor.numpy() for name, tensor in network.state_dict().items()}


def features(modules, seed=1):
    return np.random.default_rng(seed).uniform(-1, 1, (modules, F)).astype(np.float32)


@pytest.mark.parametrize(("layers", "hidden"), [(1, 1), (2, 5), (4, 8)])
def test_weights_are_read_back_bit_for_bit(layers, hidden):
    _, weights = network_and_weights(layers, hidden)
    model = onnx.load_from_string(bilstm_graph.build(weights, sizes(layers, hidden), "{}").SerializeToString())
    stored = bilstm_graph.weights_of(model, sizes(layers, hidden))
    assert stored.keys() == weights.keys()
    for name in weights:
        np.testing.assert_array_equal(stored[name], weights[name])


@pytest.mark.parametrize(("layers", "hidden"), [(1, 3), (2, 5), (4, 8)])
def test_torch_onnxruntime_and_onnx_agree(layers, hidden):
    """For a whole robot, and with neighbours' states as inputs."""
    network, weights = network_and_weights(layers, hidden)
    model = bilstm_graph.build(weights, sizes(layers, hidden), "{}")
    evaluator, unit = ReferenceEvaluator(model), open_unit(model.SerializeToString())
    for modules in (1, 2, 5):
        x = features(modules)
        with torch.no_grad():
            expected = network(torch.from_numpy(x)[None])[0].numpy()
        np.testing.assert_allclose(unit.whole(x), expected, atol=2e-6)
        np.testing.assert_allclose(evaluator.run([ACTUATION], {FEATURES: x[None]})[0][0], expected, atol=2e-6)
        generator = np.random.default_rng(modules)
        states = {n: generator.uniform(-1, 1, (layers, 1, hidden)).astype(np.float32) for n in FROM_NEIGHBOURS}
        inputs = {FEATURES: x[None], **states}
        for name, one, other in zip(
            (ACTUATION, *TO_NEIGHBOURS), evaluator.run(None, inputs), unit.session.run(None, inputs), strict=True
        ):
            np.testing.assert_allclose(one, other, atol=2e-6, err_msg=name)


@pytest.mark.parametrize("layers", [1, 2, 3])
def test_chain_needs_one_sweep_more_than_layers(layers):
    _, weights = network_and_weights(layers, 8)
    unit = open_unit(bilstm_graph.build(weights, sizes(layers, 8), "{}").SerializeToString())
    for modules in (2, 3, 7):
        x = features(modules)
        whole = unit.whole(x)
        np.testing.assert_allclose(unit.chain(x), whole, atol=1e-6)
        np.testing.assert_allclose(unit.chain(x, sweeps=layers + 4), whole, atol=1e-6)  # and remains
        assert np.abs(unit.chain(x, sweeps=layers) - whole).max() > 1e-5


def test_two_segments_equal_the_whole_robot():
    """Two segments that exchange states need as many sweeps as single modules."""
    _, weights = network_and_weights(2, 8)
    unit = open_unit(bilstm_graph.build(weights, sizes(2, 8), "{}").SerializeToString())
    x = features(6)
    to_base, to_tip = {}, {}
    for _ in range(3):
        near = unit.session.run(None, {FEATURES: x[None, :2], **to_base})
        to_tip = {"h_from_base": near[1], "c_from_base": near[2]}
        far = unit.session.run(None, {FEATURES: x[None, 2:], **to_tip})
        to_base = {"h_from_tip": far[3], "c_from_tip": far[4]}
    near = unit.session.run(None, {FEATURES: x[None, :2], **to_base})
    np.testing.assert_allclose(np.concatenate([near[0][0], far[0][0]]), unit.whole(x), atol=1e-6)


def test_standard_operators_only():
    """Also one LSTM node for each layer, so that a viewer shows the diagram of the paper."""
    _, weights = network_and_weights(4, 8)
    model = bilstm_graph.build(weights, sizes(4, 8), "{}")
    assert {node.domain for node in model.graph.node} == {""}
    assert sum(node.op_type == "LSTM" for node in model.graph.node) == 4
    assert len(model.graph.node) == 32
    assert not any(node.op_type in ("If", "Loop", "Scan") for node in model.graph.node)
