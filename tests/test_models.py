"""The models that ship in tools/models: whole, of the robots that they are for, and able to drive them."""

from pathlib import Path

import numpy as np
import pytest

from modsoft.runtime import robot as robot_file
from modsoft.runtime.control import tasks
from modsoft.runtime.control.model import Model
from modsoft.training.simulation import fleet_kernel, rollout
from modsoft.training.simulation.fleet import Fleet
from modsoft.training.simulation.rollout import ControllerSetup

pytestmark = pytest.mark.instructions

MODELS = Path(__file__).parents[1] / "tools/models"
needs_fleet = pytest.mark.skipif(not fleet_kernel.variants(), reason="the fleet's kernel is not built here")


@pytest.mark.parametrize(
    ("file", "robot"),
    [("pneumatic-3", "pneumatic-3"), ("pneumatic-3", "pneumatic-2"), ("cable-4", "cable-4"), ("cable-4", "cable-6")],
)
def test_a_shipped_model_is_of_its_robots_and_says_how_it_was_made(file, robot):
    controller = Model.load(MODELS / f"{file}.onnx")
    controller.check(robot_file.load(robot))
    provenance = controller.description.provenance
    assert {"data_sha256", "iterations_done", "seed", "strategy", "code_version"} <= provenance.keys()
    assert f"{file}.onnx" in (MODELS / "README.md").read_text(encoding="utf-8")


@needs_fleet
@pytest.mark.parametrize(
    ("file", "robot", "task", "most"),
    [("pneumatic-3", "pneumatic-3", "down", 1.0), ("cable-4", "cable-4", "A", 2.0), ("cable-4", "cable-6", "A", 8.0)],
)
def test_a_shipped_model_drives_its_robot(file, robot, task, most):
    """most: of the mean error of any module, degrees or percent, over the first 60 steps; far more than was measured,
    far less than that of a model that does not drive."""
    robot = robot_file.load(robot)
    controller = Model.load(MODELS / f"{file}.onnx")
    desired = tasks.task(task, robot.kind, robot.modules)[:60]
    setup = ControllerSetup(robot, controller.actuate, controller.history, desired)
    (driven,) = rollout.rollout(Fleet(robot.kind, robot.modules, 1), [setup]).robots()
    errors = rollout.angle_errors_deg if robot.kind == "pneumatic" else rollout.configuration_errors_percent
    assert errors(driven.configuration, desired).mean(axis=0).max() < most
    still = np.broadcast_to(driven.configuration[:1], (61, robot.modules, 3))
    assert errors(still, desired).mean(axis=0).max() > 2 * most
