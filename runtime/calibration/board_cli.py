"""The subcommands of `modsoft-calibrate` that open valves."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from modsoft.runtime.errors import UsageError
from modsoft.runtime.terminal import has_terminal

_OPTIONS = (
    click.option(
        "--port", default="", metavar="PORT", help="Serial port of the board.  [default: port under [serial]]"
    ),
    click.option(
        "--robot", default="robot.toml", show_default=True, metavar="FILE", help="Robot file; the result goes there."
    ),
    click.option(
        "--tracker-port", default="", metavar="PORT", help="Port of the tracker.  [default: port under [tracker]]"
    ),
    click.option(
        "--tool",
        "tools",
        multiple=True,
        metavar="FILE",
        type=click.Path(path_type=Path),
        help="Tool definition file, once for each tool: base, then module 1 to N.  [default: tools under [tracker]]",
    ),
    click.option(
        "--calibration",
        metavar="FILE",
        type=click.Path(path_type=Path),
        help="Calibration of the tools.  [default: NAME.calibration.toml beside the robot file, where there is one]",
    ),
    click.option(
        "--runs-dir",
        "runs",
        default="runs",
        show_default=True,
        metavar="FOLDER",
        type=click.Path(path_type=Path),
        help="Where the log of the run is kept.",
    ),
    click.option("--yes", is_flag=True, help="Arm, and write the robot file, without asking."),
)


def _device_options(command: Callable[..., None]) -> Callable[..., None]:
    for option in reversed(_OPTIONS):
        command = option(command)
    return command


def _options(values: dict[str, Any]) -> Any:
    """The options of a run; `UsageError` where no operator can confirm."""
    if not values["yes"] and not has_terminal():
        raise UsageError("arming asks for Enter, and there is no terminal to press it at; give --yes")
    from modsoft.runtime.calibration.procedure import Options  # --help does without numpy

    return Options(tracker="", dry_run=False, **values)


@click.command("channels")
@_device_options
@click.option(
    "--pressure",
    "pressure_bar",
    type=float,
    metavar="BAR",
    help="Largest pressure of a pulse.  [default: 0.4 of the way from p_min_bar to p_max_bar]",
)
@click.option(
    "--channels",
    default="",
    metavar="LIST|all",
    help="Channels to test, such as 0-5,8; all: every channel of the board.  [default: those of the robot file]",
)
def channels(**values: Any) -> None:
    """Find which hose is at which chamber, and write [[chambers]] into the robot file.

    One valve after the other gives a pulse of a low pressure; the tracker shows which module bends, and in which
    direction. Space, q, Esc or Ctrl-C vent the robot at any time.

    Faults of valves, hoses, sensors and tools are named. The file before is kept as robot.toml.backup; its comments
    stay. Gain and offset belong to the valve and stay with its channel.
    """
    options = _options(values)
    from modsoft.runtime.calibration.procedure import run_channels

    run_channels(options)


@click.command("valves")
@_device_options
def valves(**values: Any) -> None:
    """Measure gain and offset of every valve that has a pressure sensor, and write them into the robot file.

    Every chamber gets five pressures from p_min_bar to p_max_bar, one chamber after the other, while the others are at
    p_min_bar. Run `modsoft-calibrate channels` first. Space, q, Esc or Ctrl-C vent the robot at any time.
    """
    options = _options(values)
    from modsoft.runtime.calibration.procedure import run_valves

    run_valves(options)
