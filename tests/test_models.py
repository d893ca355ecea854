"""The models in tools/models: their description, and their control of the simulated robots."""

from pathlib import Path

import numpy as np
import pytest

from modsoft.runtime import robot as robot_file
from modsoft.runtime.control import tasks
from modsoft.runtime.control.model import Model
from modsoft.training.simulation import fleet_kernel, rollout
from modsoft.training.simulation.fleet import Fleet
from modsoft.training.simulation.parameters import plant_of
from modsoft.training.simulation.rollout import ControllerSetup

pytestmark = pytest.mark.instructions

MODELS = Path(__file__).parents[1] / "tools/models"
needs_fleet = pytest.mark.skipif(not fleet_kernel.variants(), reason="the fleet's kernel is not built here")


@pytest.mark.parametrize(
    ("file", "robot"),
    [
        ("pneumatic-3", "pneumatic-3"),
        ("pneumatic-3", "pneumatic-2"),
        ("pneumatic-3x3", "pneumatic-3x3"),
        ("cable-4", "cable-4"),
        ("cable-4", "cable-6"),
    ],
)
def test_shipped_model_fits_its_robots_and_has_its_provenance(file, robot):
    controller = Model.load(MODELS / f"{file}.onnx")
    controller.check(robot_file.load(robot))
    provenance = controller.description.provenance
    assert {"data_sha256", "iterations_done", "seed", "strategy", "code_version"} <= provenance.keys()
    assert f"{file}.onnx" in (MODELS / "README.md").read_text(encoding="utf-8")


@needs_fleet
@pytest.mark.parametrize(
    ("file", "robot", "task", "limit"),
    [
        ("pneumatic-3", "pneumatic-3", "down", 1.0),
        ("pneumatic-3x3", "pneumatic-3x3", "circle", 4.0),
        ("cable-4", "cable-4", "A", 2.0),
        ("cable-4", "cable-6", "A", 8.0),
    ],
)
def test_shipped_model_controls_its_robot(file, robot, task, limit):
    """limit: of the mean error of each module over the first 60 steps, degrees or percent; far above the measured error
    and below half of that of a robot that does not move."""
    robot = robot_file.load(robot)
    controller = Model.load(MODELS / f"{file}.onnx")
    desired = tasks.task(task, robot.motion, robot.modules)[:60]
    setup = ControllerSetup(robot, controller.actuate, controller.history, desired)
    (run,) = rollout.rollout(Fleet(plant_of(robot), robot.modules, 1), [setup]).robots()
    errors = rollout.angle_errors_deg if robot.motion == "planar" else rollout.configuration_errors_percent
    assert errors(run.configuration, desired).mean(axis=0).max() < limit
    at_rest = np.broadcast_to(run.configuration[:1], (61, robot.modules, 3))
    assert errors(at_rest, desired).mean(axis=0).max() > 2 * limit
