"""`modsoft-calibrate`: how the sensors and actuators of a robot are mounted."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from modsoft.runtime.calibration import board_cli
from modsoft.runtime.entry_point import entry

Option = Callable[[Any], Any]

_FILE = click.Path(path_type=Path)
_OPTIONS = (
    click.option(
        "--robot", default="robot.toml", show_default=True, metavar="FILE|NAME", help="Robot file, or a shipped robot."
    ),
    click.option(
        "--tracker-port",
        default="",
        metavar="PORT",
        help="Serial port of the tracker (vega: its address). [default: port under [tracker] in the robot file]",
    ),
    click.option(
        "--tool",
        "tools",
        multiple=True,
        metavar="FILE",
        type=_FILE,
        help="Tool definition file, once for each tool: base, then module 1 to N. [default: tools under [tracker] in "
        "the robot file]",
    ),
    click.option(
        "--calibration",
        metavar="FILE",
        type=_FILE,
        help="Calibration file to write. [default: NAME.calibration.toml beside NAME.toml, the robot file]",
    ),
    click.option("--yes", is_flag=True, help="Measure without asking."),
)


_PICTURE = click.option(
    "--picture",
    metavar="FILE",
    type=_FILE,
    help="Picture of the result to write, with matplotlib. [default: the calibration file, ending in .png]",
)


def _tool_options(frames: int, *more: Option) -> Option:
    """The options of commands that measure the tools in `frames` frames by default, and `more`."""
    count = click.option(
        "--frames", default=frames, show_default=True, metavar="N", type=click.IntRange(20), help="Frames to measure."
    )

    def decorated(function: Any) -> Any:
        for option in reversed((*_OPTIONS, count, *more)):
            function = option(function)
        return function

    return decorated


@click.group("modsoft-calibrate", context_settings={"max_content_width": 100, "help_option_names": ["-h", "--help"]})
@click.version_option(None, "-V", "--version", package_name="modsoft", prog_name="modsoft-calibrate")
def cli() -> None:
    """Measure a robot before its first run.

    Results about the tools are beside the robot file, in robot.calibration.toml, those about hoses and valves in the
    robot file; modsoft-runtime uses both. The file before is kept with the ending .backup.
    """


@cli.command()
@_tool_options(100, _PICTURE)
@click.option(
    "--module",
    "only",
    multiple=True,
    type=click.IntRange(1),
    metavar="K",
    help="Calibrate only this module, which was added or whose tool was moved; may be repeated. [default: all]",
)
def rest(only: tuple[int, ...], **options: Any) -> None:
    """Measure how the tools are mounted: vented robot, hanging straight.

    In a straight robot the ends of all modules have the rotation of the base, and are at equal distances on a line
    along its z axis. What the tracker sees instead is how the tools are mounted; modsoft-runtime corrects every frame
    for it. The axes of the base's tool are those of the robot: z from base to tip, x in the plane of a planar robot.
    """
    from modsoft.runtime.calibration.commands import Options, calibrate_rest  # --help does without numpy

    calibrate_rest(Options(**options), only)


@cli.command()
@_tool_options(100, _PICTURE)
def noise(**options: Any) -> None:
    """Measure the noise of the tools at rest, and what it costs."""
    from modsoft.runtime.calibration.commands import Options, measure_noise

    measure_noise(Options(**options))


@cli.command()
@_tool_options(600)
@click.option(
    "--run",
    metavar="FOLDER",
    type=_FILE,
    help="Use the frames of this recorded run, in which the modules bent. [default: those of the tracker now]",
)
def base(run: Path | None, **options: Any) -> None:
    """Measure how the base's tool is mounted, while the modules bend.

    After rest, the axes of the base's tool are those of the robot. Modules that bend without twist show the plane of a
    planar robot, or the z axis of a spatial one. Bend every module by hand in every direction of its motion, or give a
    run. modsoft-runtime then corrects every frame for it; a network needs data of the same frame.
    """
    from modsoft.runtime.calibration.commands import Options, calibrate_base

    calibrate_base(Options(**options, picture=None, run=run))


cli.add_command(board_cli.channels)
cli.add_command(board_cli.valves)
main = entry(cli)

if __name__ == "__main__":
    main()
