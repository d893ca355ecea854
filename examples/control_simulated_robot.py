"""Control a simulated three-module robot with an exported model: python examples/control_simulated_robot.py [MODEL]"""

import sys
from pathlib import Path

from modsoft.runtime import robot as robot_file
from modsoft.runtime.control.model import Model
from modsoft.runtime.control.tasks import task
from modsoft.training.simulation.fleet import simulated
from modsoft.training.simulation.rollout import ControllerSetup, angle_errors_deg, rollout

SHIPPED = Path(__file__).resolve().parents[1] / "tools" / "models" / "pneumatic-3.onnx"


def main() -> None:
    robot = robot_file.load("pneumatic-3")
    model = Model.load(Path(sys.argv[1]) if len(sys.argv) > 1 else SHIPPED)
    model.check(robot)  # raises an error if it was trained for another kind of robot
    desired = task("down", "planar", robot.modules)  # (K, N, 3), one configuration a control step
    simulator = simulated(robot, 1)
    run = rollout(simulator, [ControllerSetup(robot, model.actuate, model.history, desired)]).robots()[0]
    for module, error in enumerate(angle_errors_deg(run.configuration, desired).mean(axis=0), start=1):
        print(f"module {module}: mean error of the bending angle {error:.2f} degrees")


if __name__ == "__main__":
    main()
