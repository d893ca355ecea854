"""One run of `modsoft-runtime` from start to end, on `devices.py`.

The model is warmed up before the valve port is opened.
"""

from __future__ import annotations

import hashlib
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from modsoft.runtime import devices
from modsoft.runtime.arrays import Array
from modsoft.runtime.calibration.use import NONE_IN_USE
from modsoft.runtime.control import correction
from modsoft.runtime.control.controller import Controller
from modsoft.runtime.control.features import angle_deg
from modsoft.runtime.control.model import Model
from modsoft.runtime.control.tasks import load_task, task_of
from modsoft.runtime.devices import DeviceOptions, DeviceSetup
from modsoft.runtime.errors import ModelError, UsageError
from modsoft.runtime.log import RunLog
from modsoft.runtime.robot import Robot
from modsoft.runtime.statistics import TickStatistics
from modsoft.runtime.terminal import say


@dataclass(frozen=True)
class Options(DeviceOptions):
    """The options of the command line; empty where the robot file decides."""

    model: Path
    task: str
    correction: str
    runs: Path
    steps: int | None


@dataclass(frozen=True)
class Setup:
    """A run as it is read from files, before any device is opened."""

    options: Options
    devices: DeviceSetup
    model: Model
    model_sha256: str
    task: str
    desired: Array  # (K, N, 3)

    @property
    def meta(self) -> dict[str, Any]:
        """For the log."""
        description = msgspec.to_builtins(self.model.description)
        description.pop("golden", None)
        calibration = self.devices.calibration
        return {
            "command": sys.argv[1:],
            "robot": self.devices.robot.to_dict(),
            "task": self.task,
            "steps": len(self.desired),
            "correction": self.options.correction,
            "model": {"file": str(self.options.model), "sha256": self.model_sha256, "description": description},
            "port": self.devices.port or None,
            "calibration": None if calibration is None else str(calibration),
        }


def run(options: Options) -> None:
    """A whole run. Returns after the last step, when the board has confirmed the venting (or after a dry run); raises
    what ended it earlier."""
    began_s = time.perf_counter()
    setup = _setup(options)
    robot = setup.devices.robot
    with devices.opened(setup.devices) as (rig, exits):
        rest = rig.rest(rig.validator())
        setup.model.warm_up(robot.modules)
        _describe(setup, rest)
        if not options.dry_run:
            rig.open_board(setup.devices, exits)
        say(f"ready {time.perf_counter() - began_s:.1f} s after the start")
        if not (options.dry_run or options.yes):
            devices.confirm()
        rig.signals.hold()  # from here on there is a log to be closed
        meta = {**setup.meta, "board": None if rig.board is None else rig.board.hello._asdict()}
        used = setup.devices.calibration
        calibration = None if used is None else used.text
        log = RunLog(options.runs, robot.name, setup.devices.robot_text, meta, calibration=calibration)
        method = correction.by_name(options.correction, robot.modules)
        rig.drive(
            lambda rest: Controller(robot, setup.model, rest, method),
            setup.desired,
            log,
            TickStatistics(robot, len(setup.desired)),
            warm_up=True,
        )


def _setup(options: Options) -> Setup:
    """Reads and checks robot file, model and task."""
    read = devices.read_setup(options)
    model, sha256 = _model(options.model, read.robot)
    task = options.task or task_of(read.robot, read.folder)
    desired = _task(task, read.robot)[: options.steps]
    return Setup(options, read, model, sha256, task, desired)


def _describe(setup: Setup, rest: Array) -> None:
    """Reports what is going to run. rest: configuration (N, 3)."""
    robot, steps = setup.devices.robot, len(setup.desired)
    rest_deg = angle_deg(rest, robot.motion).round(1) + 0.0  # not -0.0
    angles = ", ".join(f"{angle:.1f}" for angle in rest_deg)
    say(f"robot {robot.name}, {robot.modules} modules, hangs at {angles} degrees")
    say(str(setup.devices.calibration or NONE_IN_USE))
    say(f"model {setup.options.model}, task {setup.task}: {steps} steps, {steps * robot.loop.period_s:.0f} s")
    say(f"correction {setup.options.correction}")


def _model(path: Path, robot: Robot) -> tuple[Model, str]:
    """The model, checked against the robot, and the SHA-256 of its file."""
    if not path.is_file():
        raise ModelError(f"no model {str(path)!r} here; give --model FILE, a file that modsoft-export wrote")
    model = Model.load(path)
    model.check(robot)
    return model, hashlib.sha256(path.read_bytes()).hexdigest()


def _task(task: str, robot: Robot) -> Array:
    if not task:
        raise UsageError("no task given: use --task, or set task under [loop] in the robot file")
    return load_task(task, robot)
