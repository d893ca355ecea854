"""The commands that measure tools at rest: `modsoft-calibrate rest` and `noise`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import click

from modsoft.runtime import robot as robot_file
from modsoft.runtime.calibration import file, rest
from modsoft.runtime.calibration.file import Calibration
from modsoft.runtime.calibration.measure import Collector
from modsoft.runtime.calibration.picture import draw
from modsoft.runtime.calibration.rest import Measured
from modsoft.runtime.calibration.use import hashes
from modsoft.runtime.devices import confirm
from modsoft.runtime.errors import ModelError, UsageError
from modsoft.runtime.files import check_not_input, check_writable
from modsoft.runtime.robot import Robot
from modsoft.runtime.terminal import say
from modsoft.runtime.tracking.frame import LatestFrame
from modsoft.runtime.tracking.reader import Reader
from modsoft.runtime.tracking.sources import open_source, port_of

QUESTION = "Is the robot vented, and does it hang straight and still? Press Enter to measure, Ctrl-C to leave. "


@dataclass(frozen=True)
class Options:
    """The options of the command line; empty where the robot file decides."""

    robot: str
    tracker_port: str
    tools: tuple[Path, ...]
    calibration: Path | None
    picture: Path | None
    frames: int
    yes: bool


class Command:
    """The robot and its files, checked before the tracker is opened."""

    def __init__(self, options: Options):
        self.options = options
        self.robot: Robot = robot_file.load(options.robot)
        folder = robot_file.folder_of(options.robot)
        self.port = options.tracker_port or port_of(self.robot, folder)
        self.tools = list(options.tools) or [folder / tool for tool in self.robot.tracker.tools]
        self.path = options.calibration or file.path_for(options.robot)
        self.picture = options.picture or self.path.with_suffix(".png")
        for output in (self.path, self.picture):
            check_not_input(output, Path(options.robot), *self.tools)
            check_writable(output)
        if self.picture == self.path:
            raise UsageError(f"{self.path}: found one name for calibration and picture, expected two; give --picture")
        self.hashes = hashes(self.robot, self.tools)
        self.before: Calibration | None = None

    def read_before(self, without: Iterable[int] = ()) -> None:
        """Reads the calibration so far, which must fit the robot but for the modules `without`."""
        self.before = file.read(self.path)
        file.check(self.before, self.robot, self.hashes, self.path, list(without))

    def measure(self) -> Measured:
        """Asks for a robot at rest, and measures it."""
        if not self.options.yes:
            confirm(QUESTION)
        frames = LatestFrame()
        source = open_source(self.robot, self.port, self.tools)
        reader = Reader(source, frames)
        try:
            tools = Collector(self.robot, frames, self.options.frames).run()
        finally:
            reader.close()
        names = [path.name for path in self.tools] or [""] * len(self.hashes)
        return Measured(tools, source.device, names, self.hashes, file.now())

    def write(self, measured: Measured, calibration: Calibration) -> None:
        """Writes the file, then the picture."""
        file.write(self.path, calibration)
        for line in rest.report(measured, calibration):
            click.echo(line)
        click.echo(f"wrote {self.path}")
        if no_picture := draw(measured, calibration, self.picture):
            say(f"modsoft-calibrate: {no_picture}")
        else:
            click.echo(f"wrote {self.picture}")


def calibrate_rest(options: Options, only: tuple[int, ...]) -> None:
    """`modsoft-calibrate rest`."""
    command = Command(options)
    if only and max(only) > command.robot.modules:
        raise UsageError(f"found --module {max(only)}, expected 1 to {command.robot.modules}: the modules of the robot")
    if only:
        command.read_before(only)
    elif command.path.is_file():
        try:
            command.before = file.read(command.path)
        except ModelError as error:
            say(f"replaced: {error}")
    measured = command.measure()
    command.write(measured, rest.calibrated(measured, command.robot.name, command.before, only))


def measure_noise(options: Options) -> None:
    """`modsoft-calibrate noise`."""
    command = Command(options)
    if command.path.is_file():
        command.read_before()
    measured = command.measure()
    if command.before is not None:
        command.write(measured, rest.with_noise(measured, command.before))
        return
    for line in rest.report(measured):
        click.echo(line)
    click.echo(f"not stored: no calibration {command.path}; run modsoft-calibrate rest")
