"""A control run on the stepped rig: compiled firmware, fake tracker and a robot without dynamics."""

import numpy as np
import pytest
from bending_arm import BendingArm
from rigid_arm import RigidArm

from modsoft.hil import closed_loop, stepped
from modsoft.hil.polaris_device import Polaris
from modsoft.hil.stepped import SteppedRig
from modsoft.runtime import robot as robot_file
from modsoft.runtime.control.actuation import pressures_bar
from modsoft.runtime.control.controller import Controller
from modsoft.runtime.control.features import angle_between_deg, from_angles_deg
from modsoft.runtime.errors import LostInRun

ROBOT = robot_file.load("pneumatic-3")
STEPS = 3
ACTUATION = np.array([[0.3], [-0.2], [0.1]])


class Constant:
    """A policy with one answer."""

    history = 1

    def actuate(self, features):
        return ACTUATION


def control(tracker=Polaris):
    desired = from_angles_deg(np.zeros((STEPS, 3)))
    with SteppedRig(ROBOT, RigidArm(3), tracker=tracker) as rig:
        return closed_loop.run(rig, lambda rest: Controller(ROBOT, Constant(), rest), desired), rig


def test_robot_follows_policy_through_firmware_and_valves():
    motion, rig = control()
    bar = pressures_bar(ROBOT, ACTUATION)
    arm = RigidArm(3)
    arm.set_pressures(bar)
    np.testing.assert_allclose(motion.actuation, np.tile(ACTUATION, (STEPS, 1, 1)))
    np.testing.assert_allclose(
        motion.true_configuration[-1], arm.configuration, atol=0.003
    )  # resolution of the valve outputs
    assert motion.true_configuration.shape == motion.measured.shape == (STEPS + 1, 3, 3)
    assert max(rig.emulated.duties()) == 0.0, "vented at the end"


def test_measured_configuration_is_that_of_the_robot_within_the_resolution_of_the_tracker():
    motion, _ = control()
    assert 0.0 < np.max(angle_between_deg(motion.measured, motion.true_configuration)) < 0.05


def test_run_is_reproducible():
    first, second = control()[0], control()[0]
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one, other)


def test_run_without_a_valid_frame_is_refused():
    def hidden(now):
        device = Polaris(now)
        device.take({"hide": [2]})
        return device

    with pytest.raises(LostInRun, match="no good frame within 5 s, the last one tool hidden"):
        control(hidden)


def test_three_chambers_a_module_are_driven_through_firmware_and_valves():
    robot = robot_file.load("pneumatic-3x3")
    actuation = np.array([[0.3, 0.1], [-0.2, 0.4], [0.0, -0.5]])

    class InSpace(Constant):
        def actuate(self, features):
            return actuation

    desired = np.broadcast_to([0.0, 0.0, 1.0], (STEPS, 3, 3))
    arm = BendingArm(3, robot.actuators.directions_deg, lag_s=0.0, deg_per_bar=(10.0, 60.0, 90.0))
    with SteppedRig(robot, arm) as rig:
        motion = closed_loop.run(rig, lambda rest: Controller(robot, InSpace(), rest), desired)
    reached = BendingArm(3, robot.actuators.directions_deg, lag_s=0.0, deg_per_bar=(10.0, 60.0, 90.0))
    reached.set_pressures(pressures_bar(robot, actuation))
    reached.advance(0.0)
    np.testing.assert_allclose(motion.true_configuration[-1], reached.configuration, atol=0.003)
    assert np.max(angle_between_deg(motion.measured[-1], reached.configuration)) < 0.3


def test_events_of_a_long_run_do_not_fill_the_memory(monkeypatch):
    monkeypatch.setattr(stepped, "MOST_EVENTS", 50)
    _, rig = control()
    assert len(rig.emulated.trace) < 150  # those of one step may follow
