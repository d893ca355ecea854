"""The networks: the inputs that each output depends on, and invalid arguments."""

import numpy as np
import pytest
import torch

from modsoft.runtime.choices import NETWORKS
from modsoft.runtime.control.features import feature_names, features
from modsoft.runtime.errors import ModelError
from modsoft.training import networks

pytestmark = pytest.mark.instructions

N, T, S, A = 4, 5, 3, 2  # the cable robot of four modules


def described(name, **changes):
    sizes = {"feature_size": T * (S + A) + 1, "action_size": A, "layers": 2, "hidden": 8, "history": T, "modules": N}
    return {"name": name, **sizes, **changes}


def built(name, **changes):
    torch.manual_seed(0)
    return networks.build(described(name, **changes)).eval()


def windows(count=3, modules=N, seed=0):
    """Features (B, N, F) in the layout of the runtime, and the states and actions in them."""
    rng = np.random.default_rng(seed)
    states, actions = rng.uniform(-1, 1, (count, T, modules, S)), rng.uniform(-1, 1, (count, T, modules, A))
    return torch.from_numpy(features(states, actions)).float(), states, actions


def heard(network, x):
    """For each output (module, action) whether it depends on each feature: (N, F) booleans by output module."""
    x = x[:1].clone().requires_grad_()
    dependencies = []
    for module in range(N):
        (slope,) = torch.autograd.grad(network(x)[0, module].sum(), x)
        dependencies.append(slope[0] != 0)
    return torch.stack(dependencies)  # (N out, N in, F)


def test_every_network_gives_the_actuation_of_every_module():
    x, _, _ = windows()
    for name in NETWORKS:
        assert built(name)(x).shape == (3, N, A)


def test_lstm_gets_all_modules_slot_by_slot():
    """Against a plain LSTM on the states and actions."""
    network = built("lstm")
    x, states, actions = windows()
    by_hand = torch.zeros(3, T, N * (S + A))
    for k in range(T):
        for i in range(N):
            at = i * (S + A)
            by_hand[:, k, at : at + S] = torch.from_numpy(states[:, k, i])
            by_hand[:, k, at + S : at + S + A] = torch.from_numpy(actions[:, k, i])
    hidden, _ = network.lstm(by_hand)
    expected = network.head(hidden[:, -1]).reshape(3, N, A)
    torch.testing.assert_close(network(x), expected)


def test_module_lstm_uses_only_its_module_and_shares_no_weight():
    network = built("module-lstm")
    x, _, _ = windows()
    depends = heard(network, x)
    for module in range(N):
        others = torch.cat([depends[module, :module], depends[module, module + 1 :]])
        assert not others.any()
        assert depends[module, module, :-1].all()
    same = x.clone()
    same[:] = x[:, :1]  # the same features for all modules
    outputs = network(same)
    assert all(not torch.equal(outputs[:, 0], outputs[:, i]) for i in range(1, N))


@pytest.mark.parametrize("name", ["lstm", "module-lstm"])
def test_bound_networks_do_not_use_the_label(name):
    x, _, _ = windows()
    assert feature_names("spatial", T)[-1] == "label"
    assert not heard(built(name), x)[..., -1].any()
    assert heard(built("bilstm"), x)[..., -1].any()


@pytest.mark.parametrize("name", ["lstm", "module-lstm"])
@pytest.mark.parametrize("modules", [2, 3, 6])
def test_bound_networks_refuse_another_number_of_modules(name, modules):
    x, _, _ = windows(modules=modules)
    with pytest.raises(ModelError, match=f"of {modules} modules.* trained for 4 modules"):
        built(name)(x)
    assert built("bilstm")(x).shape == (3, modules, A)


def test_sizes_of_table_s1():
    """Weights by hand: four gates of H rows over input, hidden state and two biases a layer, and the head."""

    def lstm(first, hidden, head):
        layers = [first] + [hidden] * 3
        return sum(4 * hidden * (size + hidden + 2) for size in layers) + (hidden + 1) * head

    for name, expected in (("lstm", lstm(N * 5, 128, N * A)), ("module-lstm", N * lstm(5, 128, A))):
        network = built(name, layers=4, hidden=128)
        assert sum(weight.numel() for weight in network.parameters()) == expected


def test_dropout_is_between_layers_and_in_training_only():
    x, _, _ = windows()
    for name in NETWORKS:
        network = built(name, dropout=0.5)
        assert torch.equal(network(x), network(x))
        network.train()
        assert not torch.equal(network(x), network(x))


def test_invalid_description_is_refused():
    with pytest.raises(ModelError, match="'gru', expected one of bilstm, lstm, module-lstm"):
        networks.build(described("gru"))
    nameless = described("lstm")
    del nameless["modules"]
    with pytest.raises(ModelError, match="without its number of modules"):
        networks.build(nameless)
