"""The robots in PyElastica: against the authors' recorded runs and stored traces; invalid arguments."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from plants import CABLE, PARAMETERS, PNEUMATIC, PNEUMATIC_2

from modsoft.runtime.control.actuation import activations
from modsoft.runtime.control.features import bending_angle_deg
from modsoft.runtime.control.tasks import DOWN_DEG, EDGE_DEG
from modsoft.runtime.errors import ModsoftError
from modsoft.training.simulation.elastica import Arm

REFERENCE = Path(__file__).parents[3] / "shared" / "reference"
DATA = Path(__file__).parent / "data"
P_MIN_BAR, P_MAX_BAR = 0.08, 0.35


@pytest.mark.parametrize("task", ["a", "b", "c"])
def test_recorded_actions_give_the_recorded_configurations(task):
    path = REFERENCE / f"four_module_bilstm_task_{task}.npz"
    if not path.is_file():
        pytest.skip("the authors' recorded runs are not part of this repository")
    with np.load(path) as run:
        actions = run["act_list"]
        recorded = np.moveaxis(run["real_list"], -1, 0)[..., [1, 2, 0]]  # stored [v_z, v_x, v_y]
        ends = np.moveaxis(run["pos_list"], -1, 0)
    arm = Arm(CABLE, 4)
    for step in range(50):
        assert np.abs(arm.configuration - recorded[step]).max() < 5e-6
        assert np.abs(arm.positions - ends[step]).max() < 1e-6
        arm.step(actions[step])


@pytest.mark.parametrize("kind", ["cable", "pneumatic"])
def test_robots_repeat_their_stored_traces(kind):
    """Stored from this simulation: store them again after an intended change of its numbers."""
    with np.load(DATA / f"{kind}-3.npz") as trace:
        arm = Arm(PARAMETERS[kind], 3)
        for action, configuration, positions in zip(
            trace["actions"], trace["configuration"], trace["positions"], strict=True
        ):
            assert np.abs(arm.step(action) - configuration).max() < 1e-9
            assert np.abs(arm.positions - positions).max() < 1e-10


def test_cables_have_no_stress_at_rest():
    """Without actuation the cable robot only stretches, along its axis."""
    arm = Arm(CABLE, 2)
    arm.step(np.zeros((2, 2)))
    assert np.abs(arm.configuration - [0.0, 0.0, 1.0]).max() < 1e-12
    assert 0.05 < arm.positions[0, 2] < 0.051


def settled_deg(arm, actuation, periods=4):
    """Bending angles (N,), degrees, of a pneumatic arm under a held actuation (N,)."""
    for _ in range(periods):
        arm.step(np.reshape(actuation, (-1, 1)))
    return bending_angle_deg(arm.configuration)


@pytest.fixture(scope="module", name="pneumatic")
def _pneumatic():
    return {3: Arm(PNEUMATIC, 3), 2: Arm(PNEUMATIC_2, 2)}


@pytest.mark.parametrize(("modules", "reach_deg"), [(3, [5.9, 36.0, 90.0]), (2, [33.0, 75.0])])
def test_pneumatic_modules_reach_their_angles(pneumatic, modules, reach_deg):
    """Section 3.3: below 6, about 36 and about 90 degrees; two modules about 30 (32.4 in a task) and 75."""
    arm = pneumatic[modules]
    for module in range(modules):
        for sign in (1.0, -1.0):
            arm.reset()
            reached = settled_deg(arm, sign * np.eye(modules)[module])[module]
            assert reached == pytest.approx(sign * reach_deg[module], abs=0.3)
            if modules == 3 and module == 0:
                assert abs(reached) < 6.0


@pytest.mark.parametrize(("modules", "angles_deg"), [(n, task[n]) for n in (3, 2) for task in (EDGE_DEG, DOWN_DEG)])
def test_farthest_poses_of_the_tasks_are_within_reach(pneumatic, modules, angles_deg):
    """A plain integrator on each module's angle finds an actuation below full pressure that holds the pose."""
    arm = pneumatic[modules]
    arm.reset()
    target = np.array(angles_deg)
    slowness_deg = np.array([7.0, 45.0, 115.0])[-modules:]  # about an angle per actuation
    actuation = np.zeros(modules)
    for period in range(24):
        error = target * min(1.0, (period + 1) / 8) - bending_angle_deg(arm.configuration)
        actuation = np.clip(actuation + 0.7 * error / slowness_deg, -1.0, 1.0)
        arm.step(actuation[:, None])
    assert np.abs(bending_angle_deg(arm.configuration) - target).max() < 0.1
    assert np.abs(actuation).max() < 0.99


def test_pneumatic_robot_settles_within_two_control_periods(pneumatic):
    arm = pneumatic[3]
    arm.reset()
    first = settled_deg(arm, [1.0, -1.0, 1.0], periods=1)
    second = settled_deg(arm, [1.0, -1.0, 1.0], periods=1)
    last = settled_deg(arm, [1.0, -1.0, 1.0])
    assert np.abs(first - last).max() < 2.0
    assert np.abs(second - last).max() < 0.1


def test_pneumatic_robot_has_hysteresis(pneumatic):
    """The same pressures hold another angle on the way up than on the way down, and the
    difference remains until the next reversal."""
    arm = pneumatic[3]
    arm.reset()
    tip = np.array([0.0, 0.0, 1.0])
    angle = {}
    for place in (1.0, 0.4, -1.0, 0.4, 1.0):
        angle.setdefault(place, []).append(settled_deg(arm, place * tip)[2])
    down, up = angle[0.4]
    assert 5.0 < down - up < 10.0
    assert angle[1.0][0] == pytest.approx(angle[1.0][1], abs=0.05)  # the loop closes
    held = settled_deg(arm, 0.0 * tip)[2]
    assert held == pytest.approx(3.0, abs=0.3)
    assert settled_deg(arm, 0.0 * tip, periods=20)[2] == pytest.approx(held, abs=0.01)  # it does not creep away


def test_pneumatic_robot_stays_in_its_plane(pneumatic):
    arm = pneumatic[3]
    arm.reset()
    for action in np.random.default_rng(5).uniform(-1.0, 1.0, (10, 3, 1)):
        arm.step(action)
        assert not arm.configuration[:, 1].any()
        assert not arm.positions[:, 1].any()
        assert (arm.directors[:, 1] == [0.0, 1.0, 0.0]).all()
    assert np.abs(bending_angle_deg(arm.configuration)).max() > 5.0


def test_pressures_follow_their_set_points_through_valve_and_chamber(pneumatic):
    arm = pneumatic[2]
    arm.reset()
    assert np.abs(arm.pressures - P_MIN_BAR).max() < 1e-12
    set_points = np.array([[P_MAX_BAR, P_MIN_BAR], [0.0, P_MIN_BAR]])
    arm.set_pressures(set_points)
    elapsed_s = 0.0
    valve_s, chamber_s = arm.parameters.actuators.valve_lag_s, arm.parameters.actuators.chamber_lag_s
    for _ in range(10):
        arm.advance(0.02)
        elapsed_s += 0.02
        left = (chamber_s * np.exp(-elapsed_s / chamber_s) - valve_s * np.exp(-elapsed_s / valve_s)) / (
            chamber_s - valve_s
        )
        expected = set_points + (P_MIN_BAR - set_points) * left
        assert np.abs(arm.pressures - expected).max() < 2e-3
    arm.advance(1.0)
    assert np.abs(arm.pressures - set_points).max() < 1e-6


def test_set_points_and_actuation_give_the_same_motion(pneumatic):
    """The rig sends pressures in slices of 20 ms, the data come from actuations over whole periods."""
    arm = pneumatic[2]
    action = np.array([[0.7], [-0.4]])
    arm.reset()
    by_actuation = arm.step(action)
    arm.reset()
    arm.set_pressures(P_MIN_BAR + (P_MAX_BAR - P_MIN_BAR) * activations(action))
    for _ in range(20):
        arm.advance(0.02)
    assert np.abs(arm.configuration - by_actuation).max() < 1e-12
    assert arm.configuration[0, 0] > 0.0 > arm.configuration[1, 0]  # side + bends towards +x


def test_remaining_time_of_a_slice_is_added_to_the_next(pneumatic):
    arm = pneumatic[2]
    action = np.array([[0.7], [-0.4]])
    arm.reset()
    whole = arm.step(action)
    arm.reset()
    arm.step(action, 0.0)
    for _ in range(4000):
        arm.advance(0.0001)  # less than half a time step
    assert np.abs(arm.configuration - whole).max() < 1e-12


def test_reset_restores_every_bit(pneumatic):
    arm = pneumatic[3]
    actions = np.random.default_rng(6).uniform(-1.0, 1.0, (3, 3, 1))
    arm.reset()
    first = [arm.step(action) for action in actions]
    arm.reset()
    assert np.array_equal(first, [arm.step(action) for action in actions])
    fresh = Arm(PNEUMATIC, 3)
    assert np.array_equal(first, [fresh.step(action) for action in actions])


@pytest.mark.parametrize("modules", [4, 8])
def test_longer_pneumatic_robots_stay_bounded(modules):
    arm = Arm(PNEUMATIC, modules)
    for action in np.random.default_rng(7).choice([-1.0, 1.0], (4, modules, 1)):
        arm.step(action)
    assert np.abs(bending_angle_deg(arm.configuration)).max() < 130.0


def test_state_that_is_not_finite_is_one_line():
    arm = Arm(dataclasses.replace(CABLE, time_step_s=1e-3), 2)
    with pytest.raises(ModsoftError, match=r"simulated robot of 2 modules is no longer finite"):
        arm.step(np.ones((2, 2)), 5.0)


def test_invalid_arguments_are_refused(pneumatic):
    arm = pneumatic[2]
    with pytest.raises(ValueError, match=r"found shape \(3, 1\), expected \(2, 1\)"):
        arm.step(np.zeros((3, 1)))
    with pytest.raises(ValueError, match=r"found an actuation of 1\.2, expected \[-1, 1\]"):
        arm.step(np.array([[0.0], [1.2]]))
    with pytest.raises(ValueError, match="found an actuation of nan"):
        arm.step(np.array([[0.0], [np.nan]]))
    with pytest.raises(ValueError, match=r"found shape \(2,\), expected \(2, 2\)"):
        arm.set_pressures(np.zeros(2))
    with pytest.raises(ValueError, match="no chambers"):
        Arm(CABLE, 2).set_pressures(np.zeros((2, 4)))
