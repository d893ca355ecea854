"""Random actions for the collection of data."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_robots import of_modules

from modsoft.runtime.choices import STRATEGIES
from modsoft.runtime.control.actuation import limited
from modsoft.training.data import actions as a


def draw(robot, strategy, steps, seed=0):
    return a.draw_actions(robot, strategy, steps, np.random.default_rng(seed))


@given(st.integers(2, 8), st.integers(1, 300), st.sampled_from([0.1, 0.4, 1.9, 2.0]), st.integers(0, 99))
def test_first_modules_of_each_stage_share_their_actions(modules, steps, largest, seed):
    actions = draw(of_modules("cable", modules, largest), "staged", steps, seed)
    assert actions.shape == (steps, modules, 2)
    assert np.all(np.abs(actions) <= 1.0)
    borders = a.stage_borders("staged", modules, steps)
    assert (borders[0], borders[-1]) == (0, steps)
    assert np.ptp(np.diff(borders)) <= 1
    for stage, (begin, end) in enumerate(itertools.pairwise(borders)):
        piece = actions[begin:end]
        shared = modules - stage
        assert np.array_equal(piece[:, :shared], np.repeat(piece[:, :1], shared, axis=1))
        for module in range(shared, modules):
            for other in range(module):
                assert not np.any(piece[:, module] == piece[:, other])


@given(st.integers(2, 5), st.sampled_from([0.05, 0.4, 1.0]), st.sampled_from(STRATEGIES), st.integers(0, 99))
def test_actions_are_within_the_limits_of_the_control_loop(modules, largest, strategy, seed):
    actions = draw(of_modules("cable", modules, largest), strategy, 200, seed)
    previous = np.zeros_like(actions[0])  # every episode starts with the actuation at rest
    for action in actions:
        np.testing.assert_allclose(limited(action, previous, largest), action, rtol=0, atol=1e-12)
        previous = action


def shares(values: np.ndarray) -> np.ndarray:
    """Of each tenth of the range."""
    counts, _ = np.histogram(values, bins=10, range=(-1, 1))
    return counts / values.size


def test_unbounded_actions_are_uniform():
    drawn = draw(of_modules("cable", 2), "random", 20000)
    np.testing.assert_allclose(shares(drawn), 0.1, atol=0.01)


@given(st.floats(0.01, 1.9))
def test_reflected_walk_keeps_a_uniform_distribution_at_any_step(largest):
    rng = np.random.default_rng(0)
    increments = rng.uniform(-largest, largest, (5, 20000))
    increments[0] = rng.uniform(-1, 1, 20000)  # walkers all over the range
    for places in a._reflected_walk(increments):
        np.testing.assert_allclose(shares(places), 0.1, atol=0.01)


def test_bounded_actions_cover_the_range_in_a_data_set_of_the_usual_size():
    robot = of_modules("pneumatic", 3, 0.4)
    drawn = np.stack([draw(robot, "staged", 300, seed) for seed in range(50)])
    for module in range(3):
        fractions = shares(drawn[:, :, module])
        assert fractions.min() > 0.04  # the ends of the range; 0.059 was seen
        assert fractions.max() < 0.2  # around rest, where every episode begins; 0.171 was seen


def test_random_actions_differ_between_modules_and_change_slowly_and_fast():
    actions = draw(of_modules("cable", 3, 0.4), "random", 2000)
    steps = np.abs(np.diff(actions, axis=0))
    assert np.mean(steps < 0.02) > 0.4
    assert np.mean((steps > 0.02) & (steps < 0.1)) > 0.1
    assert np.mean(steps > 0.2) > 0.02
    assert not np.any(actions[:, 0] == actions[:, 1])


@pytest.mark.parametrize("strategy", ["smooth", "varied"])
def test_smooth_actions_cover_the_whole_range_with_jitter(strategy):
    robot = of_modules("cable", 4)
    drawn = np.stack([draw(robot, strategy, 300, seed) for seed in range(60)])
    assert np.all(np.abs(drawn) <= 1.0)
    steps = np.abs(np.diff(drawn, axis=1))
    assert np.median(steps) < 0.1  # 0.59 where every action is independent
    for module in range(4):
        fractions = shares(drawn[:, :, module])
        assert fractions.min() > 0.02
        assert fractions[[0, -1]].min() > 0.025  # the ends of the range, where the workspace ends; 0.035 was seen
    begins_at_rest = np.abs(drawn[:, 0]).max(axis=(1, 2)) < 0.35
    assert 0.05 < np.mean(begins_at_rest) < 0.95  # the others jump


def test_some_modules_share_a_smooth_sequence():
    """The effect of a neighbour is largest when both move in the same direction, as in tasks."""
    robot = of_modules("cable", 4)
    correlations = []
    for seed in range(60):
        drawn = draw(robot, "smooth", 300, seed)[..., 0]
        correlations.append(abs(np.corrcoef(drawn[:, 0], drawn[:, 1])[0, 1]))
    assert 0.1 < np.mean(np.array(correlations) > 0.9) < 0.7
