"""One run from start to end.

Order of start: robot file, model, task, tracker, warm-up of the model, and only then the valve port. After arming, any
end of the run vents the valves first (`shutdown.py`); "vented" is reported only after the board confirms it.
"""

from __future__ import annotations

import hashlib
import os
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import msgspec

from modsoft.runtime import robot as robot_file
from modsoft.runtime.arrays import Array
from modsoft.runtime.board.board import Board
from modsoft.runtime.board.dry_run import DryRunBoard
from modsoft.runtime.board.ports import describe_ports, find_port
from modsoft.runtime.clock import Ticker, spinning
from modsoft.runtime.control import correction
from modsoft.runtime.control.features import bending_angle_deg
from modsoft.runtime.control.model import Model
from modsoft.runtime.control.tasks import load_task, task_of
from modsoft.runtime.errors import (
    DeviceAbsent,
    LostInRun,
    ModelError,
    ModsoftError,
    RobotFileError,
    UsageError,
)
from modsoft.runtime.files import read_text
from modsoft.runtime.log import RunLog
from modsoft.runtime.loop import Loop
from modsoft.runtime.robot import Robot
from modsoft.runtime.safety import FrameValidator, check_rest
from modsoft.runtime.shutdown import finish
from modsoft.runtime.statistics import TickStatistics
from modsoft.runtime.stop import Keys, Signals, Stop
from modsoft.runtime.terminal import StatusLine, say
from modsoft.runtime.tracking.frame import LatestFrame
from modsoft.runtime.tracking.reader import Reader
from modsoft.runtime.tracking.sources import open_source, port_of
from modsoft.runtime.warmup import WarmUp

FIRST_FRAME_WAIT_S = 5.0


@dataclass(frozen=True)
class Options:
    """The options of the command line; empty where the robot file decides."""

    robot: str
    model: Path
    task: str
    correction: str
    port: str
    tracker: str
    tracker_port: str
    tools: tuple[Path, ...]
    runs: Path
    steps: int | None
    yes: bool
    dry_run: bool


@dataclass(frozen=True)
class Setup:
    """A run as it is read from files, before any device is opened."""

    options: Options
    robot: Robot
    robot_text: str  # of the robot file
    port: str  # of the board, empty in a dry run
    tracker_port: str
    tools: list[Path]
    model: Model
    model_sha256: str
    task: str
    desired: Array  # (K, N, 3)

    @property
    def meta(self) -> dict[str, Any]:
        """For the log."""
        description = msgspec.to_builtins(self.model.description)
        description.pop("golden", None)
        return {
            "command": sys.argv[1:],
            "robot": self.robot.to_dict(),
            "task": self.task,
            "steps": len(self.desired),
            "correction": self.options.correction,
            "model": {"file": str(self.options.model), "sha256": self.model_sha256, "description": description},
            "port": self.port or None,
        }


def run(options: Options) -> None:
    """A whole run. Returns after the last step, when the board has confirmed the venting (or after a dry run); raises
    what ended it earlier."""
    began_s = time.perf_counter()
    setup = _setup(options)
    robot, stop, frames = setup.robot, Stop(), LatestFrame()
    keys = Keys(stop)

    def leave(code: int) -> None:
        keys.restore()
        os._exit(code)

    with ExitStack() as exits:
        signals = exits.enter_context(Signals(stop, leave))
        exits.callback(Reader(open_source(robot, setup.tracker_port, setup.tools), frames).close)
        rest = _rest(frames, FrameValidator(robot), stop)
        setup.model.warm_up(robot.modules)
        _describe(setup, rest)
        board = None
        if not options.dry_run:
            board = Board.open(setup.port, robot.serial.baud)
            exits.callback(board.close)
        say(f"ready {time.perf_counter() - began_s:.1f} s after the start")
        if board is not None and not options.yes:
            _confirm()
        statistics = TickStatistics(robot, len(setup.desired))
        signals.hold()  # from here on there is a log to be closed
        meta = {**setup.meta, "board": None if board is None else board.hello._asdict()}
        log = RunLog(options.runs, robot.name, setup.robot_text, meta)
        error: BaseException | None = None
        try:
            exits.enter_context(keys)
            _control(setup, board, frames, stop, log, statistics)
        except BaseException as raised:  # noqa: BLE001 - raised again after the venting
            error = raised
        finish(board, log, statistics, frames, error)


def _control(
    setup: Setup, board: Board | None, frames: LatestFrame, stop: Stop, log: RunLog, statistics: TickStatistics
) -> None:
    """Arms the board and runs the task; venting is the caller's."""
    robot = setup.robot
    if board is not None:
        board.arm(robot)
    validator = FrameValidator(robot)  # a new one: the operator may have taken long to confirm
    rest = _rest(frames, validator, stop, missing=LostInRun)
    with StatusLine(lambda: _status(statistics, log), sys.stderr):
        Loop(
            robot,
            setup.model,
            setup.desired,
            frames,
            validator,
            board or DryRunBoard(),
            Ticker(robot.loop.period_s, time.monotonic, spinning(stop.wait)),
            stop,
            log.put,
            statistics,
            correction.by_name(setup.options.correction, robot.modules),
            WarmUp(robot, validator, log.put),
        ).run(rest)


def _setup(options: Options) -> Setup:
    """Reads and checks robot file, model and task."""
    robot, robot_text, folder = _robot(options)
    port = ""
    if not options.dry_run:
        if robot.tracker.source == "replay":
            raise UsageError(
                "recorded frames do not show where the robot is, so no valve can follow them; "
                "give --dry-run, or --tracker ndi"
            )
        port = _port(options.port or robot.serial.port)
    model, sha256 = _model(options.model, robot)
    task = options.task or task_of(robot, folder)
    desired = _task(task, robot)[: options.steps]
    tools = list(options.tools) or [folder / tool for tool in robot.tracker.tools]
    tracker_port = options.tracker_port or port_of(robot, folder)
    return Setup(options, robot, robot_text, port, tracker_port, tools, model, sha256, task, desired)


def _describe(setup: Setup, rest: Array) -> None:
    """Reports what is going to run. rest: configuration (N, 3)."""
    robot, steps = setup.robot, len(setup.desired)
    angles = ", ".join(f"{round(angle, 1) + 0.0:.1f}" for angle in bending_angle_deg(rest))  # not -0.0
    say(f"robot {robot.name}, {robot.modules} modules, hangs at {angles} degrees")
    say(f"model {setup.options.model}, task {setup.task}: {steps} steps, {steps * robot.loop.period_s:.0f} s")
    say(f"correction {setup.options.correction}")


def _robot(options: Options) -> tuple[Robot, str, Path]:
    """The robot with the options applied, the text of its file, and the folder that its paths are relative to."""
    path = Path(options.robot)
    if not path.is_file() and options.robot == "robot.toml":
        raise RobotFileError(
            "no robot.toml in this folder; give --robot FILE, or make one to start from: "
            "modsoft-runtime --print-robot pneumatic-3 > robot.toml"
        )
    robot = robot_file.load(options.robot)
    if robot.valve is None:
        raise RobotFileError(
            f"robot {robot.name} has no [valve], so it is only simulated (modsoft-simulate); modsoft-runtime drives "
            "robots with chambers"
        )
    if options.tracker:
        table = robot.to_dict()
        table["tracker"]["source"] = options.tracker
        robot = robot_file.from_dict(table, options.robot)
    text = read_text(path, RobotFileError) if path.is_file() else robot_file.text_of(options.robot)
    return robot, text, robot_file.folder_of(path)


def _port(name: str) -> str:
    """The board's port, which exists. It is opened last."""
    if not name:
        raise UsageError(
            f"no board port given: use --port, or set port under [serial] in the robot file; {describe_ports()}"
        )
    return find_port(name)


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


def _rest(
    frames: LatestFrame,
    validator: FrameValidator,
    stop: Stop,
    now: Callable[[], float] = time.monotonic,
    missing: type[ModsoftError] = DeviceAbsent,
) -> Array:
    """The configuration (N, 3) of the vented robot; waits for the first valid frame of the tracker. Raises `missing`
    without one."""
    until_s = now() + FIRST_FRAME_WAIT_S
    while True:
        frame = frames.latest()
        check = validator.check(frame, now())
        if frame is not None and check.configuration is not None:
            check_rest(check.configuration, frame.poses)
            return check.configuration
        if frames.error is not None:
            raise missing(f"tracker: {frames.error}")
        if now() > until_s:
            detail = check.detail or frames.problem
            detail = f" ({detail})" if detail else ""
            raise missing(
                f"tracker: no good frame within {FIRST_FRAME_WAIT_S:.0f} s, the last one {check.status}{detail}; "
                "are all tools in view?"
            )
        stop.wait(0.01)
        stop.check()


def _confirm() -> None:
    """Waits for the operator's Enter, which confirms arming."""
    click.echo("Chambers at 0 bar? No person near the robot? Press Enter to arm, Ctrl-C to leave. ", err=True, nl=False)
    try:
        line = sys.stdin.readline()
    except (OSError, ValueError):
        line = ""
    if not line:
        raise UsageError("arming needs Enter, and standard input is closed; give --yes")


def _status(statistics: TickStatistics, log: RunLog) -> str:
    return statistics.status + (f"  LOG: {log.trouble}" if log.trouble else "")
