"""Eq. (3), the limits of the actuation, and the set-points of the board."""

import itertools

import numpy as np
import pytest
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


ONE_SIDED = st.floats(-1, 1) | st.sampled_from([0.0, -0.0, 1.0, -1.0, 5e-324, -5e-324, 1e-310, 2.0**-1074])
PLANAR_PAIR, PAIRS = ((1.0,), (-1.0,)), ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))


def around(*angles_deg):
    """Unit directions at these angles, degrees."""
    return np.stack([np.cos(np.radians(angles_deg)), np.sin(np.radians(angles_deg))], axis=-1)


THREE = around(0, 120, 240)
ARRANGEMENTS = {
    "three": THREE,
    "three, uneven": around(10, 95, 230),
    "four, not opposite": around(0, 70, 170, 290),
    "pairs in another order": around(0, 90, 180, 270),
    "four, turned": around(45, 225, 135, 315),
    "five": around(0, 72, 144, 216, 288),
    "six, close": around(0, 1, 2, 120, 200, 260),
    "beside each other": around(0, 169, 339),
}


def random_actions(count, size, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-1, 1, (count, size)) * 10.0 ** rng.choice([0, 0, 0, -3, -9], (count, 1))


def least_norm(directions, action):
    """Independent solver: of all sets of active actuators that produce the action, the one of least norm."""
    count, best = len(directions), None
    for size in range(1, count + 1):
        for active in map(list, itertools.combinations(range(count), size)):
            values = np.linalg.lstsq(directions[active].T, action, rcond=None)[0]
            off = np.abs(directions[active].T @ values - action).max()
            if values.min() >= -1e-12 * np.abs(action).max() and off <= 1e-12 * np.abs(action).max():
                candidate = np.zeros(count)
                candidate[active] = np.maximum(values, 0.0)
                if best is None or np.linalg.norm(candidate) < np.linalg.norm(best):
                    best = candidate
    return best


@pytest.mark.parametrize("directions", [PLANAR_PAIR, PAIRS])
@given(st.data())
def test_opposite_pairs_are_bitwise_eq_3(directions, data):
    size = len(directions[0])
    action = data.draw(arrays(np.float64, (3, size), elements=ONE_SIDED))
    actuators = actuation.module_actuators(directions)
    assert actuators.activations(action).tobytes() == actuation.activations(action).tobytes()
    assert actuators.applied(action).tobytes() == action.tobytes()
    previous = data.draw(arrays(np.float64, (3, size), elements=ONE_SIDED))
    within = actuation.limited(2.0 * action, previous, 0.4, actuators)
    assert within.tobytes() == actuation.limited(2.0 * action, previous, 0.4).tobytes()


@pytest.mark.parametrize("directions", [np.array([[-1.0], [1.0]]), ARRANGEMENTS["pairs in another order"]])
def test_pairs_in_another_order_have_the_same_activations(directions):
    size = directions.shape[1]
    action = random_actions(1000, size)
    expected = actuation.activations(action)
    order = [1, 0] if size == 1 else [0, 2, 1, 3]
    used = actuation.ModuleActuators(directions).activations(action)
    np.testing.assert_allclose(used, expected[:, order], atol=1e-15)


@pytest.mark.parametrize("name", ARRANGEMENTS)
def test_activations_are_those_of_least_norm(name):
    directions, action = ARRANGEMENTS[name], random_actions(100, 2)
    expected = np.array([least_norm(directions, each) for each in action])
    expected /= np.maximum(1.0, expected.max(axis=-1, keepdims=True))
    np.testing.assert_allclose(actuation.ModuleActuators(directions).activations(action), expected, atol=1e-12)


def test_three_chambers_equal_nonnegative_least_squares():
    nnls = pytest.importorskip("scipy.optimize").nnls  # unique there: no two of the three are opposite
    action = random_actions(10_000, 2)
    expected = np.array([nnls(THREE.T, each)[0] for each in action])
    expected /= np.maximum(1.0, expected.max(axis=-1, keepdims=True))
    np.testing.assert_allclose(actuation.ModuleActuators(THREE).activations(action), expected, atol=1e-12)


@pytest.mark.parametrize("name", ARRANGEMENTS)
def test_activations_produce_the_applied_action(name):
    directions, action = ARRANGEMENTS[name], random_actions(1000, 2)
    actuators = actuation.ModuleActuators(directions)
    used, applied = actuators.activations(action), actuators.applied(action)
    assert used.min() >= 0.0
    assert used.max() <= 1.0
    np.testing.assert_allclose(used @ directions, applied, atol=1e-14)
    np.testing.assert_allclose(actuators.activations(applied), used, atol=1e-14)  # nothing is left to scale


@pytest.mark.parametrize("name", ARRANGEMENTS)
def test_activations_are_continuous_around_the_circle(name):
    angle = np.linspace(-np.pi, np.pi, 20_001)
    used = actuation.ModuleActuators(ARRANGEMENTS[name]).activations(0.5 * np.stack([np.cos(angle), np.sin(angle)], -1))
    assert np.abs(np.diff(used, axis=0)).max() < 0.004
    np.testing.assert_allclose(used[0], used[-1], atol=1e-14)


@pytest.mark.parametrize("name", ARRANGEMENTS)
def test_activations_grow_with_the_action(name):
    actuators, scale = actuation.ModuleActuators(ARRANGEMENTS[name]), np.linspace(0.0, 1.0, 101)[:, None]
    for action in random_actions(20, 2):
        assert np.diff(actuators.activations(scale * action), axis=0).min() >= -1e-15


def test_activations_do_not_depend_on_the_number_of_modules():
    actuators, action = actuation.ModuleActuators(THREE), random_actions(12, 2)
    alone = np.concatenate([actuators.activations(each[None]) for each in action])
    assert actuators.activations(action).tobytes() == alone.tobytes()


def test_three_chambers_reach_the_hexagon():
    corners = actuation.ModuleActuators(THREE).applied(1.2 * around(0, 60, 120, 180, 240, 300, 30))
    np.testing.assert_allclose(np.hypot(*corners.T), [1.0] * 6 + [np.sqrt(0.75)], atol=1e-12)


def test_set_points_of_three_chambers_a_module():
    table = ROBOT.to_dict()
    table["robot"]["motion"] = "spatial"
    table["actuators"]["directions_deg"] = [0, 120, 240]
    table["simulation"] = None
    table["chambers"] = [{"module": i // 3 + 1, "direction_deg": i % 3 * 120, "channel": 8 - i} for i in range(9)]
    out = actuation.channel_pressures_bar(robot_file.from_dict(table), np.array([[-1.0, 0.0], [0.5, 0.0], [0.0, 0.0]]))
    expected = np.full(12, 0.08)
    expected[[8, 4, 3]] = [0.35, 0.215, 0.215]  # away from the chamber at 0, then towards it
    expected[9:] = 0.0
    np.testing.assert_allclose(out, expected, atol=1e-12)


@pytest.mark.parametrize("step", [0.05, 0.4, 2.0])
def test_limits_of_three_chambers_hold_together(step):
    actuators, rng, previous = actuation.ModuleActuators(THREE), np.random.default_rng(1), np.zeros((50, 2))
    for _ in range(100):
        out = actuation.limited(3.0 * rng.uniform(-1, 1, (50, 2)), previous, step, actuators)
        assert np.abs(out - previous).max() <= step + 1e-12
        np.testing.assert_allclose(actuators.applied(out), out, atol=1e-15)
        previous = out


def three_chambers():
    """The robot with chambers at 0, 120 and 240 degrees, on nine channels, each with its own gain and offset."""
    table = ROBOT.to_dict()
    table["robot"]["motion"] = "spatial"
    table["actuators"]["directions_deg"] = [0, 120, 240]
    table["simulation"] = None
    table["chambers"] = [
        {
            "module": i // 3 + 1,
            "direction_deg": i % 3 * 120,
            "channel": 8 - i,
            "gain": 0.8 + 0.02 * i,
            "offset_bar": 0.01,
        }
        for i in range(9)
    ]
    return robot_file.from_dict(table)


@pytest.mark.parametrize("robot", [ROBOT, three_chambers()], ids=["pair", "three"])
def test_actuation_is_recovered_from_the_set_points(robot):
    every_module = actuation.module_actuators(robot.directions)
    for action in random_actions(60, robot.action_size).reshape(20, 3, -1):
        applied = every_module.applied(action)
        found = actuation.applied_actuation(robot, actuation.channel_pressures_bar(robot, applied))
        np.testing.assert_allclose(found, applied, atol=1e-12)


def test_vented_chambers_are_actuation_0():
    assert np.array_equal(actuation.applied_actuation(ROBOT, np.zeros(12)), np.zeros((3, 1)))


def test_pressure_below_the_set_point_is_a_smaller_actuation():
    bar = actuation.channel_pressures_bar(ROBOT, np.array([[1.0], [0.0], [0.0]]))
    bar[ROBOT.chambers[0].channel] = 0.215
    assert actuation.applied_actuation(ROBOT, bar)[0, 0] == pytest.approx(0.5)


def test_robot_without_valves_has_no_applied_actuation():
    with pytest.raises(ValueError, match="cable-4 has no valves"):
        actuation.applied_actuation(robot_file.load("cable-4"), np.zeros(12))
