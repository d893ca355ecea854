"""A module is removed by `modules` in the robot file alone: the same file and the same model, with three and two."""

from pathlib import Path

import numpy as np
import pytest
from bending_arm import BendingArm

from modsoft.hil import closed_loop
from modsoft.hil.stepped import SteppedRig
from modsoft.runtime import robot as robot_file
from modsoft.runtime.control.controller import Controller
from modsoft.runtime.control.correction import by_name
from modsoft.runtime.control.features import angle_between_deg, from_angles_deg
from modsoft.runtime.control.model import Model

MODEL = Path(__file__).parents[2] / "tools" / "models" / "pneumatic-3.onnx"
TEXT = robot_file.text_of("pneumatic-3")
STEPS = 15


@pytest.mark.parametrize("modules", [3, 2])
def test_same_model_controls_three_and_two_modules(modules):
    robot = robot_file.parse(TEXT.replace("modules = 3", f"modules = {modules}"))
    model = Model.load(MODEL)
    model.check(robot)
    desired = from_angles_deg(np.tile([3.0, 12.0, 25.0][:modules], (STEPS, 1)))
    with SteppedRig(robot, BendingArm(modules)) as rig:
        motion = closed_loop.run(
            rig, lambda rest: Controller(robot, model, rest, by_name("integral", modules)), desired
        )
        used = {event["channel"] for event in rig.emulated.trace if event["event"] == "pwm" and event["duty"] > 0.0}
    error = angle_between_deg(motion.true_configuration[1:], desired)
    assert used == {chamber.channel for chamber in robot.chambers}
    assert error[-1].max() < 2.0
