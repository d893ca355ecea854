"""The robot file (TOML), parsed strictly into frozen types.

Unknown or missing keys, wrong types and values out of range raise `RobotFileError` (exit code 64). The message is one
line: the place in the file, what was found and what was expected. Names contain units.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

import msgspec
from msgspec import Meta

from modsoft.runtime import layout, modules, physics
from modsoft.runtime.errors import RobotFileError
from modsoft.runtime.files import read_text
from modsoft.runtime.layout import MOTIONS, Actuators, Section
from modsoft.runtime.physics import Simulation
from modsoft.runtime.validation_messages import explain

LEAST_SENSOR_SPAN_V = 1.0  # as in firmware/limits.h


Name = Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$", max_length=64)]
Bar = Annotated[float, Meta(ge=0.0, le=10.0)]


class Identity(Section, frozen=True):
    """`[robot]`. motion: "planar" modules bend in the x-z plane, "spatial" ones in every direction."""

    name: Name
    motion: Literal["planar", "spatial"]
    modules: Annotated[int, Meta(ge=2, le=64)]  # one module has no label: eq. (1) divides by N - 1


class Valve(Section, frozen=True):
    """`[valve]`: the pressure regulators. Activation 0 is `p_min_bar`, activation 1 is `p_max_bar` (section 3.1)."""

    model: str
    full_scale_bar: Annotated[float, Meta(gt=0.0, le=10.0)]  # from the label of the valve: pressure at 10 V
    signal: Literal["0-10 V"]  # output of the board and its amplifiers
    p_min_bar: Bar = 0.08
    p_max_bar: Bar = 0.35


class Sensors(Section, frozen=True):
    """`[sensors]`: the pressure sensors, at the board's analogue inputs: `zero_v` without pressure, `full_v` at
    `full_scale_bar`, behind a divider where the sensor can exceed 5 V. A board without sensors ignores them."""

    full_scale_bar: Annotated[float, Meta(gt=0.0, le=10.0)]
    zero_v: Annotated[float, Meta(ge=0.0, le=5.0)] = 0.0
    full_v: Annotated[float, Meta(ge=0.0, le=5.0)] = 5.0


class Chamber(Section, frozen=True):
    """`[[chambers]]`: valve channel of a chamber, and the correction of its pressure. Further modules may have theirs.

    direction_deg: the entry of `directions_deg` that it is at; pressure sent = gain * pressure + offset_bar.
    """

    module: Annotated[int, Meta(ge=1, le=64)]
    direction_deg: float
    channel: Annotated[int, Meta(ge=0, le=11)]
    gain: Annotated[float, Meta(gt=0.0, le=2.0)] = 1.0
    offset_bar: Annotated[float, Meta(ge=-0.1, le=0.1)] = 0.0


class Limits(Section, frozen=True):
    """`[limits]`: limits of the control loop, which frames are invalid, and how many of them in a row end a run.

    `largest_actuation_step` also bounds the plausible motion between two frames. `largest_rms_mm` is the largest
    quality value of a tool (NDI: RMS error, mm). A tool is invalid with any bit of `refused_port_status` set (NDI: 0x40
    out of volume, 0x80 partially, the others errors of sensor or processing).
    """

    largest_actuation_step: Annotated[float, Meta(gt=0.0, le=2.0)] = 0.4
    slew_bar_per_s: Annotated[float, Meta(gt=0.0, le=50.0)] = 2.0
    tracker_age_s: Annotated[float, Meta(gt=0.0, le=10.0)] = 0.4
    invalid_frames: Annotated[int, Meta(ge=1, le=100)] = 3
    largest_rms_mm: Annotated[float, Meta(gt=0.0, le=10.0)] = 1.0
    refused_port_status: Annotated[int, Meta(ge=0, le=0xFFFF)] = 0xD3C0


class Tracker(Section, frozen=True):
    """`[tracker]`: source and its port (replay: a run's folder); `tools` are the tool definition files, base first,
    then module 1 to N, then those of further modules. Paths are relative to the folder of the robot file.
    `frame_hz`: frame rate of the device; it is learned from the frame numbers where it is not set."""

    source: Literal["ndi", "replay"] = "ndi"
    type: Literal["polaris", "vega", "aurora"] = "polaris"
    port: str = ""
    tools: tuple[str, ...] = ()
    frame_hz: Annotated[float, Meta(ge=1.0, le=1000.0)] | None = None


class Serial(Section, frozen=True):
    """`[serial]`: the board's port (empty: set on the command line)."""

    port: str = ""
    baud: Literal[115200, 250000, 500000, 1000000] = 250000


class Loop(Section, frozen=True):
    """`[loop]`: control rate, and the default task: a name, or the path of a file, relative to the folder of the robot
    file."""

    hz: Annotated[float, Meta(gt=0.0, le=100.0)] = 2.5
    task: str = ""

    @property
    def period_s(self) -> float:
        """Control period, seconds."""
        return 1.0 / self.hz


class Robot(Section, frozen=True):
    """A robot file. `motion` determines state and action sizes; a robot with cables is simulated, without valves."""

    robot: Identity
    actuators: Actuators
    loop: Loop
    simulation: Simulation | None = None
    valve: Valve | None = None
    sensors: Sensors = Sensors(full_scale_bar=1.0)
    chambers: tuple[Chamber, ...] = ()
    limits: Limits = Limits()
    tracker: Tracker = Tracker()
    serial: Serial = Serial()

    @property
    def name(self) -> str:
        return self.robot.name

    @property
    def modules(self) -> int:
        """Number of modules N."""
        return self.robot.modules

    @property
    def motion(self) -> str:
        """Key of `MOTIONS`: "planar" or "spatial"."""
        return self.robot.motion

    @property
    def physics(self) -> Simulation:
        """All parameters of the simulated robot. `RobotFileError` for a robot that cannot be simulated."""
        if self.simulation is None:
            raise RobotFileError(f"robot {self.name} has no [simulation], expected one: it is simulated here")
        return physics.resolved(self.simulation)

    @property
    def state_size(self) -> int:
        return len(MOTIONS[self.motion].state)

    @property
    def action_size(self) -> int:
        return len(MOTIONS[self.motion].action)

    @property
    def directions(self) -> tuple[tuple[float, ...], ...]:
        """Unit direction (A components) in which each actuator bends its module."""
        return layout.bending_directions(self.motion, self.actuators.drive, self.actuators.directions_deg)

    def actuator_of(self, chamber: Chamber) -> int:
        """Index of a chamber among the actuators of its module."""
        return self.actuators.directions_deg.index(chamber.direction_deg)

    def to_dict(self) -> dict[str, Any]:
        """Plain Python values, for a checkpoint, ONNX metadata or a log."""
        return msgspec.to_builtins(self)


Count = Callable[[Robot], int]  # the number of modules of a robot file


def names() -> list[str]:
    """Names of the shipped robots."""
    folder = resources.files("modsoft.runtime") / "robots"
    return sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml"))


def text_of(name: str) -> str:
    """Text of the robot file of a shipped robot, with its comments. cable-N exists for every number N of modules.
    `RobotFileError` for another name."""
    if name in names():
        return (resources.files("modsoft.runtime") / "robots" / f"{name}.toml").read_text(encoding="utf-8")
    if cable := re.fullmatch(r"cable-([1-9][0-9]?)", name):
        text = text_of("cable-4").replace('"cable-4"', f'"{name}"').replace("modules = 4", f"modules = {cable[1]}")
        return text.replace("4 modules", f"{cable[1]} modules")
    raise RobotFileError(f"no shipped robot {name!r}; expected one of {', '.join(names())}, or cable-N")


def load(file_or_name: str | Path, count: Count | None = None) -> Robot:
    """Reads a robot file, or a shipped robot by its name; a file takes precedence. count: of the modules, instead of
    `modules` in the file."""
    path = Path(file_or_name)
    if path.is_dir():
        raise RobotFileError(f"{path} is a folder, expected a robot file; give the file, such as {path / 'robot.toml'}")
    if path.is_file():
        return parse(read_text(path, RobotFileError), str(path), count)
    return shipped(str(file_or_name), count)


def folder_of(file_or_name: str | Path) -> Path:
    """Base of the relative paths in a robot file: its folder, or the current one for a shipped robot."""
    path = Path(file_or_name)
    return path.parent if path.is_file() else Path()


def shipped(name: str, count: Count | None = None) -> Robot:
    """A shipped robot by its name, regardless of files."""
    try:
        text = text_of(name)
    except RobotFileError:
        raise RobotFileError(
            f"no robot file {name!r} here, and no shipped robot of that name; give a file or one of "
            f"{', '.join(names())}, cable-N (modsoft-runtime --print-robot pneumatic-3 > robot.toml makes one to start "
            "from)"
        ) from None
    return parse(text, name, count)


def parse(text: str, where: str = "robot file", count: Count | None = None) -> Robot:
    """Parses the text of a robot file; where: name of the file, for errors; count: see `load`."""
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise RobotFileError(f"{where}: not valid TOML: {error}") from error
    return from_dict(table, where, count)


def from_dict(table: dict[str, Any], where: str = "robot", count: Count | None = None) -> Robot:
    """Converts plain values (of a checkpoint, ONNX metadata, TOML) to `Robot`, with the same checks as the file.
    Entries of modules that the robot does not have are checked and dropped."""
    table = layout.with_preset(table, where)
    robot = _converted(table, where)
    if count is not None:
        robot = _converted({**table, "robot": {**table["robot"], "modules": count(robot)}}, where)
    _check(robot, where)
    return modules.first_entries(robot)


def _converted(table: dict[str, Any], where: str) -> Robot:
    try:
        return msgspec.convert(table, Robot)
    except msgspec.ValidationError as error:
        raise RobotFileError(f"{where}: {explain(table, Robot, error)}") from error


def _check(robot: Robot, where: str) -> None:
    """Checks the relations between keys."""

    def refuse(found: str, expected: str) -> NoReturn:
        raise RobotFileError(f"{where}: {found}; expected {expected}")

    modules.check_tools(robot, refuse)
    layout.check_actuators(robot.motion, robot.actuators, refuse)
    complete = None if robot.simulation is None else physics.resolved(robot.simulation, where)
    if robot.actuators.drive == "cables":
        if complete is not None and complete.cable_stress_pa is None:
            refuse("[simulation] of a cable robot without cable_stress_pa", "one, or the preset cable")
        if robot.valve is not None or robot.chambers:
            refuse("a cable robot with [valve] or [[chambers]]", "neither: cable robots are simulated")
        return

    valve = robot.valve
    if valve is None:
        refuse("a robot with chambers without [valve]", "one, with full_scale_bar from the valve's label")
    if not valve.p_min_bar < valve.p_max_bar <= valve.full_scale_bar:
        refuse(
            f"valve pressures p_min_bar {valve.p_min_bar}, p_max_bar {valve.p_max_bar}, "
            f"full_scale_bar {valve.full_scale_bar}",
            "p_min_bar < p_max_bar <= full_scale_bar",
        )
    if robot.sensors.full_v - robot.sensors.zero_v < LEAST_SENSOR_SPAN_V:
        refuse(
            f"[sensors] zero_v {robot.sensors.zero_v}, full_v {robot.sensors.full_v}",
            f"full_v at least {LEAST_SENSOR_SPAN_V} V above zero_v",
        )
    modules.check_chambers(robot, refuse)
