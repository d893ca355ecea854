"""Checks of a data set at reading: users write their own, from the logs of real robots.

Each function raises `ModelError` in one line with the place, what was found and what was expected.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from modsoft.runtime import robot as robot_file
from modsoft.runtime.arrays import Array
from modsoft.runtime.control.features import OUT_OF_PLANE_LIMIT_DEG, REST_LIMIT_DEG, out_of_plane_deg
from modsoft.runtime.errors import ModelError, RobotFileError
from modsoft.runtime.files import decoded

ATTRIBUTES = {
    "schema": "a whole number",
    "generation": "JSON: robot, strategy, ...",
    "stage_borders": "whole numbers from 0 to the steps of an episode",
    "rejected": "a whole number, 0 for a real robot",
}
# Names of schema 1, and the present ones for the same: attributes, and keys of the generation settings.
SCHEMA_1 = {"recipe": "generation", "redrawn": "rejected"}  # words: old names
SCHEMA_1_SETTINGS = {"plant": "simulator", "plant_sha256": "simulator_sha256"}
LENGTH_TOLERANCE = 1e-3  # of a unit vector: allows half precision and numbers with four decimals
MEASURED = (
    "robot",
    "rig",
    "import",
)  # sources of data that may have gaps: a real robot, the emulated rig, a lab's file
RANGE_TOLERANCE = 1e-6  # of an action beyond [-1, 1]: allows the rounding of single precision


class Generation(msgspec.Struct):
    """The generation settings that every data set has; collected ones have more."""

    robot: dict[str, Any]
    strategy: str
    steps: int | None = None
    period_s: float | None = None


def attributes(in_file: Mapping[str, Any], schema: int, where: Path) -> dict[str, Any]:
    """All of `ATTRIBUTES` of a file of this schema, or of an older one, under their present names."""
    is_old = "schema" in in_file and whole_number("schema", in_file["schema"], where) == 1
    old_names = {new: old for old, new in SCHEMA_1.items()} if is_old else {}
    names = {name: old_names.get(name, name) for name in ATTRIBUTES}
    for name, name_in_file in names.items():
        if name_in_file not in in_file:
            raise ModelError(
                f"{where}: not a data set of modsoft-collect: no attribute {name_in_file}, expected {ATTRIBUTES[name]}"
            )
    version = whole_number("schema", in_file["schema"], where)
    if not 1 <= version <= schema:
        raise ModelError(f"{where}: schema {version}, expected 1 to {schema}; collect it again, or update modsoft")
    return {name: in_file[name_in_file] for name, name_in_file in names.items()}


def whole_number(name: str, value: Any, where: Path) -> int:
    """An attribute that counts something."""
    array = np.asarray(value)
    if array.shape not in ((), (1,)) or array.dtype.kind not in "iu" or int(array.item()) < 0:
        raise ModelError(f"{where}: {name} is {_short(value)}, expected a whole number")
    return int(array.item())


def generation(value: Any, steps: int, where: Path) -> dict[str, Any]:
    """The generation settings, under their present names; they fit episodes of `steps` control steps, and their robot
    can be read."""
    try:
        text = decoded(value) if isinstance(value, bytes) else value
        settings = json.loads(text)
        required = msgspec.convert(settings, Generation)
    except (ValueError, TypeError, RecursionError, msgspec.ValidationError) as error:
        raise ModelError(
            f"{where}: its generation settings cannot be read ({error}); expected {ATTRIBUTES['generation']}"
        ) from error
    try:
        robot = robot_file.from_dict(required.robot, "robot")
    except RobotFileError as error:  # of this file, not of a robot file that the user can edit
        raise ModelError(f"{where}: the robot of its generation settings cannot be read ({error})") from error
    if required.steps not in (None, steps):
        raise ModelError(f"{where}: steps {required.steps} in its generation settings, but its episodes have {steps}")
    period_s = robot.loop.period_s
    if required.period_s is not None and not math.isclose(required.period_s, period_s, rel_tol=1e-6):
        raise ModelError(
            f"{where}: period_s {required.period_s:g} in its generation settings, but hz of its robot means "
            f"{period_s:g}"
        )
    return {SCHEMA_1_SETTINGS.get(name, name): setting for name, setting in settings.items()}


def planar_state(value: Any, schema: int, robot: robot_file.Robot, where: Path) -> None:
    """Refuses planar data of releases 0.1, whose state was (v_x, v_y)."""
    version = int(np.asarray(value).item())
    if robot.motion == "planar" and version < schema:
        raise ModelError(
            f"{where}: schema {version} of a planar robot, with the state (v_x, v_y) of release 0.1; "
            f"expected schema {schema}, state (v_x, v_z); collect it again"
        )


def stage_borders(value: Any, steps: int, where: Path) -> NDArray[np.int64]:
    """First step of each stage, and the end (stages + 1,)."""
    borders = np.asarray(value)
    is_list = borders.ndim == 1 and len(borders) >= 2 and borders.dtype.kind in "iu"
    if not is_list or borders[0] != 0 or borders[-1] != steps or not (borders[1:] >= borders[:-1]).all():
        raise ModelError(
            f"{where}: stage_borders {_short(value)}, expected whole numbers that rise from 0 to {steps}, the steps of "
            f"an episode; [0, {steps}] for a single stage"
        )
    return borders.astype(np.int64)


def shapes(configuration: tuple[int, ...], action: tuple[int, ...], robot: robot_file.Robot, where: Path) -> None:
    """The arrays' shapes, against the robot's and each other's."""
    episodes, steps = action[:2] if len(action) == 4 else (0, 0)
    for name, shape, expected, in_words in (
        ("action", action, (episodes, steps, robot.modules, robot.action_size), "(episodes, steps, {1}, {2})"),
        ("configuration", configuration, (episodes, steps + 1, robot.modules, 3), "(episodes, steps + 1, {1}, 3)"),
    ):
        if shape != expected or 0 in shape:
            full_shape = f"{expected}" if 0 not in expected else in_words.format(0, robot.modules, robot.action_size)
            raise ModelError(f"{where}: {name} has the shape {shape}, expected {full_shape} for robot {robot.name}")


def without_gaps(values: Array, stand_in: Any) -> Array:
    """A copy of values (E, K, N, ...) with `stand_in` in each row of NaN, for the checks."""
    gaps = np.isnan(values).all(axis=(2, 3), keepdims=True)
    return np.where(gaps, stand_in, values)


def configuration(values: Array, motion: str, where: Path) -> None:
    """Finite unit vectors (E, K + 1, N, 3), each episode from rest, and of planar modules in the plane."""
    _finite("configuration", values, where)
    length = np.linalg.norm(values, axis=-1)
    wrong = np.argwhere(np.abs(length - 1.0) > LENGTH_TOLERANCE)
    if len(wrong):
        episode, step, module = map(int, wrong[0])
        vector = ", ".join(f"{value:g}" for value in values[episode, step, module])
        raise ModelError(
            f"{where}: configuration of episode {episode}, step {step}, module {module + 1} is [{vector}], of length "
            f"{length[episode, step, module]:.4g}; expected a unit vector [v_x, v_y, v_z]"
        )
    bent_deg = np.degrees(np.arccos(np.clip(values[:, 0, :, 2], -1.0, 1.0)))
    wrong = np.argwhere(bent_deg > REST_LIMIT_DEG)
    if len(wrong):
        episode, module = map(int, wrong[0])
        raise ModelError(
            f"{where}: episode {episode} begins with module {module + 1} bent by {bent_deg[episode, module]:.0f} "
            f"degrees, expected it at rest (at most {REST_LIMIT_DEG:g}); is the order [v_x, v_y, v_z], v_z along the "
            "robot?"
        )
    wrong = np.argwhere(out_of_plane_deg(values) > OUT_OF_PLANE_LIMIT_DEG)
    if motion == "planar" and len(wrong):
        episode, step, module = map(int, wrong[0])
        raise ModelError(
            f"{where}: configuration of episode {episode}, step {step}, module {module + 1} of a planar robot is "
            f"{out_of_plane_deg(values[episode, step, module]):.0f} degrees out of its plane; expected at most "
            f"{OUT_OF_PLANE_LIMIT_DEG:g}, v_y about 0"
        )


def action(values: Array, where: Path) -> None:
    """Finite actions (E, K, N, A) in [-1, 1]."""
    _finite("action", values, where)
    wrong = np.argwhere(np.abs(values) > 1.0 + RANGE_TOLERANCE)
    if len(wrong):
        episode, step, module, number = map(int, wrong[0])
        raise ModelError(
            f"{where}: action a_{number} of episode {episode}, step {step}, module {module + 1} is "
            f"{values[episode, step, module, number]:g}; expected actions in [-1, 1]"
        )


def _finite(name: str, values: Array, where: Path) -> None:
    if not np.isfinite(values).all():
        episode, step, module, _ = map(int, np.argwhere(~np.isfinite(values))[0])
        raise ModelError(
            f"{where}: {name} holds values that are not finite, first in episode {episode}, step {step}, "
            f"module {module + 1}"
        )


def _short(value: Any) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."
