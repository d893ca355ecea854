"""The calibration file (TOML), beside the robot file: how each tool of the tracker is mounted, and its noise.

One entry a module, so that a robot with fewer modules uses the first entries, and only an added or moved module is
calibrated again. Read as strictly as the robot file: an unknown key or a value out of range is a `ModelError`.
"""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections.abc import Collection, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from modsoft.runtime.errors import ModelError
from modsoft.runtime.files import check_is_file, read_text, written
from modsoft.runtime.layout import Section
from modsoft.runtime.robot import Name, Robot
from modsoft.runtime.validation_messages import explain

SCHEMA = 1
COMMENT = """\
# Mounting and noise of the tracker's tools, written by modsoft-calibrate and read by modsoft-runtime.
# rotation_deg is an axis times an angle. noise is the standard deviation of one axis, residual the largest deviation
# of a fifth of the frames from the mean of all.

"""

FIRST = ("module", "rotation_deg", "position_mm")  # keys of an entry, in the file

Date = Annotated[str, Meta(pattern=r"^\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ$")]  # UTC
Degrees = Annotated[float, Meta(ge=-360.0, le=360.0)]
Millimetres = Annotated[float, Meta(ge=-1e4, le=1e4)]
Deviation = Annotated[float, Meta(ge=0.0, le=1e3)]
Rotation = tuple[Degrees, Degrees, Degrees]  # rotation vector
Position = tuple[Millimetres, Millimetres, Millimetres]
Sha256 = Annotated[str, Meta(pattern=r"^([0-9a-f]{64})?$")]  # empty for a wired tool, which has no file


class Tool(Section, frozen=True):
    """A tool as it was measured. `device`: the tracker, as its client reports it; `tool`: name of the definition file;
    `residual` and `noise` are explained in the file."""

    date: Date
    device: Annotated[str, Meta(max_length=200)]
    tool: Annotated[str, Meta(max_length=200)]
    tool_sha256: Sha256
    frames: Annotated[int, Meta(ge=1)]
    residual_deg: Deviation
    residual_mm: Deviation
    noise_deg: Deviation
    noise_mm: Deviation


class Base(Tool, frozen=True):
    """`[base]`: the base's tool. `rotation_deg`: of the tool in the robot's frame; 0 where its axes are the robot's.
    `rotation_date`: when bends showed it; empty if none did. `rotation_residual_deg`: `off_deg` of `base.Frame`."""

    rotation_deg: Rotation = (0.0, 0.0, 0.0)
    rotation_date: Annotated[str, Meta(pattern=r"^(\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ)?$")] = ""
    rotation_residual_deg: Deviation = 0.0


class Module(Tool, frozen=True):
    """`[[modules]]`: the tool of a module's end in the frame of the base's tool, while the robot hangs straight."""

    module: Annotated[int, Meta(ge=1)]
    rotation_deg: Rotation
    position_mm: Position


class Calibration(Section, frozen=True):
    """A calibration file. `modules`: entry i is that of module i + 1."""

    schema: Literal[1]
    robot: Name
    base: Base
    modules: tuple[Module, ...] = ()

    @property
    def date(self) -> str:
        """Date of the newest entry."""
        return max(entry.date for entry in (self.base, *self.modules))


def path_for(robot_file: str | Path) -> Path:
    """The calibration file of a robot file, beside it; of a shipped robot, in the current folder."""
    path = Path(robot_file)
    return path.with_name(f"{path.stem}.calibration.toml") if path.is_file() else Path(f"{path}.calibration.toml")


def read(path: Path) -> Calibration:
    """Reads a calibration file. Raises `ModelError`."""
    check_is_file(path, "calibration", "run modsoft-calibrate rest")
    return parse(read_text(path), str(path))


def parse(text: str, where: str) -> Calibration:
    """Parses the text of a calibration file; where: its name, for errors."""
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ModelError(f"{where}: not valid TOML: {error}; run modsoft-calibrate rest again") from error
    schema = table.get("schema")
    if isinstance(schema, int) and schema > SCHEMA:
        raise ModelError(
            f"{where}: found a calibration of schema {schema}, expected {SCHEMA}; run modsoft-calibrate rest again"
        )
    try:
        calibration = msgspec.convert(table, Calibration)
    except msgspec.ValidationError as error:
        raise ModelError(f"{where}: {explain(table, Calibration, error)}") from error
    numbers = [entry.module for entry in calibration.modules]
    if numbers != list(range(1, len(numbers) + 1)):
        raise ModelError(
            f"{where}: found [[modules]] of module {', '.join(map(str, numbers))}, expected 1, 2, ... in this order; "
            "run modsoft-calibrate rest again"
        )
    return calibration


def write(path: Path, calibration: Calibration) -> None:
    """Writes a calibration file atomically, and keeps the previous one as `<name>.backup`. Raises `OutputError`."""
    data = text_of(calibration).encode()
    if path.is_file():
        with written(path.with_name(f"{path.name}.backup")) as backup:
            backup.write_bytes(path.read_bytes())
    with written(path) as new:
        new.write_bytes(data)


def text_of(calibration: Calibration) -> str:
    """The text of a calibration file."""
    lines = []
    for key, value in msgspec.to_builtins(calibration).items():
        if isinstance(value, dict):
            lines += ["", f"[{key}]", *_pairs(value)]
        elif isinstance(value, (list, tuple)):
            for entry in value:
                lines += ["", f"[[{key}]]", *_pairs(entry)]
        else:
            lines += _pairs({key: value})
    return COMMENT + "\n".join(lines) + "\n"


def _pairs(table: dict[str, Any]) -> list[str]:
    """Lines of TOML for text and numbers, which it writes as JSON does; the mounting first."""
    keys = sorted(table, key=lambda key: key not in FIRST)
    return [f"{key} = {json.dumps(table[key], ensure_ascii=False)}" for key in keys]


def now() -> str:
    """The present date, for an entry."""
    return f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}"


def sha256_of(tool_files: Sequence[Path]) -> list[str]:
    """SHA-256 of tool definition files. Raises `ModelError`."""
    try:
        return [hashlib.sha256(path.read_bytes()).hexdigest() for path in tool_files]
    except OSError as error:
        raise ModelError(f"{error.filename}: cannot be read ({error.strerror or error})") from error


def check(
    calibration: Calibration,
    robot: Robot,
    tools: Sequence[str] | None,
    where: str | Path,
    without: Collection[int] = (),
) -> None:
    """Raises `ModelError` for the calibration of another robot, of too few modules, or of other tools.

    tools: SHA-256 of the tool definition files, base first; None where they are not known (a recorded run). `where`:
    name of the calibration file. without: modules whose entries are not used.
    """
    if calibration.robot != robot.name:
        raise ModelError(
            f"{where}: found the calibration of robot {calibration.robot!r}, expected that of {robot.name!r}; run "
            "modsoft-calibrate rest, or give another --calibration FILE"
        )
    count = len(calibration.modules)
    if any(number not in without for number in range(count + 1, robot.modules + 1)):
        missing = f"rest --module {robot.modules}" if count and count + 1 == robot.modules else "rest"
        raise ModelError(
            f"{where}: found the calibration of {count} modules, expected {robot.modules}; run modsoft-calibrate "
            f"{missing}"
        )
    entries: tuple[Tool, ...] = (calibration.base, *calibration.modules)
    for place, (entry, sha256) in enumerate(zip(entries, tools or (), strict=False)):
        if entry.tool_sha256 != sha256 and place not in without:
            name, again = ("base", "") if place == 0 else (f"module {place}", f" --module {place}")
            raise ModelError(
                f"{where}: found another tool definition file for the {name} than at its calibration on {entry.date} "
                f"({entry.tool}); give that file, or run modsoft-calibrate rest{again}"
            )
