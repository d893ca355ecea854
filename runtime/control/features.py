"""Module configurations from poses, and the feature layout of the network (`Window`: history, S_d, label of eq. 1).

A configuration is the unit tangent d3 at a module's end, in the frame of the previous module's end (module 1: of the
base), as [v_x, v_y, v_z]. The state of the network consists of the components that `MOTIONS` lists: of a planar module
its unit vector in the plane (section 3.1: R^2).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.errors import ModelError
from modsoft.runtime.layout import MOTIONS

COMPONENTS = ("v_x", "v_y", "v_z")
REST_LIMIT_DEG = 60.0  # largest bending angle of a module at rest
# Largest angle between a planar module and its plane. Two tools that are tilted by 10 degrees each, one of them turned
# by 10 degrees about its axis as well, show 30 degrees at most.
OUT_OF_PLANE_LIMIT_DEG = 35.0
_STATE_INDEX = {name: [COMPONENTS.index(component) for component in each.state] for name, each in MOTIONS.items()}


def from_directors(directors: Array, base: Array | None = None) -> Array:
    """Configurations (..., N, 3) from directors of the module ends (..., N, 3, 3), rows d1, d2, d3 in a common frame.
    base (3, 3): directors of the base, by default the common frame."""
    directors = np.asarray(directors, dtype=np.float64)
    first = np.broadcast_to(np.eye(3) if base is None else base, directors[..., :1, :, :].shape)
    before = np.concatenate([first, directors[..., :-1, :, :]], axis=-3)
    return _in_frame(before, directors[..., 2, :])


def _in_frame(frames: Array, vectors: Array) -> Array:
    """Components of vectors (..., 3) along the axes of frames (..., 3, 3), whose rows are the axes."""
    vectors = vectors[..., None, :]
    # Written out, because rounding in numpy's dot product depends on the number of robots.
    return frames[..., 0] * vectors[..., 0] + frames[..., 1] * vectors[..., 1] + frames[..., 2] * vectors[..., 2]


def from_poses(poses: Array) -> Array:
    """Configurations (N, 3) from tracker poses (N + 1, 4, 4), base first: axes of each tool (columns) and its position
    in the tracker's frame."""
    directors = np.asarray(poses, dtype=np.float64)[:, :3, :3].transpose(0, 2, 1)
    return _in_frame(directors[:-1], directors[1:, 2])


def bending_angle_deg(configuration: Array) -> Array:
    """Bending angle (...), degrees, of planar configurations (..., 3): atan2(v_x, v_z)."""
    configuration = np.asarray(configuration)
    return np.degrees(np.arctan2(configuration[..., 0], configuration[..., 2]))


def bending_error_deg(configuration: Array, desired: Array) -> Array:
    """Difference (...), 0 to 180 degrees, between the bending angles of two planar configurations (..., 3)."""
    difference = bending_angle_deg(configuration) - bending_angle_deg(desired)
    return np.abs((difference + 180.0) % 360.0 - 180.0)


def angle_between_deg(one: Array, other: Array) -> Array:
    """Angle (...), degrees, between unit vectors (..., 3); accurate for small angles."""
    (x, y, z), (u, v, w) = (np.moveaxis(np.asarray(vectors), -1, 0) for vectors in (one, other))
    cross_x, cross_y, cross_z = y * w - z * v, z * u - x * w, x * v - y * u  # three times as fast as np.cross
    sine = np.sqrt(cross_x * cross_x + cross_y * cross_y + cross_z * cross_z)
    return np.degrees(np.arctan2(sine, x * u + y * v + z * w))


def angle_deg(configuration: Array, motion: str) -> Array:
    """Angle (...), degrees, between a module's end and its start: the bending angle of a planar module, signed; of a
    module in space 0 or more."""
    if motion == "planar":
        return bending_angle_deg(configuration)
    return angle_between_deg(configuration, np.array([0.0, 0.0, 1.0]))


def error_deg(configuration: Array, desired: Array, motion: str) -> Array:
    """Control error (...), 0 to 180 degrees: of the bending angles of planar modules, of the directions in space."""
    return (bending_error_deg if motion == "planar" else angle_between_deg)(configuration, desired)


def from_angles_deg(angles: Array) -> Array:
    """Planar configurations (..., 3) from bending angles (...), degrees: the inverse of `bending_angle_deg`."""
    radians = np.radians(angles)
    return np.stack([np.sin(radians), np.zeros_like(radians), np.cos(radians)], axis=-1)


def state_of(configuration: Array, motion: str) -> Array:
    """State (..., S) of the network, for "planar" or "spatial" motion, from configurations (..., 3). A planar one is
    projected on the plane and normalised; its configuration must be within `OUT_OF_PLANE_LIMIT_DEG`."""
    state = np.asarray(configuration)[..., _STATE_INDEX[motion]]
    return state / np.linalg.norm(state, axis=-1, keepdims=True) if motion == "planar" else state


def out_of_plane_deg(configuration: Array) -> Array:
    """Angle (...), degrees, between configurations (..., 3) and the x-z plane."""
    x, y, z = np.moveaxis(np.asarray(configuration), -1, 0)
    return np.degrees(np.arctan2(np.abs(y), np.hypot(x, z)))


def labels(modules: int) -> Array:
    """Module labels (N,), eq. (1): n_i = 2 (i - 1) / (N - 1) - 1, from -1 at the base to +1 at the tip. ValueError for
    fewer than two modules."""
    if modules < 2:
        raise ValueError(f"found {modules} modules, expected at least 2: eq. (1) divides by N - 1")
    return 2.0 * np.arange(modules) / (modules - 1) - 1.0


def feature_names(motion: str, history: int) -> list[str]:
    """Names of the F = T (S + A) + 1 features of a module at control step t, in order; history: time steps T."""
    names = []
    for slot in range(history):
        state, action = slot - history + 2, slot - history
        at = "desired" if slot == history - 1 else f"t{state:+d}" if state else "t"
        names += [f"{name}[{at}]" for name in MOTIONS[motion].state]
        names += [f"{name}[t{action:+d}]" for name in MOTIONS[motion].action]
    return [*names, "label"]


def features(states: Array, actions: Array) -> Array:
    """The features (..., N, F) of one control step t.

    states (..., T, N, S): steps t - T + 2 to t, then the desired state (in training: the state reached);
    actions (..., T, N, A): steps t - T to t - 1.
    """
    slots = np.moveaxis(np.concatenate([states, actions], axis=-1), -3, -2)  # (..., N, T, S + A)
    flat = slots.reshape(*slots.shape[:-2], -1)
    label = np.broadcast_to(labels(flat.shape[-2])[:, None], (*flat.shape[:-1], 1))
    return np.concatenate([flat, label], axis=-1)


def check_planar_state(names: Sequence[str], motion: str, where: object) -> None:
    """Refuses the feature names of a planar model of releases 0.1, whose state was (v_x, v_y), with `ModelError`."""
    if motion == "planar" and any(name.startswith("v_y[") for name in names):
        raise ModelError(
            f"{where}: found the planar state (v_x, v_y) of release 0.1, expected (v_x, v_z); collect data, train and "
            "export again"
        )


class Window:
    """Feature window of the control loop: T - 1 measured states and T applied actions."""

    def __init__(self, history: int, state: Array, action_size: int):
        """Fills the history with `state` (N, S), the state at rest, and zero actions."""
        state = np.asarray(state, dtype=np.float64)
        modules, size = state.shape
        self._rows = features(np.stack([state] * history), np.zeros((history, modules, action_size)))
        slots = self._rows[:, :-1].reshape(modules, history, size + action_size)  # a view of the rows
        self._measured = slots[:, :-1, :size]
        self._actions = slots[:, :, size:]
        self._desired = slice((history - 1) * (size + action_size), history * size + (history - 1) * action_size)

    def observe(self, state: Array) -> None:
        """Appends the state (N, S) measured at the start of this control step."""
        if self._measured.shape[1]:
            self._measured[:, :-1] = self._measured[:, 1:]
            self._measured[:, -1] = state

    def features(self, desired: Array) -> Array:
        """Features (N, F) of this step for the desired state (N, S)."""
        rows = self._rows.copy()
        rows[:, self._desired] = desired
        return rows

    def applied(self, action: Array) -> None:
        """Appends the action (N, A) applied in this step, after all limits."""
        self._actions[:, :-1] = self._actions[:, 1:]
        self._actions[:, -1] = action


def episode_features(states: Array, actions: Array, history: int) -> Array:
    """Features (K, N, F) of all steps of an episode that starts at rest, from states (K + 1, N, S) and actions
    (K, N, A). The action of step t is the target of row t. Equal to a `Window` that is updated in each step."""
    steps = len(actions)
    states = np.concatenate([np.repeat(states[:1], history - 2, axis=0), states]) if history > 2 else states
    actions = np.concatenate([np.zeros((history, *actions.shape[1:])), actions[:-1]])
    index = np.arange(steps)[:, None] + np.arange(history)
    first = 1 if history == 1 else 0
    return features(states[index + first], actions[index])
