"""From the actuation of the modules to activations (eq. 3), chamber pressures and set-points of the valve channels."""

from __future__ import annotations

import functools

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.robot import Robot


def activations(actuation: Array) -> Array:
    """Eq. (3): actuation (..., A) in [-1, 1] to activations (..., 2 A) in [0, 1], max(0, a_j) and max(0, -a_j) for
    each j: opposite pairs of actuators. Cables: at 0, 180, 90, 270 degrees around the section."""
    actuation = np.asarray(actuation, dtype=np.float64)
    pairs = np.stack([np.maximum(0.0, actuation), np.maximum(0.0, -actuation)], axis=-1)
    return pairs.reshape(*actuation.shape[:-1], -1)


class ModuleActuators:
    """Eq. (3) for the n actuators of a module, in any directions.

    An action a is the sum of u_i d_i, with d_i the unit direction in which actuator i bends the module and u_i its
    activation. The activations are those of least norm with u >= 0, over the largest where it is above 1; the applied
    action is a over the same number. Both are continuous, and the same for a module alone and among others.
    """

    def __init__(self, directions: Array):
        """directions (n, A): d_i, which bend the module in every direction; A = 1 in the plane, 2 in space."""
        directions = np.asarray(directions, dtype=np.float64)
        size = directions.shape[1]
        axes = np.eye(size)
        self.opposite_pairs = np.array_equal(directions, np.stack([axes, -axes], axis=1).reshape(-1, size))
        self._maps, self._starts_rad = _cones_of_line(directions) if size == 1 else _cones_of_plane(directions)

    def activations(self, actuation: Array) -> Array:
        """Activations (..., n) in [0, 1] of actions (..., A). For opposite pairs equal to `activations`."""
        required = self._required(actuation)
        return required / _divisor(required)

    def applied(self, actuation: Array) -> Array:
        """Actions (..., A) that the activations of the actions (..., A) produce."""
        return np.asarray(actuation, dtype=np.float64) / _divisor(self._required(actuation))

    def _required(self, actuation: Array) -> Array:
        """Activations (..., n) of least norm, 0 or more, for actions (..., A)."""
        if self.opposite_pairs:
            return activations(actuation)
        actuation = np.asarray(actuation, dtype=np.float64)
        angle_rad = np.arctan2(actuation[..., 1] if actuation.shape[-1] == 2 else 0.0, actuation[..., 0])
        cone = np.searchsorted(self._starts_rad, angle_rad, side="right") - 1  # -1: the last one, across 180 degrees
        # Not a matrix product, because its rounding depends on the number of modules.
        return np.maximum(0.0, np.sum(self._maps[cone] * actuation[..., None, :], axis=-1))


def _divisor(required: Array) -> Array:
    return np.maximum(1.0, required.max(axis=-1, keepdims=True))


def _cones_of_line(directions: Array) -> tuple[Array, Array]:
    """Linear maps (2, n, 1) from an action to its activations, above and below 0, and the angles where they start."""
    maps = [np.where(directions == sign, directions / np.sum(directions == sign), 0.0) for sign in (1.0, -1.0)]
    return np.array(maps), np.array([-np.pi / 2, np.pi / 2])


def _cones_of_plane(directions: Array) -> tuple[Array, Array]:
    """Linear maps (K, n, 2) from an action to its activations in K cones of actions, and the angles (K,), rad and
    ascending, where the cones start.

    The activations of least norm are max(0, d_i . v) for a vector v. The active set changes where v is perpendicular
    to a direction, and is constant in between; there, v and the action are linear functions of each other.
    """
    angles_deg = np.degrees(np.arctan2(directions[:, 1], directions[:, 0]))
    borders_deg = np.unique(np.round(np.concatenate([angles_deg + 90.0, angles_deg - 90.0]) % 360.0, 9) % 360.0)
    cones = []
    for start_deg, end_deg in zip(borders_deg, [*borders_deg[1:], borders_deg[0] + 360.0], strict=True):
        start, middle = (_unit_vector(angle) for angle in (start_deg, (start_deg + end_deg) / 2))
        active = directions @ middle > 0.0
        chosen = np.where(active[:, None], directions, 0.0)
        gram = chosen.T @ chosen
        if np.linalg.cond(gram) > 1e12:  # one active actuator: its actions are the border of the next cones
            continue
        x, y = gram @ start
        cones.append((np.arctan2(y, x), chosen @ np.linalg.inv(gram)))
    cones.sort(key=lambda cone: cone[0])
    return np.array([linear for _, linear in cones]), np.array([start_rad for start_rad, _ in cones])


def _unit_vector(angle_deg: float) -> Array:
    return np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])


@functools.lru_cache(maxsize=64)
def module_actuators(directions: tuple[tuple[float, ...], ...]) -> ModuleActuators:
    """The actuators of a module with these unit directions, made once."""
    return ModuleActuators(np.array(directions))


def limited(actuation: Array, previous: Array, largest_step: float, actuators: ModuleActuators | None = None) -> Array:
    """Actuation (N, A) limited to [-1, 1], to what the actuators can apply (None: opposite pairs, which can apply
    all), and to `largest_step` from `previous` (N, A), the actuation of the period before. Data collection and control
    use the same limits (section 2.2)."""
    bounded = np.clip(actuation, np.asarray(previous) - largest_step, np.asarray(previous) + largest_step)
    bounded = np.clip(bounded, -1.0, 1.0)
    if actuators is None or actuators.opposite_pairs:
        return bounded
    applied = actuators.applied(bounded)
    if np.array_equal(applied, bounded):
        return bounded
    step = applied - previous  # scaling towards 0 also changes components that were within the step
    excess = np.maximum(1.0, np.abs(step).max(axis=-1, keepdims=True) / largest_step)
    return actuators.applied(np.where(excess > 1.0, previous + step / excess, applied))


def pressures_bar(robot: Robot, actuation: Array) -> Array:
    """Chamber pressures (N, n), bar, in the order of the module's actuators, from p_min_bar at activation 0 to
    p_max_bar at 1. ValueError for a robot without valves."""
    valve = robot.valve
    if valve is None:
        raise ValueError(f"robot {robot.name} has no valves")
    used = module_actuators(robot.directions).activations(actuation)
    return valve.p_min_bar + (valve.p_max_bar - valve.p_min_bar) * used


def channel_pressures_bar(robot: Robot, actuation: Array, channels: int = 12) -> Array:
    """Pressure set-points (channels,), bar, for the board: each chamber on its channel, corrected by its gain and
    offset and limited to 0 to p_max_bar; 0 on channels without a chamber."""
    pressures, set_points = pressures_bar(robot, actuation).tolist(), [0.0] * channels
    largest_bar = robot.valve.p_max_bar if robot.valve else 0.0
    for chamber in robot.chambers:
        pressure = pressures[chamber.module - 1][robot.actuator_of(chamber)]
        set_points[chamber.channel] = min(max(chamber.gain * pressure + chamber.offset_bar, 0.0), largest_bar)
    return np.array(set_points)


def applied_actuation(robot: Robot, channels_bar: Array) -> Array:
    """Actuation (N, A) of the pressures (channels,), bar, that the board commands to the valves: the inverse of
    `channel_pressures_bar`. Below p_min_bar, as of vented chambers, an activation is 0."""
    valve, used = robot.valve, np.zeros((robot.modules, len(robot.directions)))
    if valve is None:
        raise ValueError(f"robot {robot.name} has no valves")
    for chamber in robot.chambers:
        pressure = (channels_bar[chamber.channel] - chamber.offset_bar) / chamber.gain
        used[chamber.module - 1, robot.actuator_of(chamber)] = pressure
    return actuation_of_pressures(robot, used)


def actuation_of_pressures(robot: Robot, pressures: Array) -> Array:
    """Actuation (..., N, A) of chamber pressures (..., N, n), bar: the inverse of `pressures_bar`."""
    assert robot.valve is not None
    share = (np.asarray(pressures) - robot.valve.p_min_bar) / (robot.valve.p_max_bar - robot.valve.p_min_bar)
    return np.clip(np.clip(share, 0.0, 1.0) @ np.array(robot.directions), -1.0, 1.0)
