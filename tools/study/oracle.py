"""The floor of every cell: the smallest error that any sequence of actions is known to reach, found on the plant."""

from __future__ import annotations

import functools
from functools import partial
from typing import Any

from modsoft.runtime.arrays import Array
from modsoft.study import rollouts
from modsoft.study.paths import Folder
from modsoft.study.plan import Plan
from modsoft.study.scheduler import Stage, Told
from modsoft.training import made_from
from modsoft.training.simulation.fleet import simulated
from modsoft.training.simulation.rollout import Rollout, rollout

STEP_S = 0.35  # of one core, for a control step of four modules, about


def finding(plan: Plan, folder: Folder, jobs: int) -> Stage:
    """floors/*.npz, each a run like any other: what the robot does under the best actions found."""
    missing = [
        each for each in plan.oracle_errors if rollouts.meta(folder.oracle_error(*each)) != identity(plan, *each)
    ]
    return Stage("oracle", missing, partial(_find, plan, folder), partial(find_s, plan))


def find_s(plan: Plan, each: tuple[str, int]) -> float:
    return (plan.steps or 250) * STEP_S * (each[1] / 4) ** 2


@functools.cache
def code_sha256() -> str:
    """Digest of the source code that shapes an oracle error."""
    return made_from.digest({}, modules=["modsoft.training.simulation.oracle", "modsoft.runtime.control.tasks"])


def identity(plan: Plan, task: str, modules: int) -> dict[str, Any]:
    steps = len(rollouts.desired_of(plan, task, modules))
    return {"task": task, "modules": modules, "steps": steps, "seed": 0, "code_sha256": code_sha256()}


def _find(plan: Plan, folder: Folder, each: tuple[str, int], told: Told) -> None:
    from modsoft.training.simulation.oracle import oracle_error

    task, modules = each
    desired = rollouts.desired_of(plan, task, modules)
    actions, _ = oracle_error("cable", modules, desired, seed=0)
    rollouts.keep(folder.oracle_error(*each), identity(plan, *each), replay(modules, actions), desired)


def replay(modules: int, actions: Array) -> Rollout:
    """What a robot at rest does under actions (K, N, A)."""
    return rollout(simulated("cable", modules, 1), actions[:, None]).robots()[0]
