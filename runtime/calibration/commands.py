"""The commands that measure tools: `modsoft-calibrate rest`, `noise` and `base`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np

from modsoft.runtime import robot as robot_file
from modsoft.runtime.calibration import base, file, rest
from modsoft.runtime.calibration.file import Calibration
from modsoft.runtime.calibration.measure import FEWEST_FRAMES, Collector
from modsoft.runtime.calibration.picture import draw
from modsoft.runtime.calibration.rest import Measured
from modsoft.runtime.calibration.use import hashes
from modsoft.runtime.devices import confirm
from modsoft.runtime.errors import ModelError, UsageError
from modsoft.runtime.files import check_not_input, check_writable
from modsoft.runtime.robot import Robot
from modsoft.runtime.safety import GOOD, FrameValidator
from modsoft.runtime.terminal import say
from modsoft.runtime.tracking.frame import LatestFrame, TrackerFrame
from modsoft.runtime.tracking.reader import Reader
from modsoft.runtime.tracking.replay import recorded
from modsoft.runtime.tracking.sources import open_source, port_of

BEND = "Ready to bend every module by hand, {where}, without twisting it? Press Enter to begin, Ctrl-C to leave. "
QUESTION = "Is the robot vented, and does it hang straight and still? Press Enter to measure, Ctrl-C to leave. "


@dataclass(frozen=True)
class Options:
    """The options of the command line; empty where the robot file decides."""

    robot: str
    tracker_port: str
    tools: tuple[Path, ...]
    calibration: Path | None
    picture: Path | None  # unused by base
    frames: int
    yes: bool
    run: Path | None = None  # base: whose frames are used


class Command:
    """The robot and its files, checked before the tracker is opened. `frames`: to measure; `before`: the calibration so
    far."""

    def __init__(self, options: Options):
        self.options = options
        self.robot: Robot = robot_file.load(options.robot)
        folder = robot_file.folder_of(options.robot)
        self.port = options.tracker_port or port_of(self.robot, folder)
        self.tools = list(options.tools) or [folder / tool for tool in self.robot.tracker.tools]
        self.path = options.calibration or file.path_for(options.robot)
        self.picture = options.picture or self.path.with_suffix(".png")
        self.device = ""
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

    @contextmanager
    def tracker(self, question: str) -> Iterator[LatestFrame]:
        """Asks the operator, and opens the tracker."""
        if not self.options.yes:
            confirm(question)
        frames = LatestFrame()
        source = open_source(self.robot, self.port, self.tools)
        self.device = source.device
        reader = Reader(source, frames)
        try:
            yield frames
        finally:
            reader.close()

    def measure(self) -> Measured:
        """The robot at rest."""
        with self.tracker(QUESTION) as frames:
            tools = Collector(self.robot, frames, self.options.frames).run()
        names = [path.name for path in self.tools] or [""] * len(self.hashes)
        return Measured(tools, self.device, names, self.hashes, file.now())

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


def calibrate_base(options: Options) -> None:
    """`modsoft-calibrate base`."""
    command = Command(options)
    command.read_before()
    before, planar = command.before, command.robot.motion == "planar"
    assert before is not None
    if options.run is not None:
        poses = np.array([frame.poses for frame in _valid_frames(options.run, command.robot)])
    else:
        with command.tracker(BEND.format(where="in its plane" if planar else "in every direction")) as frames:
            collector = Collector(
                command.robot, frames, options.frames, describe=lambda poses: str(base.frame_of(poses, before, planar))
            )
            poses = collector.collect()
    frame = base.frame_of(poses, before, planar)
    calibration = base.aligned(frame, before, planar, file.now())
    file.write(command.path, calibration)
    click.echo(f"{len(poses)} frames: {frame}")
    click.echo(f"wrote {command.path}")


def _valid_frames(run: Path, robot: Robot) -> list[TrackerFrame]:
    """The frames of a run in which every tool was measured. `ModelError` for too few."""
    validator = FrameValidator(robot)
    path = run / "run.jsonl" if run.is_dir() else run
    frames = [frame for frame in recorded(path, robot.modules + 1) if validator.measured(frame)[0] == GOOD]
    if len(frames) < FEWEST_FRAMES:
        raise ModelError(f"{path}: found {len(frames)} valid frames, expected at least {FEWEST_FRAMES}")
    return frames
