"""The calibrations that open valves: armed, limited, stopped and vented as every run of the control loop."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.board.board import Board
from modsoft.runtime.board.protocol import CHANNELS
from modsoft.runtime.calibration import channel_faults, channels, valves
from modsoft.runtime.calibration.chambers_text import replace_chambers
from modsoft.runtime.calibration.schedule import MARGIN_ROWS, Sample, ScheduledPressures, for_calibration
from modsoft.runtime.calibration.use import NONE_IN_USE
from modsoft.runtime.devices import DeviceOptions, Devices, DeviceSetup, confirm, opened, read_setup
from modsoft.runtime.errors import RobotFileError, Tripped, UsageError
from modsoft.runtime.layout import listed
from modsoft.runtime.log import RunLog
from modsoft.runtime.robot import Chamber, Robot
from modsoft.runtime.statistics import TickStatistics
from modsoft.runtime.terminal import say

PRESSURE_SHARE = 0.4  # of the range from p_min_bar to p_max_bar: default pressure of a pulse
LEAST_SHARE_BAR = 0.05  # set-point with which a reading is compared


@dataclass(frozen=True)
class Options(DeviceOptions):
    """The options of the command line. `pressure_bar`: None for the default. `channels`: text, empty for those of the
    robot file. `yes`: arms and writes without asking."""

    runs: Path
    pressure_bar: float | None = None
    channels: str = ""


class Plan(NamedTuple):
    """A calibration. channels: those that the board drives. rows_bar (R, channels): set-points. active: the channel
    under test in a row."""

    name: str
    channels: tuple[int, ...]
    rows_bar: Array
    active: Callable[[int], int | None]
    watch: Callable[[Sample], None]


class Result(NamedTuple):
    """`chambers`: None where faults prevent it. `lines`: results and faults."""

    lines: list[str]
    faults: list[str]
    chambers: tuple[Chamber, ...] | None


# ---- Which hose is where


def default_pressure_bar(robot: Robot) -> float:
    """Pressure of a pulse, bar."""
    assert robot.valve is not None  # checked by read_setup
    low, high = robot.valve.p_min_bar, robot.valve.p_max_bar
    return round(low + PRESSURE_SHARE * (high - low), 3)


def chosen_channels(text: str, robot: Robot, available: int) -> tuple[int, ...]:
    """The channels of a text such as "0-5,8", or "all"; of the robot file for an empty one. `UsageError`."""
    if not text:
        return tuple(sorted(chamber.channel for chamber in robot.chambers))
    if text == "all":
        return tuple(range(available))
    chosen = set[int]()
    for part in text.split(","):
        bounds = re.fullmatch(r"\s*(\d+)\s*(?:-\s*(\d+)\s*)?", part)
        if bounds is None or int(bounds[2] or bounds[1]) < int(bounds[1]):
            raise UsageError(f"--channels {text}: found {part!r}, expected channels such as 0-5,8, or all")
        chosen.update(range(int(bounds[1]), int(bounds[2] or bounds[1]) + 1))
    if max(chosen) >= available:
        raise UsageError(f"--channels {text}: the board has channels 0 to {available - 1}")
    return tuple(sorted(chosen))


def plan_channels(robot: Robot, chosen: tuple[int, ...], pressure_bar: float) -> Plan:
    """A pulse of each of these channels."""
    rows_bar = channels.schedule(chosen, pressure_bar)
    watch = channels.Watch(chosen, rows_bar)
    return Plan("channels", chosen, rows_bar, lambda row: channels.channel_of_row(chosen, row), watch)


def evaluate_channels(robot: Robot, plan: Plan, samples: list[Sample]) -> Result:
    """The chambers at the channels' hoses."""
    pulses = [channels.pulse_of(samples, plan.channels, number) for number in range(len(plan.channels))]
    report = channel_faults.report(pulses, robot)
    lines = [channels.describe(pulse, report.places.get(pulse.channel)) for pulse in pulses]
    if missing := [pulse.channel for pulse in pulses if np.isnan(pulse.share)]:
        lines.append(f"no pressure sensor at channels {listed(missing)}")
    lines += report.notes + report.warnings
    if report.faults:
        return Result(lines, report.faults, None)
    return Result(lines + channels.exchanged(robot, report.places), [], channels.chambers(robot, report.places))


# ---- Gain and offset of the valves


def plan_valves(robot: Robot, sensors: Sequence[int], board: str) -> Plan:
    """Five pressures of every chamber that has a sensor. `UsageError` where none has one. sensors: channels with one;
    board: its name, for messages."""
    assert robot.valve is not None  # checked by read_setup
    used = tuple(sorted(chamber.channel for chamber in robot.chambers))
    sensed = tuple(channel for channel in used if channel in sensors)
    if not sensed:
        raise UsageError(
            f"the board at {board} has no pressure sensor at channels {listed(used)}, expected one or more: "
            "connect sensors and build the firmware for them (SENSORS in firmware/pins.h)"
        )
    rows_bar = valves.schedule(used, sensed, robot.valve)
    watch = valves.Watch(sensed, rows_bar)
    return Plan("valves", used, rows_bar, lambda row: valves.channel_of_row(sensed, row), watch)


def evaluate_valves(robot: Robot, plan: Plan, samples: list[Sample]) -> Result:
    """Gains and offsets."""
    sensed = [channel for channel in plan.channels if not np.isnan(samples[0].measured_bar[channel])]
    fits = [valves.fit_of(samples, sensed, number) for number in range(len(sensed))]
    faults = valves.faults(fits)
    return Result(valves.notes(fits, robot), faults, None if faults else valves.chambers(robot, fits))


# ---- The run


def measure(devices: Devices, robot: Robot, plan: Plan, log: RunLog) -> list[Sample]:
    """Arms the board, sets the pressures of the plan row by row, and vents. Raises what ended it earlier."""
    devices.robot = for_calibration(robot, plan.channels)

    def read() -> tuple[Array, Array, Array]:
        frame, board = devices.frames.latest(), devices.board
        assert frame is not None  # a frame was checked just before
        assert board is not None  # there is no dry run
        return frame.poses[0], board.applied_bar, board.measured_bar

    control = ScheduledPressures(robot, plan.rows_bar, read, plan.watch)
    steps = len(plan.rows_bar) + MARGIN_ROWS
    try:
        devices.drive(
            lambda rest: control,
            np.full((steps, robot.modules, 3), np.nan),
            log,
            TickStatistics(devices.robot, steps),
            status=lambda: "" if (channel := plan.active(control.row)) is None else f"channel {channel}  ",
            set_points_bar=control.set_points_bar,
        )
    except Tripped as error:
        status = devices.board.status if devices.board is not None else None
        channel = plan.active(control.row)
        if status is None or not status.faults or not control.samples or channel is None:
            raise
        raise Tripped(f"{error} (channel {channel} was tested: {_pressures(control.samples[-1])})") from error
    control.check_complete()
    return control.samples


def _pressures(sample: Sample) -> str:
    """How the sensors disagree with the set-points."""
    shares = (sample.measured_bar / sample.applied_bar)[sample.applied_bar >= LEAST_SHARE_BAR]
    if scale := channel_faults.wrong_full_scale(list(shares), channel_faults.LEAST_SHARE, channel_faults.MOST_SHARE):
        return scale
    most = int(np.argmax(np.nan_to_num(np.abs(sample.measured_bar - sample.applied_bar))))
    return (
        f"channel {most} was set to {sample.applied_bar[most]:.2f} bar and its sensor measured "
        f"{sample.measured_bar[most]:.2f}"
    )


def run_channels(options: Options) -> None:
    """`modsoft-calibrate channels`."""
    path, setup = _file_of(options), read_setup(options)
    robot = setup.robot
    assert robot.valve is not None  # checked by read_setup
    pressure_bar = default_pressure_bar(robot) if options.pressure_bar is None else options.pressure_bar
    if not 0.0 < pressure_bar <= robot.valve.p_max_bar:
        raise UsageError(
            f"--pressure {pressure_bar:g}: expected more than 0 and at most p_max_bar, {robot.valve.p_max_bar:g} bar"
        )

    def plan(board: Board) -> Plan:
        chosen = chosen_channels(options.channels, robot, board.hello.channels)
        seconds = channels.PERIOD_S * len(channels.schedule(chosen, pressure_bar))
        say(f"one pulse of {pressure_bar:g} bar at each of the channels {listed(chosen)}: {seconds:.0f} s")
        return plan_channels(robot, chosen, pressure_bar)

    _write(options, path, setup, evaluate_channels(robot, *_measured(options, setup, plan)))


def run_valves(options: Options) -> None:
    """`modsoft-calibrate valves`."""
    path, setup = _file_of(options), read_setup(options)
    robot = setup.robot

    def plan(board: Board) -> Plan:
        plan = plan_valves(robot, [each for each in range(CHANNELS) if board.hello.sensors >> each & 1], board.name)
        assert robot.valve is not None  # checked by read_setup
        seconds = channels.PERIOD_S * len(plan.rows_bar)
        levels = listed([round(float(each), 3) for each in valves.levels_bar(robot.valve)])
        say(f"pressures of {levels} bar, one chamber after the other: {seconds:.0f} s")
        return plan

    _write(options, path, setup, evaluate_valves(robot, *_measured(options, setup, plan)))


def _file_of(options: Options) -> Path:
    """The robot file, which is going to be written. `RobotFileError` for the name of a shipped robot."""
    path = Path(options.robot)
    if not path.is_file() and options.robot != "robot.toml":  # a missing robot.toml has its own message
        raise RobotFileError(
            f"no robot file {options.robot!r} here, expected one to write the result to; make one to start from: "
            "modsoft-runtime --print-robot pneumatic-3 > robot.toml"
        )
    return path


def _measured(options: Options, setup: DeviceSetup, plan_for: Callable[[Board], Plan]) -> tuple[Plan, list[Sample]]:
    """Opens tracker and board, asks before arming, and measures."""
    robot = setup.robot
    with opened(setup) as (devices, exits):
        devices.rest(devices.validator())
        say(str(setup.calibration or NONE_IN_USE))
        devices.open_board(setup, exits)
        assert devices.board is not None
        plan = plan_for(devices.board)
        if not options.yes:
            confirm()
        devices.signals.hold()  # from here on there is a log to be closed
        meta: dict[str, Any] = {
            "command": sys.argv[1:],
            "task": f"calibration of {plan.name}",
            "robot": robot.to_dict(),
            "channels": plan.channels,
            "calibration": None if setup.calibration is None else str(setup.calibration),
            "port": setup.port,
            "board": devices.board.hello._asdict(),
        }
        used = None if setup.calibration is None else setup.calibration.text
        log = RunLog(options.runs, f"{robot.name}-{plan.name}", setup.robot_text, meta, calibration=used)
        return plan, measure(devices, robot, plan, log)


def _write(options: Options, path: Path, setup: DeviceSetup, result: Result) -> None:
    """Shows the result, and writes it after a confirmation. Raises `Tripped` where faults prevent it."""
    for line in result.lines:
        click.echo(line)
    if result.chambers is None:
        for line in result.faults[:-1]:
            say(line)
        raise Tripped(f"{result.faults[-1]}; {path} is not changed")
    lines = channels.changes(setup.robot, result.chambers)
    if not lines:
        click.echo(f"{path} has these values already: not changed")
        return
    for line in [f"changes of {path}:", *lines]:
        click.echo(line)
    if not options.yes and not click.confirm(f"Write {path}?", err=True):
        click.echo(f"{path} is not changed")
        return
    backup = replace_chambers(path, setup.robot_text, result.chambers)
    click.echo(f"{path} is written; the file before is {backup}")
