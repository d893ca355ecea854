"""Tasks: desired configurations over the control steps, from the paper's supplement (S1 to S5), and `circle`.

The supplement prints 3.24 degrees for `down` with two modules. That contradicts its text ("about 30 degrees", angles
with a sum of zero), so 32.4 is used.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.control import task_tables
from modsoft.runtime.control.features import from_angles_deg
from modsoft.runtime.control.task_tables import Bend
from modsoft.runtime.errors import UsageError
from modsoft.runtime.files import NOT_AN_ARRAY
from modsoft.runtime.robot import Robot

SIMULATED_STEPS = 250
REAL_STEPS = 200

# Largest angles of the planar tasks, degrees.
EDGE_DEG = {3: [5.4, 18.0, 90.0], 2: [21.6, 72.0]}
DOWN_DEG = {3: [3.6, 36.0, -39.6], 2: [32.4, -32.4]}
# Angles of `circle`, degrees: four fifths of the reach of `pneumatic-3x3`, and of its last two modules alone
# (tools/bench/reach.py).
CIRCLE_DEG = {3: [3.5, 18.5, -47.0], 2: [17.9, -47.0]}


def _turn(phase: Array, v_z: Array, sign: Array) -> Array:
    """Configurations (steps, N, 3) turning about z: phase (steps,) rad, v_z (steps, N), sign (N,)."""
    side = sign * np.sqrt(1.0 - v_z**2)
    return np.stack([np.sin(phase)[:, None] * side, np.cos(phase)[:, None] * side, v_z], axis=-1)


def task_a(smallest: Bend) -> Array:
    """S1: all modules turn once while their bending increases."""
    t = np.arange(SIMULATED_STEPS) / SIMULATED_STEPS
    return _turn(2 * np.pi * t, 1.0 - (1.0 - smallest.v_z) * t[:, None], smallest.sign)


def task_b(constant: Bend) -> Array:
    """S2: one turn at constant bending; starts with a jump from rest."""
    t = np.arange(SIMULATED_STEPS) / SIMULATED_STEPS
    return _turn(2 * np.pi * t, np.broadcast_to(constant.v_z, (SIMULATED_STEPS, len(constant.v_z))), constant.sign)


def task_c(smallest: Bend) -> Array:
    """S3, S4: 50 steps of bending in y, then one turn."""
    t = np.arange(SIMULATED_STEPS)
    v_z = 1.0 - (1.0 - smallest.v_z) * np.minimum(t / 50, 1.0)[:, None]
    return _turn(2 * np.pi * np.maximum(t - 50, 0) / 200, v_z, smallest.sign)


def task_planar(largest_deg: list[float]) -> Array:
    """S5: every angle rises to its largest value, falls to the opposite one, and returns to 0."""
    t = np.arange(REAL_STEPS)
    fraction = np.where(t < 50, t / 50, np.where(t < 150, 2 - t / 50, t / 50 - 4))
    return from_angles_deg(fraction[:, None] * np.asarray(largest_deg))


def task_circle(largest_deg: list[float]) -> Array:
    """50 steps of bending in y, 100 of one turn, 50 back to straight, as in task C: the tip module bends back."""
    t = np.arange(REAL_STEPS)
    angle_rad = np.radians(np.abs(largest_deg)) * np.clip(np.minimum(t / 50, 4.0 - t / 50), 0.0, 1.0)[:, None]
    return _turn(2 * np.pi * np.clip((t - 50) / 100, 0.0, 1.0), np.cos(angle_rad), np.sign(largest_deg))


def next_reference(desired: Array) -> Array:
    """Reference of the network at each step (K, N, 3): S_d of eq. (1) is the desired state at the end of the period,
    which is `desired` (K, N, 3) at the start of the next one. The last configuration is repeated."""
    return np.concatenate([desired[1:], desired[-1:]])


def available(motion: str, modules: int) -> list[str]:
    """Names of the tasks for a motion, "planar" or "spatial", and a number of modules."""
    if motion == "spatial":
        return ["A", "B", "C", *(["circle"] if modules in CIRCLE_DEG else [])]
    return ["edge", "down"] if modules in EDGE_DEG else []


def task(name: str, motion: str, modules: int) -> Array:
    """Desired configurations (steps, N, 3), [v_x, v_y, v_z], at the start of each control step. `UsageError` for an
    unknown name."""
    if name not in available(motion, modules):
        names = "".join(f"{each}, " for each in available(motion, modules))
        names += "or " if names else ""
        raise UsageError(
            f"no task {name!r} for a {motion} robot of {modules} modules; expected {names}a .npy file with "
            f"desired configurations (steps, {modules}, 3), [v_x, v_y, v_z]"
        )
    match name:
        case "A":
            return task_a(task_tables.spiral(modules))
        case "B":
            return task_b(task_tables.circle(modules))
        case "C":
            return task_c(task_tables.bend(modules))
        case "circle":
            return task_circle(CIRCLE_DEG[modules])
        case "edge":
            return task_planar(EDGE_DEG[modules])
        case _:
            return task_planar(DOWN_DEG[modules])


def task_of(robot: Robot, folder: Path) -> str:
    """The task under [loop], in the form for `load_task`; folder: base of the relative paths in the robot file."""
    task = robot.loop.task
    return str(folder / task) if _is_file_name(task) else task


def _is_file_name(task: str) -> bool:
    return task.lower().endswith(".npy")


def load_task(name_or_file: str, robot: Robot) -> Array:
    """Loads a task by its name, or from a .npy file of unit vectors (steps, N, 3). `UsageError` for anything else."""
    if not _is_file_name(name_or_file):
        return task(name_or_file, robot.motion, robot.modules)
    if Path(name_or_file).is_dir():
        raise UsageError(f"task file {name_or_file} is a folder; give a .npy file or a task's name")
    if not Path(name_or_file).is_file():
        raise UsageError(f"no task file {name_or_file!r}; give an existing .npy file or a task's name")
    try:
        desired = np.load(name_or_file, allow_pickle=False)
    except OSError as error:
        raise UsageError(f"task file {name_or_file}: cannot be read ({error.strerror or error})") from error
    except NOT_AN_ARRAY as error:
        # Without numpy's message, which advises to load the file unsafely.
        raise UsageError(
            f"task file {name_or_file}: not a readable .npy array of floats (damaged, or another format); "
            "write it again with numpy.save"
        ) from error
    if not isinstance(desired, np.ndarray):
        raise UsageError(f"task file {name_or_file}: an archive of arrays (.npz); write one array with numpy.save")
    if desired.ndim != 3 or desired.shape[1:] != (robot.modules, 3):
        raise UsageError(f"task file {name_or_file}: found shape {desired.shape}, expected (steps, {robot.modules}, 3)")
    if not len(desired):
        raise UsageError(f"task file {name_or_file}: found 0 steps, expected at least 1")
    if desired.dtype.kind != "f" or not np.allclose(np.linalg.norm(desired, axis=-1), 1.0, atol=1e-6):
        raise UsageError(f"task file {name_or_file}: every [v_x, v_y, v_z] must be a unit vector of floats")
    if robot.motion == "planar" and np.abs(desired[..., 1]).max() > 1e-6:
        raise UsageError(f"task file {name_or_file}: found a v_y other than 0, expected 0 in the plane of {robot.name}")
    return desired.astype(np.float64)
