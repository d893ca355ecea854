"""The emulated robot of this study on its rig: firmware, valves, tracker with noise and mounting errors."""

from __future__ import annotations

import functools
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Final

from modsoft.hil import closed_loop
from modsoft.hil.closed_loop import Motion
from modsoft.hil.polaris import write_tool_files
from modsoft.hil.polaris_device import Polaris
from modsoft.hil.stepped import SteppedRig
from modsoft.hil.tool_errors import ToolErrors
from modsoft.runtime import robot as robot_file
from modsoft.runtime.arrays import Array
from modsoft.runtime.calibration import file, rest
from modsoft.runtime.calibration.measure import Collector
from modsoft.runtime.calibration.rest import Measured
from modsoft.runtime.calibration.use import UsedCalibration
from modsoft.runtime.control.controller import Control
from modsoft.runtime.files import read_text
from modsoft.runtime.robot import Robot
from modsoft.study.rig.plan import MOUNTING_DEG, MOUNTING_MM, NOISE_MM, robot_of
from modsoft.training.simulation import fleet_kernel
from modsoft.training.simulation.elastica import Arm
from modsoft.training.simulation.fleet_arm import FleetArm
from modsoft.training.simulation.parameters import plant_of

CALIBRATION = 999  # number of the run that measures the mounting
MOUNTING_SEED = 0
FRAMES_OF_A_RUN = 1_000_000  # more than any run has
BOARD: Final = (
    "native"  # the firmware's logic, compiled for this machine: a tenth of the time of the emulated processor
)


@functools.cache
def robot_and_arm(modules: int, fast: bool = False) -> tuple[Robot, Arm | FleetArm]:
    """The robot and its simulation, which takes seconds to settle. fast: the compiled fleet where this installation has
    it; PyElastica otherwise."""
    robot = robot_file.load(robot_of(modules))
    compiled = fast and fleet_kernel.library() is not None
    return robot, (FleetArm if compiled else Arm)(plant_of(robot), modules)


def errors(noise_deg: float) -> ToolErrors:
    """Of the tracker's tools."""
    return ToolErrors(MOUNTING_DEG, MOUNTING_MM, noise_deg, NOISE_MM, MOUNTING_SEED)


def rig(modules: int, noise_deg: float, number: int) -> SteppedRig:
    """The rig with the robot at rest. number: of the run, which determines the noise of its frames."""
    robot, arm = robot_and_arm(modules)
    arm.reset()

    def tracker(now: Callable[[], float]) -> Polaris:
        device = Polaris(now, errors=errors(noise_deg))
        device.take({"back": -FRAMES_OF_A_RUN * number})  # the noise depends on the number of the frame
        return device

    return SteppedRig(robot, arm, BOARD, tracker)


def calibrate(path: Path, modules: int, noise_deg: float) -> None:
    """Writes the calibration file of the robot at rest, as `modsoft-calibrate rest` does."""
    robot = robot_file.load(robot_of(modules))
    with rig(modules, noise_deg, CALIBRATION) as stepped, tempfile.TemporaryDirectory() as folder:
        tool_files = write_tool_files(Path(folder), modules + 1)
        tools = Collector(robot, stepped.frames, now=stepped.clock, wait=stepped.wait).run()
        names = [path.name for path in tool_files]
        measured = Measured(tools, stepped.tracker.device.firmware, names, file.sha256_of(tool_files), file.now())
    file.write(path, rest.calibrated(measured, robot.name, None))


def run(
    modules: int,
    noise_deg: float,
    number: int,
    calibration_file: Path,
    control: Callable[[Array], Control],
    desired: Array,
) -> Motion:
    """One run on the stepped rig, with another noise for each `number` from 0. control, desired: see `Loop`."""
    with rig(modules, noise_deg, number) as stepped:
        return closed_loop.run(stepped, control, desired, calibration(calibration_file, stepped.robot))


def calibration(path: Path, robot: Robot) -> UsedCalibration:
    """A calibration file, checked against the robot."""
    entries = file.read(path)
    file.check(entries, robot, None, path)
    return UsedCalibration(path, read_text(path), entries, robot.modules)
