"""One run from beginning to end: the order of start, and every way out.

Order: robot file, model, task, tracker, warm-up of the model, and only then the valve port. Whatever happens from
arming on, the valves are vented before anything else, and "vented" is only said after the board said so.
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

import click
import msgspec

from modsoft.runtime import log as logs
from modsoft.runtime import robot as robots
from modsoft.runtime.arrays import Array
from modsoft.runtime.board.board import Board
from modsoft.runtime.board.dry_run import DryRunBoard
from modsoft.runtime.board.ports import describe_ports, find_port
from modsoft.runtime.board.protocol import VentMode
from modsoft.runtime.clock import Ticker, spinning
from modsoft.runtime.control import correction
from modsoft.runtime.control.features import bending_angle_deg
from modsoft.runtime.control.model import Model
from modsoft.runtime.control.tasks import load_task, task_of
from modsoft.runtime.errors import (
    INTERNAL_EXIT_CODE,
    DeviceAbsent,
    LostInRun,
    ModelError,
    ModsoftError,
    RobotFileError,
    Tripped,
    UsageError,
)
from modsoft.runtime.files import read_text
from modsoft.runtime.log_record import EndRecord
from modsoft.runtime.loop import Loop
from modsoft.runtime.robot import Robot
from modsoft.runtime.safety import FrameValidator, check_rest
from modsoft.runtime.statistics import TickStatistics
from modsoft.runtime.status_line import StatusLine
from modsoft.runtime.stop import Keys, Signals, Stop, StopKey
from modsoft.runtime.tracking.frame import LatestFrame
from modsoft.runtime.tracking.reader import Reader
from modsoft.runtime.tracking.sources import open_source, port_of
from modsoft.runtime.warmup import WarmUp

FIRST_FRAME_WAIT_S = 5.0


@dataclass(frozen=True)
class Options:
    """What the command line said; empty where the robot file decides."""

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


def run(options: Options) -> None:
    """The whole run. Returns after the last step, with the valves vented by the board's own word (or after a dry run);
    raises what ended it earlier."""
    said = time.perf_counter()
    robot, robot_text, beside = _robot(options)
    port = ""
    if not options.dry_run:
        if robot.tracker.source == "replay":
            raise UsageError(
                "recorded frames say nothing of where the robot is, so no valve is driven by them; "
                "give --dry-run, or --tracker ndi"
            )
        port = _port(options.port or robot.serial.port)
    controller, digest = _model(options.model, robot)
    task = options.task or task_of(robot, beside)
    desired = _task(task, robot)[: options.steps]
    tools = list(options.tools) or [beside / tool for tool in robot.tracker.tools]

    stop = Stop()
    keys = Keys(stop)

    def leave(code: int) -> None:
        keys.restore()
        os._exit(code)

    with ExitStack() as exits:
        signals = exits.enter_context(Signals(stop, leave))
        slot = LatestFrame()
        reader = Reader(open_source(robot, options.tracker_port or port_of(robot, beside), tools), slot)
        exits.callback(reader.close)
        rest = _rest(slot, FrameValidator(robot), stop)
        controller.warm_up(robot.modules)
        _say(f"robot {robot.name}, {robot.modules} modules, hangs at {_angles(rest)} degrees")
        _say(f"model {options.model}, task {task}: {len(desired)} steps, {len(desired) * robot.loop.period_s:.0f} s")
        _say(f"correction {options.correction}")

        board = None
        if not options.dry_run:
            board = Board.open(port, robot.serial.baud)
            exits.callback(board.close)
        _say(f"ready {time.perf_counter() - said:.1f} s after the start")
        if board is not None and not options.yes:
            _ask()
        tally = TickStatistics(robot, len(desired))
        signals.hold()  # from here on there is a log to be closed
        log = logs.RunLog(
            options.runs,
            robot.name,
            robot_text,
            {
                "command": sys.argv[1:],
                "robot": robot.to_dict(),
                "task": task,
                "steps": len(desired),
                "correction": options.correction,
                "model": {"file": str(options.model), "sha256": digest, "description": _described(controller)},
                "board": None if board is None else board.hello._asdict(),
                "port": port or None,
            },
        )
        error: BaseException | None = None
        try:
            exits.enter_context(keys)
            if board is not None:
                board.arm(robot)
            judge = FrameValidator(robot)  # a new one: Enter may have been long in coming
            rest = _rest(slot, judge, stop, missing=LostInRun)
            with StatusLine(lambda: _status(tally, log), sys.stderr):
                Loop(
                    robot,
                    controller,
                    desired,
                    slot,
                    judge,
                    board or DryRunBoard(),
                    Ticker(robot.loop.period_s, time.monotonic, spinning(stop.wait)),
                    stop,
                    log.put,
                    tally,
                    correction.by_name(options.correction, robot.modules),
                    WarmUp(robot, judge, log.put),
                ).run(rest)
        except BaseException as raised:  # noqa: BLE001 - raised again below, after the venting
            error = raised
        finish(board, log, tally, slot, error)


def finish(
    board: Board | None, log: logs.RunLog, tally: TickStatistics, slot: LatestFrame, error: BaseException | None
) -> None:
    """Vents, closes the log, says what came of the run, and raises what ended it, if anything did."""
    began_ns, vented_ns = time.monotonic_ns(), None
    vented, pressed = False, dict[int, float]()
    if board is not None:
        try:
            vented = board.vent(VentMode.DUMP if isinstance(error, StopKey) else VentMode.RAMP)
            vented_ns = time.monotonic_ns() if vented else None
            pressed = board.residual_pressures_bar() if vented else {}
        except Exception as failed:  # noqa: BLE001 - the log must still be closed; the board's own timer vents
            error = error or failed
        if not vented and error is None:
            error = LostInRun("the task was done, but the board never said that it is vented; look at the pressures")
    if pressed:
        found = ", ".join(f"channel {channel} still measures {bar:.2f} bar" for channel, bar in pressed.items())
        before = f" (the run ended before that: {str(error) or type(error).__name__})" if error is not None else ""
        advice = "shut off the air, then look at that valve and its sensor"
        stuck = Tripped(f"the valves are commanded to 0, but {found}: {advice}{before}")
        stuck.__cause__ = error
        error = stuck
    code, reason = 0, "done"
    if error is not None:
        code = error.exit_code if isinstance(error, ModsoftError) else INTERNAL_EXIT_CODE
        reason = str(error) or type(error).__name__
    log.put(EndRecord(began_ns, code, reason, vented, vented_ns, pressed))
    if board is None:
        word = "dry run, no valve was touched"
    else:
        word = "yes, said by the board" if vented else "NOT KNOWN, the board did not say so; look at the pressures"
    for line in [*tally.summary(), f"valves vented: {word}"]:  # before the log: a disk may hang
        _say(line)
    figures = {"figures": tally.figures(), "tracker": dict(slot.counts), "vented": vented}
    log.close(code, reason, {**figures, "connection": None if board is None else board.statistics})
    _say(f"log: {log.folder}")
    if log.trouble:
        _say(f"log: {log.trouble}")
    if error is not None:
        raise error


def _robot(options: Options) -> tuple[Robot, str, Path]:
    """The robot with what the command line changes in it, its file's text, and the folder that its paths start from."""
    path = Path(options.robot)
    if not path.is_file() and options.robot == "robot.toml":
        raise RobotFileError(
            "no robot.toml in this folder; give --robot FILE, or make one to start from: "
            "modsoft-runtime --print-robot pneumatic-3 > robot.toml"
        )
    robot = robots.load(options.robot)
    if robot.kind != "pneumatic":
        raise RobotFileError(
            f"robot {robot.name} is of kind {robot.kind!r}, which is only simulated (modsoft-simulate); "
            "modsoft-runtime drives pneumatic robots"
        )
    if options.tracker:
        table = robot.to_dict()
        table["tracker"]["source"] = options.tracker
        robot = robots.from_dict(table, options.robot)
    text = read_text(path, RobotFileError) if path.is_file() else robots.text_of(options.robot)
    return robot, text, robots.folder_of(path)


def _port(told: str) -> str:
    """The board's port, which is there. It is not opened: that comes last."""
    if not told:
        raise UsageError(
            f"the board's port is not told; give --port, or port under [serial] in the robot file; {describe_ports()}"
        )
    return find_port(told)


def _model(path: Path, robot: Robot) -> tuple[Model, str]:
    """The controller, proven and of this robot, and its file's SHA-256."""
    if not path.is_file():
        raise ModelError(f"no model {str(path)!r} here; give --model FILE, a file that modsoft-export wrote")
    controller = Model.load(path)
    controller.check(robot)
    return controller, hashlib.sha256(path.read_bytes()).hexdigest()


def _described(controller: Model) -> dict[str, object]:
    """What the model says about itself, without the golden pairs."""
    said = msgspec.to_builtins(controller.description)
    said.pop("golden", None)
    return said


def _task(task: str, robot: Robot) -> Array:
    if not task:
        raise UsageError("the task is not told; give --task, or task under [loop] in the robot file")
    return load_task(task, robot)


def _rest(
    slot: LatestFrame,
    judge: FrameValidator,
    stop: Stop,
    now: Callable[[], float] = time.monotonic,
    missing: type[ModsoftError] = DeviceAbsent,
) -> Array:
    """The configuration (N, 3) in which the vented robot hangs; waits for the tracker's first good frame. Raises
    `missing` where there is none."""
    until_s = now() + FIRST_FRAME_WAIT_S
    while True:
        frame = slot.latest()
        judged = judge.judge(frame, now())
        if frame is not None and judged.configuration is not None:
            check_rest(judged.configuration, frame.poses)
            return judged.configuration
        if slot.error is not None:
            raise missing(f"tracker: {slot.error}")
        if now() > until_s:
            detail = judged.detail or slot.problem
            detail = f" ({detail})" if detail else ""
            raise missing(
                f"tracker: no good frame within {FIRST_FRAME_WAIT_S:.0f} s, the last one {judged.word}{detail}; "
                "are all tools in view?"
            )
        stop.wait(0.01)
        stop.check()


def _ask() -> None:
    """Arming is a person's decision."""
    click.echo("Chambers at 0 bar? Nobody near the robot? Press Enter to arm, Ctrl-C to leave. ", err=True, nl=False)
    try:
        answered = sys.stdin.readline()
    except (OSError, ValueError):
        answered = ""
    if not answered:
        raise UsageError("arming asks for Enter, and there is nobody to press it; give --yes")


def _status(tally: TickStatistics, log: logs.RunLog) -> str:
    return tally.status + (f"  LOG: {log.trouble}" if log.trouble else "")


def _say(text: str) -> None:
    """A line for the person at the terminal, who may have left."""
    try:
        click.echo(text, err=True)
    except (OSError, ValueError):
        pass


def _angles(configuration: Array) -> str:
    return ", ".join(f"{round(angle, 1) + 0.0:.1f}" for angle in bending_angle_deg(configuration))  # not -0.0
