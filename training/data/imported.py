"""Data sets from a lab's own file: CSV or npz, one row a control step, with stated columns and units.

The action of a row is applied from the time of its configuration on, until the next row. A row with a number missing
(empty or NaN) and a jump in time are gaps, which end an episode.
"""

from __future__ import annotations

import csv
import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from modsoft.runtime.arrays import Array
from modsoft.runtime.control.actuation import actuation_of_pressures
from modsoft.runtime.control.features import OUT_OF_PLANE_LIMIT_DEG, from_angles_deg, out_of_plane_deg
from modsoft.runtime.errors import ModelError, UsageError
from modsoft.runtime.files import NOT_AN_ARRAY, check_is_file, check_not_input, check_writable, read_text
from modsoft.runtime.robot import Robot
from modsoft.training.data import dataset
from modsoft.training.data.dataset_checks import LENGTH_TOLERANCE, RANGE_TOLERANCE
from modsoft.training.data.recording import PERIOD_TOLERANCE, of_data

LEAST_LARGEST_DEG = 3.2  # of all angles: below it they are radians
PRESSURE_MARGIN = 0.05  # of the pressure range: a sensor may measure a little more than the set-point


@dataclass(frozen=True)
class Layout:
    """Columns and units of the file. Columns: names of the CSV's header or numbers from 1; for npz names of arrays.

    configuration: "degrees" (planar: the bending angle of each module; in space bending angle and direction of each) or
    "unit-vectors" (v_x, v_y, v_z of each module). action: "actions" (those of each module, -1 to 1) or "bar" (the
    pressures of each module's chambers, in the order of directions_deg in the robot file). time: column in seconds,
    empty for none.
    """

    configuration: str
    configuration_columns: tuple[str, ...]
    action: str
    action_columns: tuple[str, ...]
    period_s: float
    time: str = ""


@dataclass(frozen=True)
class Columns:
    """Numbers (rows, columns) of a file, and how a message names a place in it."""

    path: Path
    values: Array
    names: tuple[str, ...]
    first_row: int  # number of the first row, as an editor counts lines

    def refuse(self, row: int, column: int, found: str, expected: str) -> ModelError:
        return ModelError(
            f"{self.path}: row {self.first_row + row}, column {self.names[column]}: {found}; expected {expected}"
        )


def import_file(path: Path, robot: Robot, out: Path, layout: Layout) -> int:
    """Writes the data set `out`; returns its number of samples. Raises `ModelError` for a file of another content, with
    row and column, `UsageError` for columns and a period that do not fit the robot."""
    check_writable(out)
    check_not_input(out, path)
    if not math.isclose(layout.period_s, robot.loop.period_s, rel_tol=1e-6):
        raise UsageError(
            f"--period-s {layout.period_s:g}, but hz = {robot.loop.hz:g} in the robot file means "
            f"{robot.loop.period_s:g} s; give the robot file the rate of the data, or resample them"
        )
    configuration = _configuration(_read(path, layout.configuration_columns), robot, layout)
    action = _action(_read(path, layout.action_columns), robot, layout)
    if len(configuration) != len(action):
        raise ModelError(f"{path}: {len(configuration)} rows of configurations, {len(action)} rows of actions")
    breaks = _breaks(_read(path, (layout.time,)), layout.period_s) if layout.time else []
    # A row of NaN before each continuous piece, also before the first: its start is not known to be at rest.
    configuration, action = (np.insert(values, [0, *breaks], np.nan, axis=0) for values in (configuration, action))
    episode = dataset.MeasuredEpisode(configuration, action[:-1])
    generation: dict[str, Any] = {
        "robot": of_data(robot),
        "strategy": "imported",
        "steps": len(episode.action),
        "period_s": robot.loop.period_s,
        "source": "import",
        "clock": "real",
        "file": path.name,
        "file_sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "units": [layout.configuration, layout.action],
        "code_version": version("modsoft"),
    }
    data = dataset.DataSet(
        generation, episode.configuration[None], episode.action[None], np.array([0, len(episode.action)]), 0
    )
    if data.samples == 0:
        raise ModelError(f"{path}: no two complete rows in succession, expected at least one control step")
    dataset.join(out, generation, data.stage_borders, 1, [episode])
    return data.samples


def _read(path: Path, columns: Sequence[str]) -> Columns:
    check_is_file(path, "CSV or npz file", "give the file that the lab wrote")
    read = _read_npz if path.suffix.lower() == ".npz" else _read_csv
    return read(path, columns)


def _read_csv(path: Path, columns: Sequence[str]) -> Columns:
    lines = read_text(path).splitlines()
    delimiter = max(",;\t", key=(lines[0] if lines else "").count)
    rows = list(csv.reader(lines, delimiter=delimiter))
    header = [name.strip() for name in rows[0]] if rows else []
    has_header = not all(_is_number(name) for name in header)
    index = [_index(path, name, header if has_header else [], len(header)) for name in columns]
    body = rows[has_header:]
    while body and not any(cell.strip() for cell in body[-1]):
        body.pop()
    if not body:
        raise ModelError(f"{path}: no rows of numbers, expected one for each control step")
    read = Columns(path, np.full((len(body), len(index)), np.nan), tuple(columns), 1 + has_header)
    for number, row in enumerate(body):
        for column, at in enumerate(index):
            text = row[at].strip() if at < len(row) else ""
            if not _is_number(text):
                raise read.refuse(number, column, f"found {text[:40]!r}", "a number, or nothing")
            read.values[number, column] = float(text or "nan")
            if math.isinf(read.values[number, column]):
                raise read.refuse(number, column, f"found {text}", "a finite number, or nothing")
    return read


def _is_number(text: str) -> bool:
    try:
        float(text.strip() or "nan")
    except ValueError:
        return False
    return "_" not in text  # Python allows it between digits


def _index(path: Path, name: str, header: list[str], count: int) -> int:
    """Index of a column by its name, or by its number from 1."""
    if name in header:
        return header.index(name)
    if name.isdecimal() and 1 <= int(name) <= count:
        return int(name) - 1
    known = f"one of {', '.join(header[:20])}, or " if header else ""
    raise UsageError(f"{path}: no column {name!r}; expected {known}a number from 1 to {count}")


def _read_npz(path: Path, columns: Sequence[str]) -> Columns:
    """Arrays (rows, ...), the columns of each in the order of its memory."""
    parts, names = [], list[str]()
    try:
        with np.load(path, allow_pickle=False) as file:
            for name in columns:
                if name not in file.files:
                    raise UsageError(f"{path}: no array {name!r}; expected one of {', '.join(file.files[:20])}")
                array = np.asarray(file[name])
                if array.dtype.kind not in "fiu" or not 1 <= array.ndim <= 4 or not array.size:
                    raise ModelError(
                        f"{path}: array {name} of {array.dtype} {array.shape}; expected numbers (rows, ...)"
                    )
                parts.append(array.reshape(len(array), -1).astype(np.float64))
                names += [f"{name}[{column}]" for column in range(parts[-1].shape[1])]
    except (OSError, BadZipFile, *NOT_AN_ARRAY) as error:
        raise ModelError(f"{path}: not a readable npz file ({error}); write it again with numpy.savez") from error
    if len({len(part) for part in parts}) > 1:
        raise ModelError(f"{path}: arrays of {', '.join(str(len(part)) for part in parts)} rows, expected the same")
    read = Columns(path, np.concatenate(parts, axis=1), tuple(names), 1)
    for row, column in np.argwhere(np.isinf(read.values))[:1]:
        raise read.refuse(row, column, "found infinity", "a finite number, or NaN")
    return read


def _expect(read: Columns, option: str, count: int, what: str) -> None:
    if read.values.shape[1] != count:
        raise UsageError(f"--{option}: found {read.values.shape[1]} columns, expected {count}: {what}")


def _first(read: Columns, wrong: NDArray[np.bool_], found: str, expected: str) -> None:
    """Refuses the first place where `wrong` (rows, columns) is true."""
    for row, column in np.argwhere(wrong)[:1]:
        raise read.refuse(row, column, f"found {read.values[row, column]:g}{found}", expected)


def _configuration(read: Columns, robot: Robot, layout: Layout) -> Array:
    """Configurations (rows, N, 3), NaN where a number is missing."""
    modules, values = robot.modules, read.values
    if layout.configuration == "unit-vectors":
        _expect(read, "configuration-columns", 3 * modules, f"v_x, v_y, v_z of each of {modules} modules")
        vectors = values.reshape(-1, modules, 3)
        length = np.linalg.norm(vectors, axis=-1)
        wrong = np.repeat(np.abs(length - 1.0) > LENGTH_TOLERANCE, 3, axis=-1)
        for row, column in np.argwhere(wrong)[:1]:
            found = f"found a vector of length {length[row, column // 3]:.4g}"
            raise read.refuse(row, column, found, "unit vectors, v_x, v_y, v_z of each module")
        outside_deg = out_of_plane_deg(vectors)
        planar = robot.motion == "planar"
        for row, module in np.argwhere(outside_deg > OUT_OF_PLANE_LIMIT_DEG) if planar else ():
            found = f"found {outside_deg[row, module]:.0f} degrees out of the plane"
            raise read.refuse(row, 3 * module + 1, found, f"at most {OUT_OF_PLANE_LIMIT_DEG:g}, v_y about 0")
        return _whole(vectors)
    each = 1 if robot.motion == "planar" else 2
    what = "the bending angle" if each == 1 else "bending angle and direction"
    _expect(read, "configuration-columns", each * modules, f"{what} of each of {modules} modules")
    _first(read, np.abs(values) > 360.0, " degrees", "-360 to 360")
    if np.nanmax(np.abs(values[:, ::each]), initial=0.0) < LEAST_LARGEST_DEG:
        raise ModelError(
            f"{read.path}: the largest angle is {np.nanmax(np.abs(values), initial=0.0):.3g}; expected degrees, these "
            "may be radians"
        )
    angles = values.reshape(-1, modules, each)
    if each == 1:
        return _whole(from_angles_deg(angles[..., 0]))
    bend, direction = np.radians(angles[..., 0]), np.radians(angles[..., 1])
    across = np.sin(bend)
    return _whole(np.stack([across * np.cos(direction), across * np.sin(direction), np.cos(bend)], axis=-1))


def _action(read: Columns, robot: Robot, layout: Layout) -> Array:
    """Actions (rows, N, A), NaN where a number is missing."""
    modules, values = robot.modules, read.values
    if layout.action == "actions":
        _expect(
            read, "action-columns", modules * robot.action_size, f"{robot.action_size} of each of {modules} modules"
        )
        _first(read, np.abs(values) > 1.0 + RANGE_TOLERANCE, "", "actions, -1 to 1")
        return _whole(values.reshape(-1, modules, robot.action_size))
    if robot.valve is None:
        raise UsageError(f"--action-unit bar: robot {robot.name} has no [valve]; give actions, -1 to 1")
    chambers, valve = len(robot.directions), robot.valve
    _expect(read, "action-columns", modules * chambers, f"{chambers} chambers of each of {modules} modules")
    margin = PRESSURE_MARGIN * (valve.p_max_bar - valve.p_min_bar)
    wrong = (values < -margin) | (values > valve.p_max_bar + margin)
    _first(read, wrong, " bar", f"0 to {valve.p_max_bar:g}, p_max_bar of the robot file")
    return _whole(actuation_of_pressures(robot, values.reshape(-1, modules, chambers)))


def _whole(values: Array) -> Array:
    """values (rows, N, S) with NaN in the whole of each row that lacks a number."""
    return np.where(np.isnan(values).any(axis=(1, 2), keepdims=True), np.nan, values)


def _breaks(read: Columns, period_s: float) -> list[int]:
    """Rows before which time jumps."""
    time_s = read.values[:, 0]
    _expect(read, "time-column", 1, "seconds")
    for row in np.flatnonzero(np.isnan(time_s))[:1]:
        raise read.refuse(int(row), 0, "no time", "seconds")
    steps_s = np.diff(time_s)
    for row in np.flatnonzero(steps_s <= 0.0)[:1]:
        raise read.refuse(int(row) + 1, 0, f"{time_s[row + 1]:g} after {time_s[row]:g}", "times that rise, in seconds")
    if len(steps_s) and abs(np.median(steps_s) - period_s) > PERIOD_TOLERANCE * period_s:
        raise ModelError(
            f"{read.path}: column {read.names[0]}: rows are {np.median(steps_s):g} apart in the median; expected "
            f"seconds, --period-s {period_s:g}"
        )
    return (np.flatnonzero(np.abs(steps_s - period_s) > PERIOD_TOLERANCE * period_s) + 1).tolist()
