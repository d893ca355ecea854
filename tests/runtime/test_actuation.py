"""Eq. (3), the limits of the actuation, and the set-points of the board."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from modsoft.runtime import robot as robot_file
from modsoft.runtime.control import actuation

ROBOT = robot_file.load("pneumatic-3")
ACTIONS = arrays(np.float64, (3, 1), elements=st.floats(-1, 1))


def test_cables_pull_in_the_order_0_180_90_270_degrees():
    assert np.array_equal(actuation.activations([[0.3, -0.7]]), [[0.3, 0.0, 0.0, 0.7]])


@given(ACTIONS)
def test_one_of_two_opposite_chambers_is_inactive(action):
    pair = actuation.activations(action)
    assert np.all(np.min(pair, axis=-1) == 0)
    assert np.array_equal(pair[:, :1] - pair[:, 1:], action)


def test_pressure_is_linear_in_the_activation():
    pressures = actuation.pressures_bar(ROBOT, np.array([[0.0], [1.0], [-0.5]]))
    np.testing.assert_allclose(pressures, [[0.08, 0.08], [0.35, 0.08], [0.08, 0.215]])


@given(ACTIONS, ACTIONS, st.floats(0.01, 2))
def test_limited_actuation_is_within_range_and_step(requested, before, step):
    out = actuation.limited(requested * 3, before, step)
    assert np.all(np.abs(out) <= 1)
    assert np.all(np.abs(out - before) <= step + 1e-12)


def test_actuation_within_the_limits_is_unchanged():
    assert np.array_equal(actuation.limited([[0.5]], [[0.4]], 0.2), [[0.5]])


def test_set_points_include_gain_and_offset():
    table = ROBOT.to_dict()
    table["chambers"][0].update(channel=10, gain=0.5, offset_bar=0.01)
    out = actuation.channel_pressures_bar(robot_file.from_dict(table), np.array([[1.0], [-1.0], [0.0]]))
    expected = np.zeros(12)
    expected[[10, 1, 2, 3, 4, 5]] = [0.5 * 0.35 + 0.01, 0.08, 0.08, 0.35, 0.08, 0.08]
    np.testing.assert_allclose(out, expected)


def test_set_points_are_limited_to_the_pressure_range():
    table = ROBOT.to_dict()
    table["chambers"][0].update(gain=2.0)
    table["chambers"][1].update(offset_bar=-0.1)
    out = actuation.channel_pressures_bar(robot_file.from_dict(table), np.array([[1.0], [0.0], [0.0]]))
    assert out[0] == 0.35
    assert out[1] == 0.0
