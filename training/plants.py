"""The simulated robots that data can be collected from, each behind one function: actions in, configurations out."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from modsoft.runtime.errors import RobotFileError
from modsoft.runtime.robot import Robot
from modsoft.training import kernel
from modsoft.training.fleet import Arms, Fleet
from modsoft.training.robots import PASCAL_PER_BAR, PLANTS

Array = NDArray[np.float64]
Simulate = Callable[[Robot, Array], Array]


class Plant(NamedTuple):
    """simulate: robot and actions (B, K, N, A) of episodes from rest -> configurations (B, K + 1, N, 3), not finite
    where a robot was lost; what one episode gives does not depend on the others beside it."""

    name: str  # goes into the data set: two plants round differently
    simulate: Simulate
    together: int  # episodes that it likes to simulate at a time


def fastest(robot: Robot) -> Plant:
    """The compiled fleet where this installation has it, else PyElastica."""
    _check(robot)
    built = kernel.variants()
    # A vector of another width may round differently, so that a restart elsewhere would not give the same bits.
    return Plant(f"fleet-{built[-1]}", by_fleet, together=16) if built else Plant("elastica", by_elastica, together=1)


def by_fleet(robot: Robot, actions: Array) -> Array:
    """Robots side by side in compiled code."""
    return _run(Fleet(robot.robot.kind, robot.modules, len(actions)), actions, robot.loop.period_s)


def by_elastica(robot: Robot, actions: Array) -> Array:
    """One robot after the other in PyElastica, the reference."""
    return _run(Arms(robot.robot.kind, robot.modules, len(actions)), actions, robot.loop.period_s)


def _run(robots: Fleet | Arms, actions: Array, period_s: float) -> Array:
    configuration = [robots.configuration]
    for action in np.moveaxis(actions, 1, 0):
        robots.step(action, period_s)
        configuration.append(robots.configuration)
    return np.stack(configuration, axis=1)


def _check(robot: Robot) -> None:
    """What the robot file says and the simulated robot cannot do."""
    plant, period_s = PLANTS[robot.robot.kind], robot.loop.period_s
    steps = period_s / plant.time_step_s
    if abs(steps - round(steps)) > 1e-6 * steps:
        raise RobotFileError(
            f"loop.hz {robot.loop.hz} is a period of {period_s:.6g} s; expected whole steps of {plant.time_step_s} s "
            "for the simulated robot"
        )
    if robot.valve is not None:
        stresses = (plant.actuators.rest_stress_pa, plant.actuators.full_stress_pa)
        expected = [round(-stress / PASCAL_PER_BAR, 6) for stress in stresses]
        found = [robot.valve.p_min_bar, robot.valve.p_max_bar]
        if found != expected:
            raise RobotFileError(
                f"valve.p_min_bar, p_max_bar are {found[0]}, {found[1]}; the simulated robot knows {expected[0]}, "
                f"{expected[1]} only"
            )
