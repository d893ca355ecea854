"""The oracle error of a task: the error of the best actions found by optimisation on the simulated robot itself.

It is an upper bound of the smallest possible error. The optimisation has two passes. `greedy` goes through the task
once: at every control step a Gauss-Newton search within the bounds of the actuation, with finite differences on a fleet
in the state of the robot, finds the action after which the robot is nearest to the next desired configuration.
`improved` then changes all actions of the sequence together, from the derivatives of the configurations in the same
period and in the next one (about a twentieth), and minimises the sum of the errors, not of their squares.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.optimize import lsq_linear
from scipy.sparse.linalg import spsolve

from modsoft.runtime.arrays import Array
from modsoft.runtime.control.tasks import next_reference
from modsoft.runtime.errors import ModsoftError
from modsoft.training.simulation.fleet import Fleet, Snapshot
from modsoft.training.simulation.parameters import PlantParameters
from modsoft.training.simulation.rollout import configuration_errors_percent, rollout

PROBE = 1e-4  # of actuation, for finite differences
TOLERANCE = 1e-5  # of the unit vector: a smaller error is not improved
LEAST_GAIN = 1e-3  # of the error: a smaller gain of a step ends the search in a control step
LEAST_GAIN_OF_SWEEP = 1e-2  # likewise of a sweep over all actions
TRIALS = 10  # Gauss-Newton steps in a control step
HORIZON = 2  # periods with an effect of an action
SWEEPS = 5


class OracleResult(NamedTuple):
    """The best actions, and the errors of the configurations at the start of each period, as the paper counts them."""

    actions: Array  # (K, N, A)
    errors: Array  # (K, N), percent of the unit vector


class _Candidate(NamedTuple):
    error: float  # summed over the modules, of the unit vector
    action: Array  # (N * A,)
    robot: Snapshot  # after it


def oracle_error(plant: PlantParameters, modules: int, desired: Array, *, seed: int = 0) -> OracleResult:
    """The best actions found for `desired` (K, N, 3), the configurations at the start of each period, from rest.

    seed: of the random starts of Gauss-Newton. Raises `ModsoftError` where the robot diverges under every action.
    """
    actions = improved(plant, modules, desired, greedy(plant, modules, desired, seed=seed))
    reached = rollout(Fleet(plant, modules, 1), actions[:, None]).configuration[:, 0]
    return OracleResult(actions, configuration_errors_percent(reached, desired))


def greedy(plant: PlantParameters, modules: int, desired: Array, *, seed: int = 0) -> Array:
    """Actions (K, N, A), each the best for the end of its own period, without regard to later ones."""
    lanes, size = Fleet(plant, modules, 1).lanes, modules * len(plant.actuators.directions[0])
    # The robot, one for each finite difference, and random starts to fill the last block, which take no extra time.
    robots = Fleet(plant, modules, -(-(size + 3) // lanes) * lanes)
    random = np.random.default_rng(seed)
    robot, guess = robots.snapshot([0]), np.zeros(size)
    actions: list[Array] = []
    for target in next_reference(desired):
        candidate = _nearest(robots, robot, target, guess, random)
        before = actions[-1] if actions else candidate.action
        robot, guess = candidate.robot, np.clip(2.0 * candidate.action - before, -1.0, 1.0)
        actions.append(candidate.action)
    return np.stack(actions).reshape(len(desired), modules, -1)


def _nearest(robots: Fleet, robot: Snapshot, target: Array, guess: Array, random: np.random.Generator) -> _Candidate:
    """The action after which a robot in the state `robot` is nearest to `target` (N, 3)."""
    size, spare = len(guess), robots.count - len(guess) - 1
    base, others = guess, np.clip(guess + 0.2 * random.standard_normal((spare, size)), -1.0, 1.0)
    best = _Candidate(np.inf, guess, robot)
    for _ in range(TRIALS):
        probe = np.where(base > 0.0, -PROBE, PROBE)  # never out of bounds
        trials = np.concatenate([base[None], base + np.diag(probe), others])
        robots.restore(robot)
        robots.step(trials.reshape(robots.count, robots.modules, -1))
        off = (robots.configuration - target).reshape(robots.count, -1)
        each = np.linalg.norm(off.reshape(robots.count, -1, 3), axis=-1)
        error = np.where(robots.alive, each.sum(axis=-1), np.inf)
        error[1 : size + 1] = np.inf
        chosen = int(np.argmin(error))
        if not np.isfinite(error[chosen]):
            raise ModsoftError("every action tried makes the simulated robot diverge; expected a task within its reach")
        gain, stepped = best.error - error[chosen], not np.array_equal(base, best.action)
        if gain > 0.0:
            best = _Candidate(float(error[chosen]), trials[chosen], robots.snapshot([chosen]))
        if best.error < TOLERANCE or (stepped and gain <= LEAST_GAIN * best.error):
            return best
        if chosen > 0:  # a shorter step was better: the next differences are around it
            base, others = best.action, np.repeat(best.action[None], spare, axis=0)
            continue
        slopes = ((off[1 : size + 1] - off[0]) / probe[:, None]).T
        roots = np.sqrt(_weights(each[0]))
        bounds = (-1.0 - base, 1.0 - base)
        step = lsq_linear(roots[:, None] * slopes, -roots * off[0], bounds=bounds, method="bvls").x
        fractions = 0.5 ** np.arange(spare + 1)
        steps = np.clip(base + fractions[:, None] * step, -1.0, 1.0)
        base, others = steps[0], steps[1:]
    return best


def _weights(errors: Array) -> Array:
    """Weights of all components (..., 3), in one row, with which the sum of the squares equals the sum of the errors
    (...) where these are above 0.001."""
    return np.repeat(1.0 / np.maximum(errors.ravel(), 1e-3), 3)


def improved(plant: PlantParameters, modules: int, desired: Array, actions: Array, *, sweeps: int = SWEEPS) -> Array:
    """`actions` (K, N, A) after at most `sweeps` steps towards the smallest sum of all errors."""
    targets = next_reference(desired)
    robots = Fleet(plant, modules, Fleet(plant, modules, 1).lanes)
    error, taken, configuration = _traced(plant, modules, actions, targets)
    for _ in range(sweeps):
        if error < TOLERANCE * desired[..., 0].size:
            break
        slopes = _slopes(plant, modules, actions, taken, configuration)
        off = configuration - targets
        weights = _weights(np.linalg.norm(off, axis=-1))
        weights[-3 * modules :] = 0.0  # the last period's error is not counted
        weighted = slopes.T @ sparse.diags_array(weights)
        flat = actions.ravel()
        step = _bounded_minimum(weighted @ slopes, weighted @ off.ravel(), -1.0 - flat, 1.0 - flat)
        fractions = 0.5 ** np.arange(robots.count)[:, None, None]
        trials = np.clip(actions[:, None] + fractions * step.reshape(actions[:, None].shape), -1.0, 1.0)
        robots.reset()
        reached = rollout(robots, trials).configuration[1:]
        sums = np.linalg.norm(reached - targets[:, None], axis=-1)[:-1].sum(axis=(0, 2))
        best = int(np.nanargmin(sums))
        if not sums[best] < (1.0 - LEAST_GAIN_OF_SWEEP) * error:
            break
        actions = trials[:, best]
        error, taken, configuration = _traced(plant, modules, actions, targets)
    return actions


def _traced(plant: PlantParameters, modules: int, actions: Array, targets: Array) -> tuple[float, Snapshot, Array]:
    """Sum of the errors at the starts of the periods; the states before each action, as a snapshot of K robots; the
    configurations (K, N, 3) after each action."""
    robot = Fleet(plant, modules, 1)
    taken, configuration = [], []
    for action in actions:
        taken.append(robot.snapshot())
        robot.step(action[None])
        configuration.append(robot.configuration[0])
    after = np.stack(configuration)
    error = float(np.linalg.norm(after - targets, axis=-1)[:-1].sum())
    return error, Snapshot(*(np.concatenate(parts) for parts in zip(*taken, strict=True))), after


def _slopes(
    plant: PlantParameters, modules: int, actions: Array, taken: Snapshot, configuration: Array
) -> sparse.csr_array:
    """Derivatives (K * N * 3, K * N * A) of the configurations after each period by all actions."""
    flat = actions.reshape(len(actions), -1)
    periods, size = flat.shape
    robots = Fleet(plant, modules, 8 * Fleet(plant, modules, 1).lanes)
    rows, columns, values = [], [], []
    for start in range(0, flat.size, robots.count):
        moved = np.minimum(np.arange(start, start + robots.count), flat.size - 1)
        real = np.arange(start, start + robots.count) < flat.size
        period, action = np.divmod(moved, size)
        probe = np.where(flat[period, action] > 0.0, -PROBE, PROBE)
        robots.restore(Snapshot(taken.state[period], taken.drive[period]))
        for later in range(HORIZON):
            now = np.minimum(period + later, periods - 1)
            applied = flat[now]
            if later == 0:
                applied[np.arange(robots.count), action] += probe
            robots.step(applied.reshape(robots.count, modules, -1))
            slope = (robots.configuration - configuration[now]).reshape(robots.count, -1) / probe[:, None]
            counts = real & (period + later < periods)
            width = slope.shape[1]
            rows.append((now[counts, None] * width + np.arange(width)).ravel())
            columns.append(np.repeat(moved[counts], width))
            values.append(slope[counts].ravel())
    places = (np.concatenate(rows), np.concatenate(columns))
    return sparse.csr_array((np.concatenate(values), places), shape=(configuration.size, flat.size))


def _bounded_minimum(curvature: sparse.csr_array, gradient: Array, lower: Array, upper: Array) -> Array:
    """The minimum x of x' curvature x / 2 + gradient' x between the bounds, by projected Newton steps on the variables
    that are not at a bound (Bertsekas, SIAM J. Control Optim. 20, 1982)."""
    matrix = sparse.csr_array(curvature + 1e-6 * sparse.eye_array(len(gradient)))

    def value(x: Array) -> float:
        return float(0.5 * x @ (matrix @ x) + gradient @ x)

    x = np.zeros_like(gradient)
    for _ in range(50):
        slope = matrix @ x + gradient
        free = np.flatnonzero(~((x <= lower) & (slope > 0.0) | (x >= upper) & (slope < 0.0)))
        if not len(free) or np.abs(slope[free]).max() < 1e-8:
            break
        newton = np.zeros_like(x)
        newton[free] = spsolve(matrix[free][:, free].tocsc(), -slope[free])
        trials = [np.clip(x + fraction * newton, lower, upper) for fraction in 0.5 ** np.arange(12)]
        best = min(trials, key=value)
        if not value(best) < value(x):
            break
        x = best
    return x
