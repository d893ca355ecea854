"""Tracker and board of a command that moves the robot: opened in order, driven by the control loop, vented at any end.

Order of start: robot file, tracker, what the command itself needs, and only then the valve port. After arming, any end
vents the valves first (`shutdown.py`); "vented" is reported only after the board confirms it.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import click

from modsoft.runtime import modules
from modsoft.runtime import robot as robot_file
from modsoft.runtime.arrays import Array
from modsoft.runtime.board.board import Board
from modsoft.runtime.board.dry_run import DryRunBoard
from modsoft.runtime.board.ports import describe_ports, find_port
from modsoft.runtime.calibration.use import UsedCalibration, used_by
from modsoft.runtime.clock import Ticker, spinning
from modsoft.runtime.control.controller import Control
from modsoft.runtime.errors import DeviceAbsent, LostInRun, ModsoftError, RobotFileError, UsageError
from modsoft.runtime.files import read_text
from modsoft.runtime.log import RunLog
from modsoft.runtime.log_record import Record
from modsoft.runtime.loop import Loop
from modsoft.runtime.robot import Robot
from modsoft.runtime.safety import FrameValidator, check_rest
from modsoft.runtime.shutdown import finish
from modsoft.runtime.statistics import TickStatistics
from modsoft.runtime.stop import Keys, Paused, Signals, Stop
from modsoft.runtime.terminal import StatusLine
from modsoft.runtime.tracking.frame import LatestFrame
from modsoft.runtime.tracking.reader import Reader
from modsoft.runtime.tracking.sources import open_source, port_of
from modsoft.runtime.warmup import WarmUp

FIRST_FRAME_WAIT_S = 5.0


@dataclass(frozen=True)
class DeviceOptions:
    """Options of every command that moves the robot; empty where the robot file decides. `calibration`: None for the
    file beside the robot file. `modules`: their number, or "auto"."""

    robot: str
    port: str
    tracker: str
    tracker_port: str
    tools: tuple[Path, ...]
    yes: bool
    dry_run: bool
    calibration: Path | None = field(default=None, kw_only=True)
    modules: str = field(default="", kw_only=True)


@dataclass(frozen=True)
class DeviceSetup:
    """The robot and where its devices are, before any of them is opened."""

    robot: Robot
    robot_text: str  # of the robot file
    folder: Path  # that its paths are relative to
    port: str  # of the board, empty in a dry run
    tracker_port: str
    tools: list[Path]
    calibration: UsedCalibration | None = None


def read_setup(options: DeviceOptions) -> DeviceSetup:
    """Reads and checks robot file and calibration; finds the board's port."""
    robot, robot_text, folder = read_robot(options)
    port = ""
    if not options.dry_run:
        if robot.tracker.source == "replay":
            raise UsageError(
                "recorded frames do not show where the robot is, so no valve can follow them; "
                "give --dry-run, or --tracker ndi"
            )
        port = _port(options.port or robot.serial.port)
    tools = list(options.tools) or [folder / tool for tool in robot.tracker.tools]
    tracker_port = options.tracker_port or port_of(robot, folder)
    calibration = used_by(robot, options.robot, tracker_port, tools, options.calibration)
    return DeviceSetup(robot, robot_text, folder, port, tracker_port, tools, calibration)


class Devices:
    """The newest tracker frame, the board, and the request to end.

    now, wait: monotonic seconds, and a wait of some seconds, which may return early; by default those of this machine.
    `board` is None before `open_board`, and in a dry run. calibration: corrects the frames.
    """

    def __init__(
        self,
        robot: Robot,
        frames: LatestFrame,
        board: Board | None = None,
        now: Callable[[], float] = time.monotonic,
        wait: Callable[[float], object] | None = None,
        calibration: UsedCalibration | None = None,
    ):
        self.robot, self.frames, self.board, self.now = robot, frames, board, now
        self.stop = Stop()
        self.signals = Signals(self.stop, self._leave)
        self._wait = wait
        self._mounting = None if calibration is None else calibration.mounting
        self._keys = Keys(self.stop)

    def _leave(self, code: int) -> None:
        self._keys.restore()
        os._exit(code)

    def wait(self, seconds: float) -> None:
        (self._wait or self.stop.wait)(seconds)

    def open_board(self, setup: DeviceSetup, exits: ExitStack) -> None:
        """Opens the valve port; the last device."""
        self.board = Board.open(setup.port, self.robot.serial.baud)
        exits.callback(self.board.close)

    def validator(self) -> FrameValidator:
        """A new validator of the tracker's frames."""
        return FrameValidator(self.robot, *([] if self._mounting is None else [self._mounting.corrected]))

    def rest(self, validator: FrameValidator, missing: type[ModsoftError] = DeviceAbsent) -> Array:
        """The configuration (N, 3) of the vented robot; waits for the first valid frame of the tracker. Raises
        `missing` without one."""
        until_s = self.now() + FIRST_FRAME_WAIT_S
        while True:
            frame = self.frames.latest()
            check = validator.check(frame, self.now())
            if frame is not None and check.configuration is not None:
                check_rest(check.configuration, validator.corrected(frame.poses))
                if self._mounting is not None:
                    self._mounting.check_rest(frame.poses)
                return check.configuration
            if self.frames.error is not None:
                raise missing(f"tracker: {self.frames.error}")
            if self.now() > until_s:
                detail = check.detail or self.frames.problem
                detail = f" ({detail})" if detail else ""
                raise missing(
                    f"tracker: no good frame within {FIRST_FRAME_WAIT_S:.0f} s, the last one {check.status}{detail}; "
                    "are all tools in view?"
                )
            self.wait(0.01)
            self.stop.check()

    def drive(
        self,
        control: Callable[[Array], Control],
        desired: Array,
        log: RunLog,
        statistics: TickStatistics,
        warm_up: bool = False,
        observe: Callable[[Record], None] = lambda record: None,
        status: Callable[[], str] = lambda: "",
        set_points_bar: Callable[[Array], Array] | None = None,
        pausable: bool = False,
    ) -> None:
        """One run: arms the board, runs the loop for the steps of `desired` (see `Loop`), vents, closes the log.

        control: called with the configuration (N, 3) at rest. observe: called with each record after it was logged.
        status: text at the beginning of the status line. set_points_bar: see `Loop`. pausable: the pause key ends the
        run with `Paused`. Returns after the last step, when the board has confirmed the venting (or after a dry run);
        raises what ended it earlier.
        """
        error: BaseException | None = None
        self._keys = Keys(self.stop, pausable)

        def put(record: Record) -> None:
            log.put(record)
            observe(record)

        with ExitStack() as exits:
            try:
                exits.enter_context(self._keys)
                with StatusLine(lambda: status() + _status(statistics, log), sys.stderr):
                    self._control(control, desired, put, statistics, warm_up, set_points_bar)
            except BaseException as raised:  # noqa: BLE001 - raised again after the venting
                error = raised
            finish(self.board, log, statistics, self.frames, error)

    def wait_for_resume(self) -> None:
        """After `Paused`: waits for the pause key. Another request, also one that came after the pause, is raised."""
        self._new_stop()
        with Keys(self.stop, pausable=True):
            while self.stop.error is None:
                self.wait(0.2)
        self._new_stop()

    def _new_stop(self) -> None:
        """Replaces the request of a pause; raises any other one. Signals go to the new one first, so that none is
        lost."""
        before, self.stop = self.stop, Stop()
        self.signals.stop = self.stop
        if not isinstance(before.error, Paused):
            before.check()

    def _control(
        self,
        control: Callable[[Array], Control],
        desired: Array,
        log: Callable[[Record], None],
        statistics: TickStatistics,
        warm_up: bool,
        set_points_bar: Callable[[Array], Array] | None,
    ) -> None:
        """Arms the board and runs the loop; venting is the caller's."""
        robot, board = self.robot, self.board
        if board is not None:
            board.arm(robot)
        validator = self.validator()  # a new one: the operator may have taken long to confirm
        rest = self.rest(validator, missing=LostInRun)
        Loop(
            robot,
            control,
            desired,
            self.frames,
            validator,
            board or DryRunBoard(),
            Ticker(robot.loop.period_s, self.now, self._wait or spinning(self.stop.wait)),
            self.stop,
            log,
            statistics,
            WarmUp(robot, validator, log) if warm_up else None,
            set_points_bar,
        ).run(rest)


@contextmanager
def opened(setup: DeviceSetup) -> Iterator[tuple[Devices, ExitStack]]:
    """The devices with the tracker's frames, and the stack that closes what is opened; signals are requests to end."""
    devices = Devices(setup.robot, LatestFrame(), calibration=setup.calibration)
    with ExitStack() as exits:
        exits.enter_context(devices.signals)
        exits.callback(Reader(open_source(setup.robot, setup.tracker_port, setup.tools), devices.frames).close)
        yield devices, exits


def confirm(
    question: str = "Chambers at 0 bar? No person near the robot? Press Enter to arm, Ctrl-C to leave. ",
) -> None:
    """Waits for the operator's Enter, by default as the confirmation of arming."""
    click.echo(question, err=True, nl=False)
    try:
        line = sys.stdin.readline()
    except (OSError, ValueError):
        line = ""
    if not line:
        raise UsageError("found standard input closed, expected Enter; give --yes")


def read_robot(options: DeviceOptions) -> tuple[Robot, str, Path]:
    """The robot with the options applied, the text of its file, and the folder that its paths are relative to."""
    path = Path(options.robot)
    if not path.is_file() and options.robot == "robot.toml":
        raise RobotFileError(
            "no robot.toml in this folder; give --robot FILE, or make one to start from: "
            "modsoft-runtime --print-robot pneumatic-3 > robot.toml"
        )
    robot = robot_file.load(options.robot, modules.of_option(options.modules, len(options.tools), options.robot))
    if robot.valve is None:
        raise RobotFileError(
            f"robot {robot.name} has no [valve], so it is only simulated (modsoft-simulate); this command drives "
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


def _status(statistics: TickStatistics, log: RunLog) -> str:
    return statistics.status + (f"  LOG: {log.trouble}" if log.trouble else "")
