"""Muon: updates of nearly orthogonal matrices, in float32, cheaper than the gradient."""

import numpy as np
import pytest
import torch
from scipy.optimize import linprog

from modsoft.training import networks, optimizer

pytestmark = pytest.mark.instructions


def matrix(rows, columns, smallest=0.02, seed=0):
    """A random matrix with singular values between `smallest` and 1 of the scale that orthogonalized assumes."""
    generator = torch.Generator().manual_seed(seed)
    u, _, v = torch.linalg.svd(torch.randn(rows, columns, generator=generator), full_matrices=False)
    values = torch.linspace(smallest, 0.3, min(rows, columns))  # sum of 4th powers below 1
    return 7.0 * (u * values) @ v, u, v


@pytest.mark.parametrize("shape", [(32, 32), (16, 48), (48, 16), (64, 5)])
def test_update_has_the_singular_vectors_of_the_matrix_and_singular_values_near_one(shape):
    given, u, v = matrix(*shape)
    update = optimizer.orthogonalized(given)
    values = torch.linalg.svdvals(update)
    assert 0.72 < values.min() <= values.max() < 1.28
    among_them = u.mT @ update @ v.mT
    torch.testing.assert_close(among_them, torch.diag(torch.diagonal(among_them)), atol=2e-3, rtol=0.0)
    assert torch.diagonal(among_them).min() > 0.72  # the signs are kept


def test_batch_equals_its_single_matrices_and_zero_stays_zero():
    matrices = torch.stack([matrix(8, 16, seed=seed)[0] for seed in range(3)] + [torch.zeros(8, 16)])
    updates = optimizer.orthogonalized(matrices)
    for one, other in zip(matrices, updates, strict=True):
        torch.testing.assert_close(optimizer.orthogonalized(one), other)
    assert torch.equal(updates[3], torch.zeros(8, 16))


def test_coefficients_are_the_best_for_singular_values_from_a_hundredth_to_one():
    low, high = 0.01, 1.0
    for coefficients in optimizer.POLYNOMIALS:
        x = np.union1d(np.geomspace(low, high, 2000), np.linspace(low, high, 2000))
        powers, one = np.stack([x, x**3, x**5], axis=1), np.ones((len(x), 1))
        # Smallest t with |1 - p(x)| <= t everywhere.
        bounds = np.block([[powers, -one], [-powers, -one]])
        best = linprog([0, 0, 0, 1], bounds, np.concatenate([one, -one]).ravel(), bounds=[(None, None)] * 4).x
        np.testing.assert_allclose(coefficients, best[:3], rtol=1e-3)
        low, high = 1 - best[3], 1 + best[3]
    assert high == pytest.approx(1.27, abs=0.01)


def test_matrices_wider_than_high_by_gate_are_orthogonalized_by_gate():
    network = networks.BiLSTM(3, 1, layers=2, hidden=4)
    whole, by_gate = network.lstm.weight_hh_l0, network.lstm.weight_ih_l1
    assert optimizer._factors(whole.data).shape == (16, 4)
    assert optimizer._factors(by_gate.data).shape == (4, 4, 8)
    torch.testing.assert_close(optimizer._factors(by_gate.data)[1], by_gate.data[4:8])


def test_updates_of_a_matrix_are_as_large_as_those_of_adam():
    torch.manual_seed(0)
    network = networks.BiLSTM(6, 1, layers=2, hidden=16)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    both = optimizer.MuonAndAdam(network)
    for parameter in network.parameters():
        parameter.grad = torch.randn_like(parameter)
    both.step(1e-3)
    for name, value in network.state_dict().items():
        if value.ndim == 2 and "head" not in name:
            rms = (value - before[name]).square().mean().sqrt().item()
            assert rms == pytest.approx(optimizer.MUON_RATE * optimizer.ADAM_RMS * 1e-3, rel=0.35), name
        else:
            assert (value - before[name]).abs().max().item() == pytest.approx(1e-3, rel=0.01), name
    assert all(p.grad is None for p in network.parameters())
