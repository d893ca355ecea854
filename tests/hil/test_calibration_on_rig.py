"""Calibration and control on the stepped rig: compiled firmware, fake tracker with mounting errors and noise."""

import numpy as np
import pytest
from bending_arm import BendingArm
from tools_at_rest import ERRORS, NOISE, measured

from modsoft.hil import closed_loop
from modsoft.hil.polaris_device import Polaris
from modsoft.hil.stepped import SteppedRig
from modsoft.runtime import robot as robot_file
from modsoft.runtime.calibration import rest
from modsoft.runtime.calibration.measure import Collector
from modsoft.runtime.calibration.use import UsedCalibration
from modsoft.runtime.control.controller import Controller
from modsoft.runtime.control.features import angle_between_deg, bending_error_deg

STEPS = 20


class RandomPolicy:
    """A policy with random answers."""

    history = 1

    def __init__(self, shape):
        self.rng, self.shape = np.random.default_rng(1), shape

    def actuate(self, features):
        return self.rng.uniform(-1.0, 1.0, self.shape)


def error_deg(robot, errors, calibrate):
    """Mean error of the measured configurations in a run, degrees."""
    arm = BendingArm(robot.modules, robot.actuators.directions_deg)
    with SteppedRig(robot, arm, tracker=lambda now: Polaris(now, errors=errors)) as rig:
        calibration = None
        if calibrate:
            tools = Collector(robot, rig.frames, now=rig.clock, wait=rig.wait).run()
            fitted = rest.calibrated(measured(tools), robot.name, None)
            calibration = UsedCalibration("c", "", fitted, robot.modules)
        policy = RandomPolicy((robot.modules, robot.action_size))
        desired = np.broadcast_to([0.0, 0.0, 1.0], (STEPS, robot.modules, 3))
        motion = closed_loop.run(rig, lambda rest: Controller(robot, policy, rest), desired, calibration)
    between = bending_error_deg if robot.motion == "planar" else angle_between_deg
    return np.nanmean(between(motion.measured, motion.true_configuration))


@pytest.mark.parametrize("name", ["pneumatic-3", "pneumatic-3x3"])
def test_error_on_the_rig_after_calibration_is_nearly_that_of_the_noise(name):
    robot = robot_file.load(name)
    noise = error_deg(robot, NOISE, calibrate=False)
    corrected = error_deg(robot, ERRORS, calibrate=True)
    raw = error_deg(robot, ERRORS, calibrate=False)
    print(f"{name}: noise alone {noise:.2f}, calibrated {corrected:.2f}, not calibrated {raw:.2f} degrees")
    assert corrected <= 1.2 * noise
    assert raw > 2.0 * noise
