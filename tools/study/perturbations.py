"""Perturbations of the robustness table: tracker noise, lost frames, other stiffness, a payload."""

from __future__ import annotations

from typing import Any

import numpy as np

from modsoft.runtime import robot as robot_file
from modsoft.runtime.arrays import Array
from modsoft.training.simulation.parameters import plant_of
from modsoft.training.simulation.rollout import Measure, exactly

NOISE_DEG = 0.5  # of every tool's orientation about each of its axes, standard deviation
FRAME_LOSS_PROBABILITY = 0.1
STIFFNESS_CHANGE = 0.1  # of each module's stiffness, up or down
LABELS = {
    "none": "none",
    "noise": f"tracker noise, {NOISE_DEG}° about each axis",
    "frame-loss": "one frame in ten lost",
    "stiffness": "stiffness of each module ± 10 %",
    "payload": "payload of one module's weight at the tip",
}


def measurement(perturbation: str, modules: int, seed: int) -> Measure:
    """What the tracker measures of a robot, for one run. The same seed gives the same errors."""
    rng = np.random.default_rng([seed, 1])
    if perturbation == "noise":
        return lambda step, configuration: noisy(configuration, rng)
    if perturbation == "frame-loss":
        return lambda step, configuration: None if rng.uniform() < FRAME_LOSS_PROBABILITY else configuration
    return exactly


def noisy(configuration: Array, rng: np.random.Generator) -> Array:
    """Configurations (N, 3) measured with N + 1 tools whose orientations have noise of `NOISE_DEG` about each axis.

    Module i is measured with two tools, its own and the one before, which it shares with module i - 1. The
    configuration does not contain the twist between the tools; it is taken as zero, which does not change the size of
    the errors. Noise of the positions, 0.25 mm on an optical tracker, has no effect, since the configuration does not
    depend on positions.
    """
    rotations = np.radians(NOISE_DEG) * rng.standard_normal((len(configuration) + 1, 3))
    measured = np.empty_like(configuration)
    for module, direction in enumerate(configuration):
        tangent = _rotated(np.array([0.0, 0.0, 1.0]), rotations[module + 1])
        apparent = direction + (tangent - [0.0, 0.0, 1.0]) @ _frame(direction)
        # A rotation of the frame of reference appears as the opposite rotation.
        measured[module] = _rotated(apparent / np.linalg.norm(apparent), -rotations[module])
    return measured


def _rotated(vector: Array, rotation: Array) -> Array:
    """A vector (3,) rotated by a rotation vector (3,), rad."""
    angle = np.linalg.norm(rotation)
    if angle == 0.0:
        return vector
    axis = rotation / angle
    along = axis * (axis @ vector) * (1.0 - np.cos(angle))
    return vector * np.cos(angle) + np.cross(axis, vector) * np.sin(angle) + along


def _frame(direction: Array) -> Array:
    """Rows e1, e2, e3 of the frame that the shortest rotation takes from e3 to `direction`."""
    across = np.cross([0.0, 0.0, 1.0], direction)
    sine = np.linalg.norm(across)
    rotation = across / max(sine, 1e-12) * np.arctan2(sine, direction[2])
    return np.stack([_rotated(axis, rotation) for axis in np.eye(3)])


def robot_properties(perturbation: str, modules: int, seed: int) -> dict[str, Any]:
    """Further arguments of `Fleet` for the perturbed robot, hashable."""
    if perturbation == "stiffness":
        signs = np.random.default_rng([seed, 2]).choice([-1.0, 1.0], modules)
        return {"stiffness": tuple(1.0 + STIFFNESS_CHANGE * signs)}
    if perturbation == "payload":
        return {"tip_payload_kg": plant_of(robot_file.load("cable-4")).module_kg}
    return {}
