"""The oracle error: zero for motions that the robot can make, and the least possible for others."""

import numpy as np
import pytest
from plants import CABLE
from scipy import sparse
from scipy.optimize import lsq_linear

from modsoft.training.simulation import fleet_kernel, oracle
from modsoft.training.simulation.fleet import Fleet
from modsoft.training.simulation.oracle import OracleResult, greedy, improved, oracle_error
from modsoft.training.simulation.rollout import rollout

pytestmark = [
    pytest.mark.instructions,
    pytest.mark.skipif(fleet_kernel.library() is None, reason="the kernel is not built here (no C compiler)"),
]


def motion(modules=2, steps=8, seed=0):
    """Configurations (K, N, 3) at the start of each period under a random walk of actions: no oracle error."""
    wander = np.cumsum(np.random.default_rng(seed).uniform(-0.25, 0.25, (steps, 1, modules, 2)), axis=0)
    return rollout(Fleet(CABLE, modules, 1), np.clip(wander, -0.9, 0.9)).configuration[:-1, 0]


def errors(desired, actions):
    reached = rollout(Fleet(CABLE, desired.shape[1], 1), actions[:, None]).configuration[:-1, 0]
    return 100.0 * np.linalg.norm(reached - desired, axis=-1)


def beyond_reach(steps=6):
    """The tip module of two turned by 90 degrees towards -y from the start on, the other one straight."""
    return np.broadcast_to([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]], (steps, 2, 3))


@pytest.mark.parametrize("modules", [2, 4])
def test_motion_of_the_robot_has_no_oracle_error(modules):
    desired = motion(modules)
    result = oracle_error(CABLE, modules, desired)
    assert result.actions.shape == (8, modules, 2)
    assert result.errors.shape == (8, modules)
    assert result.errors.max() < 2e-3
    assert np.abs(errors(desired, result.actions) - result.errors).max() < 1e-9


def test_first_error_is_that_of_the_robot_at_rest():
    """The configuration at the start of step 0 is before any action."""
    result = oracle_error(CABLE, 2, motion(steps=6)[2:])
    at_rest = 100.0 * np.linalg.norm(motion(steps=6)[2] - [0.0, 0.0, 1.0], axis=-1)
    assert np.abs(result.errors[0] - at_rest).max() < 1e-9
    assert result.errors[1:].max() < 2e-3


def test_beyond_reach_the_actuation_saturates_and_the_other_module_stays():
    result = oracle_error(CABLE, 2, beyond_reach())
    assert (np.abs(result.actions) <= 1.0).all()
    assert result.actions[:5, 1, 1].max() < -0.99
    assert 20.0 < result.errors[1:, 1].mean() < 80.0
    assert result.errors[1:, 0].mean() < 1.0


def test_same_seed_gives_the_same_actions():
    first, second = (oracle_error(CABLE, 2, beyond_reach(4), seed=3) for _ in range(2))
    assert isinstance(first, OracleResult)
    assert np.array_equal(first.actions, second.actions)


def test_improved_sequences_are_never_worse():
    desired = motion(steps=10)
    from_nothing = improved(CABLE, 2, desired, np.zeros((10, 2, 2)))
    assert errors(desired, from_nothing).mean() < 0.05 * errors(desired, np.zeros((10, 2, 2))).mean()
    before = greedy(CABLE, 2, beyond_reach())
    after = improved(CABLE, 2, beyond_reach(), before)
    assert errors(beyond_reach(), after).sum() <= errors(beyond_reach(), before).sum()


def test_slopes_equal_finite_differences():
    actions = np.random.default_rng(1).uniform(-0.5, 0.5, (4, 2, 2))
    _, taken, configuration = oracle._traced(CABLE, 2, actions, motion(steps=4))
    slopes = oracle._slopes(CABLE, 2, actions, taken, configuration).toarray().reshape(4, 6, 4, 4)
    moved = actions.copy()
    moved[1, 0, 1] += 1e-3
    _, _, after = oracle._traced(CABLE, 2, moved, motion(steps=4))
    expected = (after - configuration).reshape(4, 6) / 1e-3
    assert np.abs(slopes[:3, :, 1, 1] - expected[:3]).max() < 2e-3
    assert not slopes[3, :, 1, 1].any()


@pytest.mark.parametrize("seed", range(5))
def test_bounded_minimum_equals_that_of_scipy(seed):
    random = np.random.default_rng(seed)
    matrix, target = random.normal(size=(12, 6)), 3.0 * random.normal(size=12)
    lower, upper = -random.random(6), random.random(6)
    minimum = oracle._bounded_minimum(sparse.csr_array(matrix.T @ matrix), -matrix.T @ target, lower, upper)
    expected = lsq_linear(matrix, target, bounds=(lower, upper)).x
    assert ((minimum >= lower) & (minimum <= upper)).all()
    assert np.abs(minimum - expected).max() < 1e-4
