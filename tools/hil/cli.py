"""`modsoft-hil`: the unmodified runtime against the emulated board, the fake tracker and the simulated robot."""

from __future__ import annotations

import hashlib
import shutil
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from modsoft.hil.tool_errors import ToolErrors
from modsoft.runtime.control.model import Model
from modsoft.runtime.control.tasks import load_task
from modsoft.runtime.entry_point import entry
from modsoft.runtime.errors import DeviceAbsent, UsageError
from modsoft.runtime.locks import system_module
from modsoft.runtime.robot import Robot

if TYPE_CHECKING:
    from modsoft.hil.board.serial_board import SerialBoard
    from modsoft.hil.criteria import Assessment
    from modsoft.hil.record import Record
    from modsoft.hil.rig import Rig

EMULATED = ("auto", "simavr", "native")
RUN_MARGIN_S = 60.0  # for start, arming, venting and closing of the runtime, beyond its ticks
SETTLE_S = 1.5  # the traces continue for so long after the runtime, until the chambers are empty


@click.command("modsoft-hil", context_settings={"show_default": True})
@click.option("--robot", "robot_file", required=True, help="Robot file, or a shipped robot's name (pneumatic-3, ...).")
@click.option("--model", required=True, type=click.Path(path_type=Path), help="Controller of modsoft-export.")
@click.option("--task", required=True, help="Task's name (edge, down), or a .npy file of desired configurations.")
@click.option(
    "--report",
    required=True,
    type=click.Path(path_type=Path, file_okay=False),
    help="Folder to write: new or empty; a folder with a report is refused.",
)
@click.option(
    "--board",
    default="auto",
    metavar="auto|simavr|native|PORT",
    help="simavr: the compiled firmware on an emulated ATmega2560. native: its logic compiled for this "
    "machine. auto: simavr where it is installed. PORT: a real MEGA at a serial port, such as /dev/ttyACM0, or with "
    "this USB serial number.",
)
@click.option("--yes", is_flag=True, help="With a real board: start without asking.")
@click.option(
    "--pull-downs/--no-pull-downs",
    default=True,
    help="With or without resistors of 10 kOhm from the valve pins to ground, see docs/hardware.md.",
)
@click.option("--steps", type=click.IntRange(1), help="Run only so many control steps.  [default: the whole task]")
@click.option(
    "--mounting-error",
    default=(0.0, 0.0),
    type=(click.FloatRange(0.0, 15.0), click.FloatRange(0.0, 10.0)),
    metavar="DEG MM",
    help="Mount the tool of each module with a random error of at most this; modsoft-calibrate rest runs first.",
)
@click.option(
    "--noise-deg", default=0.0, type=click.FloatRange(0.0, 5.0), help="Noise of the tracker, for each axis of a tool."
)
@click.option(
    "--noise-mm", default=0.0, type=click.FloatRange(0.0, 5.0), help="The same, for each axis of its position."
)
@click.option("--seed", default=0, help="Of mounting errors and noise.")
def cli(
    robot_file: str,
    model: Path,
    task: str,
    report: Path,
    board: str,
    yes: bool,
    pull_downs: bool,
    steps: int | None,
    **tracker: Any,
) -> int:
    """Run a controller in real time on emulated hardware and check the run against its criteria.

    \b
    Examples:
      modsoft-hil --robot pneumatic-3 --model model.onnx --task down --report out
      modsoft-hil --robot pneumatic-3 --model model.onnx --task down --report out --board /dev/ttyACM0

    With a real board the air must be off, or the robot disconnected: its valve outputs follow the task. The simulated
    robot follows the pressures that the board reports as applied. The board must be flashed with SENSORS=0. The report
    states what such a run cannot see: timer registers, resets, the watchdog, voltages at the pins.

    \b
    Exit code:
      0    passed: every criterion that the run could see is met
      1    failed: one is not met
      3    inconclusive: the host was too slow, or the run shorter than 100 control steps
    Others are those of modsoft-runtime (64 robot file, 65 model, 69 something is missing, 75 port in use, 76 board of
    another version or for other hardware, ...).

    The folder gets report.md, report.json, angles.png, run.jsonl (the runtime's log), board.jsonl (timer registers of
    the emulated board, or messages of the real one), plant.jsonl (the simulated robot), and with --mounting-error
    calibration.toml and its picture. Run nothing else on the machine meanwhile. An interrupted run leaves its traces
    there and no report; the next run into this folder replaces them.
    """
    check_system()
    from tqdm import tqdm

    from modsoft.hil import (
        criteria,  # imported here: --help must not wait for their libraries
        record,
        report_folder,
    )
    from modsoft.hil import report as reports
    from modsoft.hil.plant import load_robot
    from modsoft.hil.rig import Rig

    report_folder.check(report)
    robot = load_robot(robot_file)
    desired = load_task(task, robot)
    Model.load(model).check(robot)  # the runtime does it too; here it fails before the rig starts
    desired = desired[:steps]
    count = len(desired)
    rig_board = _prepared_board(board, robot, yes)

    options = [] if steps is None else ["--steps", str(steps)]
    with report_folder.claimed(report):
        rig = Rig(robot_file, report, rig_board, pull_downs=pull_downs, errors=_tool_errors(**tracker))
        try:
            with rig:
                if rig.errors.mounting_deg or rig.errors.mounting_mm:
                    rig.calibrate()
                rig.run(model, task, *options)
                with tqdm(total=count, unit=" ticks", desc="run", disable=not sys.stderr.isatty()) as bar:
                    rig.wait(count * robot.loop.period_s + RUN_MARGIN_S, lambda ticks: bar.update(ticks - bar.n))
                rig.settle(SETTLE_S)
        finally:
            has_log = _move_log(rig, report)
    log = report if has_log else None
    run = record.read(report, log, robot, task, desired, rig.runtime.returncode, rig.errors.noise_deg)
    assessment = criteria.assess(run)
    about = _about(rig, robot_file, model, task, steps, count)
    if no_picture := reports.write(run, assessment, about, report):
        click.echo(f"modsoft-hil: {no_picture}", err=True)
    return _show(run, assessment, report / "report.md")


def _show(run: Record, assessment: Assessment, page: Path) -> int:
    """Prints the outcome of a run; returns the exit code of modsoft-hil."""
    if run.runtime_exit and not len(run.tick):  # there are no figures
        message = run.runtime_message or "modsoft-runtime gave no message"
        click.echo(f"no control step: {message}\n{page}", err=True)
        return run.runtime_exit
    for line in [*assessment.criteria, *assessment.host_load_checks]:
        met = "--" if line.met is None else "ok" if line.met else "NO"
        click.echo(f"{met:>4}  {line.name}: {line.measured} ({line.limit})")
    if run.runtime_exit:
        click.echo(f"last line of modsoft-runtime: {run.runtime_message or 'none'}")
    click.echo(f"{assessment}\n{page}")
    return assessment.exit_code


def _tool_errors(mounting_error: tuple[float, float], noise_deg: float, noise_mm: float, seed: int) -> ToolErrors:
    return ToolErrors(*mounting_error, noise_deg, noise_mm, seed)


def _prepared_board(board: str, robot: Robot, yes: bool) -> str | SerialBoard:
    """The board for the rig: an emulated one is built; a real one is checked, after a confirmation."""
    from modsoft.hil.board.serial_board import SerialBoard
    from modsoft.hil.board.toolchain import build, choose

    if board in EMULATED:
        build(choose(board))
        return board
    real = SerialBoard(board, robot)
    click.echo(f"{board}: its valve outputs will follow the task: turn off the air, or disconnect the robot", err=True)
    if not yes:
        if not sys.stdin.isatty():
            raise UsageError(f"--board {board} needs a confirmation, and standard input is no terminal; give --yes")
        click.confirm("Is the air off, or the robot disconnected?", abort=True, err=True)
    real.check()
    return real


def _about(rig: Rig, robot_file: str, model: Path, task: str, steps: int | None, count: int) -> dict[str, str]:
    """What ran, for the report. steps: of the option; count: control steps of the run."""
    from modsoft.hil import record
    from modsoft.hil.board.serial_board import SerialBoard

    robot, board, errors = rig.robot, rig.board, rig.errors
    has_noise = errors.noise_deg or errors.noise_mm
    if isinstance(board, SerialBoard):
        hello, firmware = board.hello, "not seen"
        description = (
            f"real board at {board.board}, firmware version {hello.firmware_version}, {hello.channels} channels"
        )
    else:
        description, firmware = record.board_description(board.board), record.firmware_sha256(board.board)
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": f"modsoft-hil --robot {Path(robot_file).name} --model {model.name} --task {Path(task).name} "
        f"--board {board.board}"
        + (" --no-pull-downs" if not rig.pull_downs else "")
        + (f" --steps {steps}" if steps else "")
        + (f" --mounting-error {errors.mounting_deg:g} {errors.mounting_mm:g}" if rig.calibration else "")
        + (f" --noise-deg {errors.noise_deg:g} --noise-mm {errors.noise_mm:g}" if has_noise else "")
        + (f" --seed {errors.seed}" if errors.seed else ""),
        "board": description,
        "board's clock": board.clock,
        "firmware, SHA-256": firmware,
        "model, SHA-256": hashlib.sha256(model.read_bytes()).hexdigest(),
        "robot": f"{robot.name}, {robot.modules} modules, {robot.loop.hz:g} Hz",
        "task": f"{task}, {count} control steps",
        "tracker": f"mounting errors of at most {errors.mounting_deg:g}° and {errors.mounting_mm:g} mm, "
        f"{'' if rig.calibration else 'not '}calibrated; noise of {errors.noise_deg:g}° and {errors.noise_mm:g} mm",
    }


def check_system() -> None:
    """`DeviceAbsent` on other systems than Linux: the serial ports are pseudo-terminals, and the board is built with
    Linux's headers."""
    if not sys.platform.startswith("linux") or not all(map(system_module, ("fcntl", "pty", "tty"))):
        raise DeviceAbsent(
            "the rig needs Linux (pseudo-terminals, simavr); use Linux, WSL or a virtual machine, "
            "or modsoft-runtime --dry-run on this system"
        )


def _move_log(rig: Rig, report: Path) -> bool:
    """Moves the runtime's log beside the other traces and deletes its folder; returns whether a log existed."""
    from modsoft.hil.report_folder import RUN_FILES

    run = rig.run_folder()
    if run is not None:
        for name in RUN_FILES:
            shutil.move(run / name, report / name)
    if rig.runs is not None:
        shutil.rmtree(rig.runs, ignore_errors=True)
    return run is not None


main = entry(cli)

if __name__ == "__main__":
    main()
