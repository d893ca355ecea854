"""The floor of a task: the smallest error that any sequence of actions is known to leave on the simulated robot.

Found by knowing the robot, in two passes. `greedy` goes through the task once: at every control step Gauss-Newton
within the bounds of the actuation, with finite differences on a fleet that starts where the robot is, finds the action
after which the robot is nearest to what is desired next. `improved` then moves all actions of the sequence at once, by
what each of them does to the configurations of its own period and of the next, which feels a twentieth of it, towards
the smallest sum of the errors themselves, not of their squares. What is found is an upper bound of the true floor.
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
from modsoft.runtime.robot import KINDS
from modsoft.training.simulation.fleet import Fleet, Snapshot
from modsoft.training.simulation.rollout import configuration_errors_percent, rollout

PROBE = 1e-4  # of actuation, for finite differences
CLOSE = 1e-5  # of the unit vector: nearer than this, no trial is worth it
ENOUGH = 1e-3  # of the error: a smaller gain of a step ends the search in a control step
ENOUGH_OF_ALL = 1e-2  # likewise of a sweep over all actions
TRIALS = 10  # Gauss-Newton steps in a control step
HORIZON = 2  # periods that an action is felt for
SWEEPS = 5


class OracleResult(NamedTuple):
    """actions (K, N, A) and the errors (K, N) that they leave, percent of the unit vector, of the configuration at the
    start of each period, as the paper counts them."""

    actions: Array
    errors: Array


class _Found(NamedTuple):
    error: float  # summed over the modules, of the unit vector
    action: Array  # (N * A,)
    robot: Snapshot  # after it


def oracle_error(kind: str, modules: int, desired: Array, *, seed: int = 0) -> OracleResult:
    """The best actions found for `desired` (K, N, 3), the configurations at the start of each period, from rest.

    seed: of the guesses that Gauss-Newton's first one competes with. `ModsoftError` if no action keeps the robot whole.
    """
    actions = improved(kind, modules, desired, greedy(kind, modules, desired, seed=seed))
    reached = rollout(Fleet(kind, modules, 1), actions[:, None]).configuration[:, 0]
    return OracleResult(actions, configuration_errors_percent(reached, desired))


def greedy(kind: str, modules: int, desired: Array, *, seed: int = 0) -> Array:
    """Actions (K, N, A), each the best for the end of its own period, whatever it means for later ones."""
    lanes, size = Fleet(kind, modules, 1).lanes, modules * len(KINDS[kind].action)
    # The robot, one for each finite difference, and some more: a part of a block costs as much as a whole one.
    robots = Fleet(kind, modules, -(-(size + 3) // lanes) * lanes)
    random = np.random.default_rng(seed)
    robot, guess = robots.snapshot([0]), np.zeros(size)
    actions: list[Array] = []
    for target in next_reference(desired):
        found = _nearest(robots, robot, target, guess, random)
        before = actions[-1] if actions else found.action
        robot, guess = found.robot, np.clip(2.0 * found.action - before, -1.0, 1.0)
        actions.append(found.action)
    return np.stack(actions).reshape(len(desired), modules, -1)


def _nearest(robots: Fleet, robot: Snapshot, target: Array, guess: Array, random: np.random.Generator) -> _Found:
    """The action after which a robot is nearest to `target` (N, 3)."""
    size, spare = len(guess), robots.count - len(guess) - 1
    base, others = guess, np.clip(guess + 0.2 * random.standard_normal((spare, size)), -1.0, 1.0)
    best = _Found(np.inf, guess, robot)
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
            best = _Found(float(error[chosen]), trials[chosen], robots.snapshot([chosen]))
        if best.error < CLOSE or (stepped and gain <= ENOUGH * best.error):
            return best
        if chosen > 0:  # a shorter step was better: its differences first
            base, others = best.action, np.repeat(best.action[None], spare, axis=0)
            continue
        slopes = ((off[1 : size + 1] - off[0]) / probe[:, None]).T
        roots = np.sqrt(_weights(each[0]))
        bounds = (-1.0 - base, 1.0 - base)
        step = lsq_linear(roots[:, None] * slopes, -roots * off[0], bounds=bounds, method="bvls").x
        shares = 0.5 ** np.arange(spare + 1)
        steps = np.clip(base + shares[:, None] * step, -1.0, 1.0)
        base, others = steps[0], steps[1:]
    return best


def _weights(errors: Array) -> Array:
    """Of every component (..., 3) in one row: with them the sum of the squares is that of the errors (...) themselves,
    where these are above 0.001."""
    return np.repeat(1.0 / np.maximum(errors.ravel(), 1e-3), 3)


def improved(kind: str, modules: int, desired: Array, actions: Array, *, sweeps: int = SWEEPS) -> Array:
    """`actions` (K, N, A) moved towards the smallest sum of all errors, for as long as that gains anything."""
    targets = next_reference(desired)
    robots = Fleet(kind, modules, Fleet(kind, modules, 1).lanes)
    error, taken, configuration = _traced(kind, modules, actions, targets)
    for _ in range(sweeps):
        if error < CLOSE * desired[..., 0].size:
            break
        slopes = _slopes(kind, modules, actions, taken, configuration)
        off = configuration - targets
        weights = _weights(np.linalg.norm(off, axis=-1))
        weights[-3 * modules :] = 0.0  # the last period's error is not counted
        weighted = slopes.T @ sparse.diags_array(weights)
        flat = actions.ravel()
        step = _bounded_minimum(weighted @ slopes, weighted @ off.ravel(), -1.0 - flat, 1.0 - flat)
        shares = 0.5 ** np.arange(robots.count)[:, None, None]
        trials = np.clip(actions[:, None] + shares * step.reshape(actions[:, None].shape), -1.0, 1.0)
        robots.reset()
        reached = rollout(robots, trials).configuration[1:]
        sums = np.linalg.norm(reached - targets[:, None], axis=-1)[:-1].sum(axis=(0, 2))
        best = int(np.nanargmin(sums))
        if not sums[best] < (1.0 - ENOUGH_OF_ALL) * error:
            break
        actions = trials[:, best]
        error, taken, configuration = _traced(kind, modules, actions, targets)
    return actions


def _traced(kind: str, modules: int, actions: Array, targets: Array) -> tuple[float, Snapshot, Array]:
    """Sum of the errors that count; the robot before each action, K robots in one snapshot; configurations (K, N, 3)
    after each."""
    robot = Fleet(kind, modules, 1)
    taken, configuration = [], []
    for action in actions:
        taken.append(robot.snapshot())
        robot.step(action[None])
        configuration.append(robot.configuration[0])
    after = np.stack(configuration)
    error = float(np.linalg.norm(after - targets, axis=-1)[:-1].sum())
    return error, Snapshot(*(np.concatenate(parts) for parts in zip(*taken, strict=True))), after


def _slopes(kind: str, modules: int, actions: Array, taken: Snapshot, configuration: Array) -> sparse.csr_array:
    """Derivatives (K * N * 3, K * N * A) of the configurations after each period by all actions."""
    flat = actions.reshape(len(actions), -1)
    periods, size = flat.shape
    robots = Fleet(kind, modules, 8 * Fleet(kind, modules, 1).lanes)
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
    """x between the bounds that makes x' curvature x / 2 + gradient' x small: projected Newton steps, each on the
    variables that no bound holds (Bertsekas, SIAM J. Control Optim. 20, 1982)."""
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
        trials = [np.clip(x + share * newton, lower, upper) for share in 0.5 ** np.arange(12)]
        best = min(trials, key=value)
        if not value(best) < value(x):
            break
        x = best
    return x
