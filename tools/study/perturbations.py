"""What the paper does not try: a tracker that errs or loses frames, a robot that is not the one it was trained on."""

from __future__ import annotations

from typing import Any

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.training.simulation.parameters import CABLE
from modsoft.training.simulation.rollout import Measure, exactly

NOISE_DEG = 0.5  # of every tool's orientation about each of its axes, standard deviation
LOST_SHARE = 0.1  # of the frames
STIFFNESS_OFF = 0.1  # of each module's stiffness, up or down
WORDS = {
    "none": "nothing",
    "noise": f"tracker noise, {NOISE_DEG}° an axis",
    "lost": "one frame in ten lost",
    "stiffness": "stiffness of each module off by 10 %",
    "payload": "a module's weight at the tip",
}


def measure(disturbance: str, modules: int, seed: int) -> Measure:
    """What the tracker says of a robot; a new one for every run. The same seed gives the same errors."""
    rng = np.random.default_rng([seed, 1])
    if disturbance == "noise":
        return lambda step, configuration: noisy(configuration, rng)
    if disturbance == "lost":
        return lambda step, configuration: None if rng.uniform() < LOST_SHARE else configuration
    return exactly


def noisy(configuration: Array, rng: np.random.Generator) -> Array:
    """Configurations (N, 3) as N + 1 tools tell them whose orientations are off by `NOISE_DEG` about each axis.

    Module i is measured by two tools, its own and the one before, and neighbours share one. The twist between them does
    not show in the configuration; none is assumed, which changes nothing in how large the errors are. Positions are off
    too, by 0.25 mm on an optical tracker, but no configuration is made of them.
    """
    off = np.radians(NOISE_DEG) * rng.standard_normal((len(configuration) + 1, 3))
    measured = np.empty_like(configuration)
    for module, direction in enumerate(configuration):
        own = _turned(np.array([0.0, 0.0, 1.0]), off[module + 1])
        seen = direction + (own - [0.0, 0.0, 1.0]) @ _frame(direction)
        # seen from a frame that is itself turned, everything is turned the other way
        measured[module] = _turned(seen / np.linalg.norm(seen), -off[module])
    return measured


def _turned(vector: Array, rotation: Array) -> Array:
    """A vector (3,) turned by a rotation vector (3,), rad."""
    angle = np.linalg.norm(rotation)
    if angle == 0.0:
        return vector
    axis = rotation / angle
    along = axis * (axis @ vector) * (1.0 - np.cos(angle))
    return vector * np.cos(angle) + np.cross(axis, vector) * np.sin(angle) + along


def _frame(direction: Array) -> Array:
    """Rows e1, e2, e3 of the frame that the shortest turn takes e3 to `direction` in."""
    across = np.cross([0.0, 0.0, 1.0], direction)
    sine = np.linalg.norm(across)
    rotation = across / max(sine, 1e-12) * np.arctan2(sine, direction[2])
    return np.stack([_turned(axis, rotation) for axis in np.eye(3)])


def plant(disturbance: str, modules: int, seed: int) -> dict[str, Any]:
    """How the robot itself differs: further arguments of `Fleet`, hashable."""
    if disturbance == "stiffness":
        signs = np.random.default_rng([seed, 2]).choice([-1.0, 1.0], modules)
        return {"stiffness": tuple(1.0 + STIFFNESS_OFF * signs)}
    if disturbance == "payload":
        return {"tip_payload_kg": CABLE.module_kg}
    return {}
