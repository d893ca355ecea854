"""From the actuation of the modules to activations (eq. 3), chamber pressures and set-points of the valve channels."""

from __future__ import annotations

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.robot import Robot


def activations(actuation: Array) -> Array:
    """Eq. (3): actuation (..., A) in [-1, 1] to activations (..., 2 A) in [0, 1], max(0, a_j) and max(0, -a_j) for
    each j. Cables: at 0, 180, 90, 270 degrees around the section. Chambers: side +, side -."""
    actuation = np.asarray(actuation, dtype=np.float64)
    pairs = np.stack([np.maximum(0.0, actuation), np.maximum(0.0, -actuation)], axis=-1)
    return pairs.reshape(*actuation.shape[:-1], -1)


def limited(actuation: Array, previous: Array, largest_step: float) -> Array:
    """Actuation (N, A) limited to [-1, 1] and to `largest_step` from `previous` (N, A), the actuation of the period
    before. Data collection and control use the same limit (section 2.2)."""
    bounded = np.clip(actuation, np.asarray(previous) - largest_step, np.asarray(previous) + largest_step)
    return np.clip(bounded, -1.0, 1.0)


def pressures_bar(robot: Robot, actuation: Array) -> Array:
    """Chamber pressures (N, 2), bar, sides + and -, from p_min_bar at activation 0 to p_max_bar at 1.
    ValueError for a robot without valves."""
    valve = robot.valve
    if valve is None:
        raise ValueError(f"robot {robot.name} has no valves")
    return valve.p_min_bar + (valve.p_max_bar - valve.p_min_bar) * activations(actuation)


def channel_pressures_bar(robot: Robot, actuation: Array, channels: int = 12) -> Array:
    """Pressure set-points (channels,), bar, for the board: each chamber on its channel, corrected by its gain and
    offset and limited to 0 to p_max_bar; 0 on channels without a chamber."""
    pressures, set_points = pressures_bar(robot, actuation).tolist(), [0.0] * channels
    largest_bar = robot.valve.p_max_bar if robot.valve else 0.0
    for chamber in robot.chambers:
        pressure = pressures[chamber.module - 1]["+-".index(chamber.side)]
        set_points[chamber.channel] = min(max(chamber.gain * pressure + chamber.offset_bar, 0.0), largest_bar)
    return np.array(set_points)
