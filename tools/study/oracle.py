"""The stage of the oracle errors: the smallest errors that any sequence of actions is known to reach."""

from __future__ import annotations

import functools
from functools import partial
from typing import Any

from modsoft.runtime import robot as robot_file
from modsoft.runtime.arrays import Array
from modsoft.study import rollouts
from modsoft.study.paths import Folder
from modsoft.study.plan import Plan
from modsoft.study.scheduler import AddProgress, Stage
from modsoft.training import made_from
from modsoft.training.simulation.fleet import simulated
from modsoft.training.simulation.rollout import Rollout, rollout

STEP_S = 0.35  # estimated seconds for a control step of four modules on one core


def oracle_stage(plan: Plan, folder: Folder, jobs: int) -> Stage:
    """oracle/*.npz, each stored as a run: the robot's motion under the optimised actions."""
    missing = [
        each
        for each in plan.oracle_errors
        if rollouts.stored_identity(folder.oracle_error(*each)) != identity(plan, *each)
    ]
    return Stage("oracle", missing, partial(_optimize, plan, folder), partial(oracle_s, plan))


def oracle_s(plan: Plan, task_and_modules: tuple[str, int]) -> float:
    """Estimated seconds on one core."""
    return (plan.steps or 250) * STEP_S * (task_and_modules[1] / 4) ** 2


@functools.cache
def code_sha256() -> str:
    """Digest of the source code that shapes an oracle error."""
    return made_from.digest({}, modules=["modsoft.training.simulation.oracle", "modsoft.runtime.control.tasks"])


def identity(plan: Plan, task: str, modules: int) -> dict[str, Any]:
    """What the stored run depends on."""
    steps = len(rollouts.desired_of(plan, task, modules))
    return {"task": task, "modules": modules, "steps": steps, "seed": 0, "code_sha256": code_sha256()}


def _optimize(plan: Plan, folder: Folder, task_and_modules: tuple[str, int], add_progress: AddProgress) -> None:
    from modsoft.training.simulation.oracle import oracle_error
    from modsoft.training.simulation.parameters import plant_of

    task, modules = task_and_modules
    desired = rollouts.desired_of(plan, task, modules)
    actions, _ = oracle_error(plant_of(robot_file.load(f"cable-{modules}")), modules, desired, seed=0)
    rollouts.store(folder.oracle_error(task, modules), identity(plan, task, modules), replay(modules, actions), desired)


def replay(modules: int, actions: Array) -> Rollout:
    """The motion of a robot, at rest before, under actions (K, N, A)."""
    return rollout(simulated(robot_file.load(f"cable-{modules}"), 1), actions[:, None]).robots()[0]
