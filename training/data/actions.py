"""Random actions for the collection of data (section 2.2 of the paper), and smooth ones."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from modsoft.runtime.arrays import Array
from modsoft.runtime.control.actuation import limited, module_actuators
from modsoft.runtime.robot import Robot

JITTER = (0.003, 0.3)  # of smooth actions, smallest and largest
KNOT_STEPS = (4.0, 60.0)  # from one knot, a random action, to the next in a smooth sequence, fastest and slowest
KNOT_RANGE = 1.3  # knots are drawn from [-1.3, 1.3] and clipped to [-1, 1], so that its ends occur


def stage_borders(strategy: str, modules: int, steps: int) -> NDArray[np.int64]:
    """First step of each stage and the end: N stages of equal length where staged, one where random."""
    stages = modules if strategy == "staged" else 1
    return np.round(np.linspace(0, steps, stages + 1)).astype(np.int64)


def draw_actions(robot: Robot, strategy: str, steps: int, rng: np.random.Generator) -> Array:
    """Random actions (steps, N, A) in [-1, 1], uniform over the range.

    staged: in stage s = 0..N-1 the first N - s modules share one sequence, every further module has its own (section
    2.2, for any N). random: every module has its own. smooth and varied: motion as in tasks, which random actions never
    produce.

    Where the robot file bounds the step between two control periods, the sequence is a random walk reflected at the
    ends of the range: its steps never exceed the bound, and its distribution converges to the uniform one. Each walk
    changes its pace from time to time, so that the data contain slow and fast motion. The walk and the bound continue
    over stage borders.
    """
    shape = (steps, robot.modules, robot.action_size)
    largest = robot.limits.largest_actuation_step
    if strategy in ("smooth", "varied"):
        return _smooth(robot, steps, rng)
    drawn = rng.uniform(-1.0, 1.0, shape)
    if largest < 2.0:
        drawn *= largest * _paces(shape, rng)
    if strategy == "staged":
        borders = stage_borders(strategy, robot.modules, steps)
        for stage, (begin, end) in enumerate(itertools.pairwise(borders)):
            shared = robot.modules - stage
            drawn[begin:end, 1:shared] = drawn[begin:end, :1]
    return drawn if largest >= 2.0 else _reflected_walk(drawn)


def _paces(shape: tuple[int, int, int], rng: np.random.Generator) -> Array:
    """Largest step of each walk (steps, N, A) as a fraction, 0 to 1, of the bound; changes every 20 steps on average.

    Cubed, so that half of them are below an eighth: tasks move slowly, and the effect of friction is largest there.
    """
    paces = rng.uniform(0.0, 1.0, shape) ** 3
    for step, changes in enumerate(rng.uniform(size=shape) < 0.05):
        if step > 0:
            paces[step] = np.where(changes, paces[step], paces[step - 1])
    return paces


def _reflected_walk(increments: Array) -> Array:
    """Sums increments (steps, ...) of at most 2 from 0 and folds the sum back into [-1, 1]."""
    unfolded = np.cumsum(increments, axis=0) + 1.0
    return 1.0 - np.abs(unfolded % 4.0 - 2.0)


def _smooth(robot: Robot, steps: int, rng: np.random.Generator) -> Array:
    """Actions (steps, N, A) along curves between random knots, with jitter, from which the network learns the effect of
    small changes. Some modules follow a shared sequence, each with its own gain, others have their own; their number is
    random in each episode."""
    shape = (steps, robot.modules, robot.action_size)
    shared, follows = _wander(steps, robot.action_size, rng), rng.uniform()
    actions = np.empty(shape)
    for module in range(robot.modules):
        if rng.uniform() < follows:
            actions[:, module] = shared * rng.uniform(-1.0, 1.0)
        else:
            full = rng.uniform() < 0.5
            actions[:, module] = _wander(steps, robot.action_size, rng) * (1.0 if full else rng.uniform(0.2, 1.0))
    least, most = np.log(JITTER)
    jitter = np.exp(rng.uniform(least, most, robot.modules))[:, None]
    actions = np.clip(actions + jitter * rng.uniform(-1.0, 1.0, shape), -1.0, 1.0)
    previous, largest_step = np.zeros(shape[1:]), robot.limits.largest_actuation_step
    actuators = module_actuators(robot.directions)
    for step in range(steps):
        previous = actions[step] = limited(actions[step], previous, largest_step, actuators)
    return actions


def _wander(steps: int, action_size: int, rng: np.random.Generator) -> Array:
    """One sequence (steps, A) along cosines between knots; half of the sequences begin with a jump from rest."""
    pace = np.exp(rng.uniform(*np.log(KNOT_STEPS)))
    knots = [0.0]
    while knots[-1] <= steps:
        knots.append(knots[-1] + max(2.0, pace * np.exp(rng.normal(0.0, 0.4))))
    values = np.clip(rng.uniform(-KNOT_RANGE, KNOT_RANGE, (len(knots), action_size)), -1.0, 1.0)
    if rng.uniform() < 0.5:
        values[0] = 0.0
    at = np.arange(steps)
    before = np.searchsorted(knots, at, side="right") - 1
    fraction = (at - np.take(knots, before)) / np.diff(knots)[before]
    weight = (0.5 - 0.5 * np.cos(np.pi * fraction))[:, None]
    return values[before] * (1.0 - weight) + values[before + 1] * weight
