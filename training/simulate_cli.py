"""`modsoft-simulate`: applies a sequence of actions to the simulated robot from rest."""

from __future__ import annotations

from pathlib import Path

import click
import numpy as np

from modsoft.runtime import robot as robot_file
from modsoft.runtime.arrays import Array
from modsoft.runtime.entry_point import entry
from modsoft.runtime.errors import ModelError, ModsoftError
from modsoft.runtime.files import NOT_AN_ARRAY, check_not_input, check_writable, written
from modsoft.runtime.robot import Robot
from modsoft.training.simulation.fleet import Arms
from modsoft.training.simulation.parameters import plant_of
from modsoft.training.simulation.rollout import rollout


def read_actions(path: str, robot: Robot) -> Array:
    """Actions (steps, N, A) in [-1, 1] from a .npy file; `ModelError` for any other file."""
    expected = f"(steps, {robot.modules}, {robot.action_size}) for {robot.name}"
    try:
        actions = np.load(path, allow_pickle=False)
    except FileNotFoundError as error:
        raise ModelError(f"{path}: no such file; expected a .npy array {expected}") from error
    except (OSError, *NOT_AN_ARRAY) as error:  # numpy's own message recommends unsafe loading
        reason = error.strerror if isinstance(error, OSError) and error.strerror else "damaged, or another format"
        raise ModelError(f"{path}: not a .npy array of numbers ({reason}); expected {expected}") from error
    if not isinstance(actions, np.ndarray) or actions.dtype.kind not in "fiu":
        raise ModelError(f"{path}: found no array of numbers; expected {expected}")
    if actions.ndim != 3 or actions.shape[1:] != (robot.modules, robot.action_size) or not len(actions):
        raise ModelError(f"{path}: found shape {actions.shape}, expected {expected}")
    wrong = np.argwhere(~(np.abs(actions) <= 1.0))  # NaN is wrong too
    if len(wrong):
        step, module, action = (int(i) for i in wrong[0])
        raise ModelError(
            f"{path}: found {actions[step, module, action]} at step {step}, module {module + 1}, a_{action}; expected "
            "actions in [-1, 1]"
        )
    return actions.astype(np.float64)


def simulate(robot: Robot, actions: Array) -> dict[str, Array]:
    """Applies actions (steps, N, A), one a control period, from rest.

    Returns the states before the first and after each action: configuration (steps + 1, N, 3), [v_x, v_y, v_z];
    positions (steps + 1, N, 3), m; directors (steps + 1, N, 3, 3), rows d1, d2, d3. Raises `ModsoftError` if the
    simulation diverges.
    """
    arms = Arms(plant_of(robot), robot.modules, 1)
    (run,) = rollout(arms, actions[:, None], period_s=robot.loop.period_s).robots()
    if not arms.alive[0]:
        step = int(np.isnan(run.configuration).any(axis=(1, 2)).argmax()) - 1
        raise ModsoftError(
            f"the simulated robot {robot.name} diverges under the action of step {step}; expected a bounded motion; "
            "change the actuation by less in a step"
        )
    return {"configuration": run.configuration, "positions": run.positions, "directors": run.directors}


def write(path: str, run: dict[str, Array]) -> None:
    """Writes the arrays to exactly `path`, all of them or none."""
    with written(Path(path)) as part, part.open("wb") as file:
        np.savez(file, allow_pickle=False, **run)


@click.command("modsoft-simulate")
@click.option("--robot", "file_or_name", required=True, metavar="FILE|NAME", help="Robot file, or a shipped robot.")
@click.option("--actions", required=True, metavar="FILE", help=".npy array (steps, modules, actions) in [-1, 1].")
@click.option("--out", required=True, metavar="FILE", help=".npz to write.")
def command(file_or_name: str, actions: str, out: str) -> None:
    """Apply a sequence of actions, one in each control period, to the simulated robot from rest.

    OUT contains the arrays configuration (steps + 1, modules, 3), that is [v_x, v_y, v_z]; positions (steps + 1,
    modules, 3), m; and directors (steps + 1, modules, 3, 3), rows d1, d2, d3. Row 0 is the robot at rest.
    """
    check_writable(Path(out))
    check_not_input(Path(out), Path(actions), Path(file_or_name))
    robot = robot_file.load(file_or_name)
    run = simulate(robot, read_actions(actions, robot))
    write(out, run)
    last = np.array2string(run["configuration"][-1], precision=4, suppress_small=True).replace("\n", "")
    print(f"{out}: {len(run['configuration']) - 1} steps of {robot.loop.period_s:g} s; last configuration {last}")


main = entry(command)
