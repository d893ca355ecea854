"""`modsoft-runtime`: the console script of the lab PC."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from modsoft.runtime import robot as robot_file
from modsoft.runtime.choices import CORRECTIONS
from modsoft.runtime.entry_point import entry
from modsoft.runtime.errors import RobotFileError, UsageError
from modsoft.runtime.modules import AUTO
from modsoft.runtime.terminal import has_terminal


def _print_ports() -> None:
    from modsoft.runtime.board.ports import list_ports  # --help does without pyserial

    ports = list_ports()
    for port in ports:
        click.echo(port)
    if not ports:
        click.echo("no serial port on this machine; is the board plugged in?", err=True)


def _check_robot(name: str) -> None:
    from modsoft.runtime.control.tasks import load_task, task_of  # --help does without numpy

    robot, folder = robot_file.load(name), robot_file.folder_of(name)
    task, steps = task_of(robot, folder), 0
    calibration = "" if robot.valve is None else _calibration(name)
    if task:
        try:
            steps = len(load_task(task, robot))
        except UsageError as error:
            raise RobotFileError(f"{name}: task under [loop]: {error}") from error
    click.echo(f"{name}: {robot.name}, {robot.motion}, {robot.modules} modules, {robot.loop.hz:g} Hz")
    if task:
        click.echo(f"task {task}: {steps} steps, {steps * robot.loop.period_s:g} s")
    if robot.valve is not None:
        valve = robot.valve
        click.echo(
            f"valves: {valve.model}, full scale {valve.full_scale_bar:g} bar, {valve.p_min_bar:g} to "
            f"{valve.p_max_bar:g} bar; is full_scale_bar what the label says?"
        )
        click.echo(calibration)
    for chamber in robot.chambers:
        click.echo(f"module {chamber.module}, chamber at {chamber.direction_deg:g} degrees: channel {chamber.channel}")
    open_ends = _open_ends(robot, folder)
    if open_ends:
        click.echo(f"still to fill in before a run: {'; '.join(open_ends)}")
    click.echo("ok")


def _calibration(name: str) -> str:
    """The calibration beside a robot file, in words. Raises `ModelError` for a damaged one."""
    from modsoft.runtime.calibration import file

    path = file.path_for(name)
    if not path.is_file():
        return "no calibration of the tools; modsoft-calibrate rest writes one"
    calibration = file.read(path)
    return (
        f"calibration {path} of {calibration.date[:10]}: robot {calibration.robot}, {len(calibration.modules)} modules"
    )


def _open_ends(robot: robot_file.Robot, beside: Path) -> list[str]:
    """What a valid robot file leaves to the command line, in words. Its paths start from the folder `beside`."""
    missing = [] if robot.loop.task else ["task under [loop], or --task"]
    if robot.valve is None:
        return missing  # simulated: there is nothing to connect
    tracker = robot.tracker
    if not tracker.port:
        missing.append("port under [tracker], or --tracker-port")
    elif tracker.source == "replay" and not (beside / tracker.port).exists():
        missing.append(f"{beside / tracker.port}, which is not there")
    if tracker.source == "ndi" and tracker.type != "aurora":  # aurora's tools are wired
        if not tracker.tools:
            missing.append("tools under [tracker], or --tool")
        missing += [f"{beside / tool}, which is not there" for tool in tracker.tools if not (beside / tool).is_file()]
    if not robot.serial.port:
        missing.append("port under [serial], or --port")
    return missing


def _without_run(list_ports: bool, check: str | None, print_robot: str | None) -> bool:
    """Handles the options that start no run. Returns whether one was given."""
    options = [list_ports, check is not None, print_robot is not None]
    if sum(options) > 1:
        raise UsageError("--list-ports, --check and --print-robot do one thing each and leave; give one of them")
    if list_ports:
        _print_ports()
    if check is not None:
        _check_robot(check)
    if print_robot is not None:
        click.echo(robot_file.text_of(print_robot), nl=False)
    return any(options)


def _modules(context: click.Context, parameter: click.Parameter, value: str) -> str:
    if value not in ("", AUTO) and not (value.isdecimal() and 2 <= int(value) <= 64):
        raise click.BadParameter(f"found {value!r}, expected a number from 2 to 64, or auto")
    return value


@click.command("modsoft-runtime", context_settings={"max_content_width": 100, "help_option_names": ["-h", "--help"]})
@click.option(
    "--port",
    default="",
    metavar="PORT",
    help="Serial port of the board, such as /dev/ttyACM0 or COM3, or its USB serial number as --list-ports "
    "says it. [default: port under [serial] in the robot file]",
)
@click.option(
    "--robot", default="robot.toml", show_default=True, metavar="FILE|NAME", help="Robot file, or a shipped robot."
)
@click.option(
    "--model",
    default="model.onnx",
    show_default=True,
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="Controller, written by modsoft-export.",
)
@click.option(
    "--task",
    default="",
    metavar="NAME|FILE",
    help="edge, down, circle, A, B, C, or a .npy file of desired configurations (steps, modules, 3). [default: task "
    "under [loop] in the robot file, where every path starts from that file's folder]",
)
@click.option("--steps", type=click.IntRange(1), metavar="N", help="Stop after the first N control steps.")
@click.option(
    "--correction",
    default="none",
    show_default=True,
    type=click.Choice(CORRECTIONS),
    help="integral: the accumulated configuration error shifts what the model is asked for.",
)
@click.option(
    "--tracker",
    type=click.Choice(["ndi", "replay"]),
    metavar="ndi|replay",
    help="Where frames come from. [default: source under [tracker] in the robot file]",
)
@click.option(
    "--tracker-port",
    default="",
    metavar="PORT",
    help="Serial port of the tracker (vega: its address; replay: a run's folder). [default: port under "
    "[tracker] in the robot file]",
)
@click.option(
    "--tool",
    "tools",
    multiple=True,
    metavar="FILE",
    type=click.Path(path_type=Path),
    help="Tool definition file, once for each tool: base, then module 1 to N. [default: tools under "
    "[tracker] in the robot file]",
)
@click.option(
    "--modules",
    default="",
    metavar="N|auto",
    callback=_modules,
    help="Number of modules: the first N of the robot file; auto: as many as have a tool and chambers. [default: "
    "modules under [robot] in the robot file]",
)
@click.option(
    "--calibration",
    metavar="FILE|none",
    type=click.Path(path_type=Path),
    help="Calibration of the tools, written by modsoft-calibrate. [default: NAME.calibration.toml beside NAME.toml, "
    "the robot file]",
)
@click.option(
    "--runs-dir",
    default="runs",
    show_default=True,
    metavar="FOLDER",
    type=click.Path(path_type=Path),
    help="Where the log of each run is kept.",
)
@click.option("--yes", is_flag=True, help="Arm without asking.")
@click.option("--dry-run", is_flag=True, help="Everything but the board: no valve port is opened.")
@click.option(
    "--list-ports", is_flag=True, help="List the serial ports of this machine, Arduino MEGAs first, and leave."
)
@click.option("--check", metavar="FILE", help="Read a robot file, say what it means and what it lacks, and leave.")
@click.option(
    "--print-robot",
    metavar="NAME",
    help="Print a shipped robot's file to start your own from, and leave: cable-4, cable-6, pneumatic-2, pneumatic-3, "
    "pneumatic-3x3.",
)
@click.version_option(None, "-V", "--version", package_name="modsoft", prog_name="modsoft-runtime")
def cli(**options: Any) -> None:
    """Run one task on a modular soft robot: tracker in, valve pressures out, at a fixed rate.

    Takes robot.toml and model.onnx from this folder, tracker and task from the robot file. Asks before it arms.
    Ctrl-C, space, q or Esc vent the robot at any time.

    \b
    First steps:
      modsoft-runtime --print-robot pneumatic-3 > robot.toml    then edit: valves, channels, tracker
      modsoft-runtime --check robot.toml
      modsoft-runtime --list-ports
      modsoft-runtime --dry-run                                 everything but the valves
      modsoft-runtime --port /dev/ttyACM0                       the task of the robot file
      modsoft-runtime --port /dev/ttyACM0 --task edge --steps 50

    \b
    Exit codes:
      0 done, valves vented    2 usage            64 robot file      65 model or data
      69 device not there      70 internal error  73 cannot write    74 lost in the run
      75 port in use           76 board of another version or for other hardware
      79 stopped by a limit, a fault or a stop key
      130 Ctrl-C               143 SIGTERM        129 SIGHUP
    """
    if _without_run(options.pop("list_ports"), options.pop("check"), options.pop("print_robot")):
        return
    if not options["yes"] and not options["dry_run"] and not has_terminal():
        raise UsageError("arming asks for Enter, and there is no terminal to press it at; give --yes, or --dry-run")
    from modsoft.runtime.session import Options, run  # --help does without numpy and onnxruntime

    options["tracker"] = options["tracker"] or ""
    options["runs"] = options.pop("runs_dir")
    run(Options(**options))


main = entry(cli)

if __name__ == "__main__":
    main()
