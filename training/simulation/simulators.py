"""The simulators for data collection, each behind one function: actions in, configurations out."""

from __future__ import annotations

import functools
from typing import NamedTuple, Protocol

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.errors import RobotFileError, UsageError
from modsoft.runtime.robot import Robot
from modsoft.training.simulation import fleet_kernel
from modsoft.training.simulation.fleet import Arms, Fleet
from modsoft.training.simulation.parameters import NOMINAL, Perturbation, plant_of
from modsoft.training.simulation.rollout import rollout


class Simulate(Protocol):
    """Robot and actions (B, K, N, A) of episodes from rest -> configurations (B, K + 1, N, 3), not finite where a robot
    diverged. An episode does not depend on the others."""

    def __call__(self, robot: Robot, actions: Array, *, perturbation: Perturbation = NOMINAL) -> Array: ...


class Simulator(NamedTuple):
    """A simulator that data can be collected from."""

    name: str  # stored in the data set: two simulators round differently
    simulate: Simulate
    batch_size: int  # episodes at a time for the best speed


def fastest(robot: Robot) -> Simulator:
    """The compiled fleet where this installation has it, else PyElastica."""
    return by_name(names()[0], robot)


def names() -> list[str]:
    """The simulators that run here, the fastest first. Each variant of the fleet has its own name, because they round
    differently."""
    return [*(f"fleet-{variant}" for variant in reversed(fleet_kernel.variants())), "elastica"]


def by_name(name: str, robot: Robot) -> Simulator:
    """The simulator of that name; `UsageError` where it does not run here, `RobotFileError` for an unsuitable robot."""
    if name not in names():
        raise UsageError(f"the simulator {name} does not run here; expected {', '.join(names())}")
    _check(robot)
    if name == "elastica":
        return Simulator(name, by_elastica, batch_size=1)
    # The lanes of the kernel: fewer episodes take the same time.
    return Simulator(name, functools.partial(by_fleet, variant=name.removeprefix("fleet-")), batch_size=8)


def by_fleet(
    robot: Robot, actions: Array, variant: str | None = None, *, perturbation: Perturbation = NOMINAL
) -> Array:
    """Robots side by side in compiled code."""
    fleet = Fleet(plant_of(robot), robot.modules, len(actions), variant=variant, perturbation=perturbation)
    return _run(fleet, actions, robot.loop.period_s)


def by_elastica(robot: Robot, actions: Array, *, perturbation: Perturbation = NOMINAL) -> Array:
    """One robot after the other in PyElastica, the reference."""
    arms = Arms(plant_of(robot), robot.modules, len(actions), perturbation=perturbation)
    return _run(arms, actions, robot.loop.period_s)


def _run(robots: Fleet | Arms, actions: Array, period_s: float) -> Array:
    return np.moveaxis(rollout(robots, np.moveaxis(actions, 1, 0), period_s=period_s).configuration, 0, 1)


def _check(robot: Robot) -> None:
    """Refuses a control period that is no whole number of time steps."""
    parameters, period_s = plant_of(robot), robot.loop.period_s
    steps = period_s / parameters.time_step_s
    if abs(steps - round(steps)) > 1e-6 * steps:
        raise RobotFileError(
            f"loop.hz {robot.loop.hz} is a period of {period_s:.6g} s; expected whole steps of "
            f"{parameters.time_step_s} s for the simulated robot"
        )
