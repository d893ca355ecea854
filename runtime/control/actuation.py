"""Actuation of the modules to what drives them: eq. (3), and the chamber pressure that is linear in the activation."""

from __future__ import annotations

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.robot import Robot


def activations(actuation: Array) -> Array:
    """Eq. (3): actuation (..., A) in [-1, 1] to activations (..., 2 A) in [0, 1], max(0, a_j) then max(0, -a_j) for
    each j. Cables: 0, 180, 90, 270 degrees around the section. Chambers: side +, side -."""
    actuation = np.asarray(actuation, dtype=np.float64)
    pairs = np.stack([np.maximum(0.0, actuation), np.maximum(0.0, -actuation)], axis=-1)
    return pairs.reshape(*actuation.shape[:-1], -1)


def limited(actuation: Array, previous: Array, largest_step: float) -> Array:
    """`actuation` (N, A) held to [-1, 1] and to `largest_step` away from what was applied the period before: the same
    bound in the collected data and in the loop (section 2.2)."""
    bounded = np.clip(actuation, np.asarray(previous) - largest_step, np.asarray(previous) + largest_step)
    return np.clip(bounded, -1.0, 1.0)


def pressures_bar(robot: Robot, actuation: Array) -> Array:
    """Chamber pressures (N, 2), bar, sides + and -: p_min_bar at activation 0, p_max_bar at 1."""
    valve = robot.valve
    if valve is None:
        raise ValueError(f"robot {robot.name} has no valves")
    return valve.p_min_bar + (valve.p_max_bar - valve.p_min_bar) * activations(actuation)


def channel_pressures_bar(robot: Robot, actuation: Array, channels: int = 12) -> Array:
    """What the board is sent: pressure set-points (channels,), bar, each chamber on its channel with its gain and
    offset, never outside 0 to p_max_bar; 0 on channels without a chamber."""
    pressures, out = pressures_bar(robot, actuation).tolist(), [0.0] * channels
    largest_bar = robot.valve.p_max_bar if robot.valve else 0.0
    for chamber in robot.chambers:
        pressure = pressures[chamber.module - 1]["+-".index(chamber.side)]
        out[chamber.channel] = min(max(chamber.gain * pressure + chamber.offset_bar, 0.0), largest_bar)
    return np.array(out)
