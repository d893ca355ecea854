"""Poses to module configurations, and `Window`: the one feature layout of the network (eq. 1, S_d and history).

A configuration is the unit tangent d3 of a module's end in the frame of the end of the module before it (module 1:
the base), stored [v_x, v_y, v_z]. The network's state is the part of it that the robot's kind names, in that order.
"""

from __future__ import annotations

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.robot import KINDS

COMPONENTS = ("v_x", "v_y", "v_z")
REST_LIMIT_DEG = 60.0  # a module that is bent further does not hang at rest
_STATE_INDEX = {name: [COMPONENTS.index(component) for component in kind.state] for name, kind in KINDS.items()}


def from_directors(directors: Array, base: Array | None = None) -> Array:
    """Directors of the module ends, (..., N, 3, 3) with rows d1, d2, d3 in one common frame, to configurations
    (..., N, 3). `base` (3, 3) is the base's frame, rows likewise; the common frame itself by default."""
    directors = np.asarray(directors, dtype=np.float64)
    first = np.broadcast_to(np.eye(3) if base is None else base, directors[..., :1, :, :].shape)
    before = np.concatenate([first, directors[..., :-1, :, :]], axis=-3)
    return _in_frame(before, directors[..., 2, :])


def _in_frame(frames: Array, vectors: Array) -> Array:
    """Components of vectors (..., 3) along the axes of frames (..., 3, 3), one axis a row."""
    vectors = vectors[..., None, :]
    # Term by term: a dot product of numpy's may round differently for another number of robots.
    return frames[..., 0] * vectors[..., 0] + frames[..., 1] * vectors[..., 1] + frames[..., 2] * vectors[..., 2]


def from_poses(poses: Array) -> Array:
    """Tracker poses (N + 1, 4, 4), base first, each a tool's axes (columns) and position in the tracker's frame, to
    configurations (N, 3)."""
    directors = np.asarray(poses, dtype=np.float64)[:, :3, :3].transpose(0, 2, 1)
    return _in_frame(directors[:-1], directors[1:, 2])


def bending_angle_deg(configuration: Array) -> Array:
    """Angle of a planar module (..., 3) in its plane of motion, degrees: atan2(v_x, v_z)."""
    configuration = np.asarray(configuration)
    return np.degrees(np.arctan2(configuration[..., 0], configuration[..., 2]))


def bending_error_deg(configuration: Array, desired: Array) -> Array:
    """Distance (...), 0 to 180 degrees, between the bending angles of two planar configurations (..., 3)."""
    off = bending_angle_deg(configuration) - bending_angle_deg(desired)
    return np.abs((off + 180.0) % 360.0 - 180.0)


def angle_between_deg(one: Array, other: Array) -> Array:
    """Angle (...) between unit vectors (..., 3), degrees, exact for small angles too."""
    (x, y, z), (u, v, w) = (np.moveaxis(np.asarray(vectors), -1, 0) for vectors in (one, other))
    across_x, across_y, across_z = y * w - z * v, z * u - x * w, x * v - y * u  # np.cross takes three times as long
    across = np.sqrt(across_x * across_x + across_y * across_y + across_z * across_z)
    return np.degrees(np.arctan2(across, x * u + y * v + z * w))


def from_angles_deg(angles: Array) -> Array:
    """The inverse of `bending_angle_deg`: planar configurations (..., 3) of bending angles (...), degrees."""
    radians = np.radians(angles)
    return np.stack([np.sin(radians), np.zeros_like(radians), np.cos(radians)], axis=-1)


def state_of(configuration: Array, kind: str) -> Array:
    """The network's state (..., S) of a kind of robot out of configurations (..., 3)."""
    return np.asarray(configuration)[..., _STATE_INDEX[kind]]


def labels(modules: int) -> Array:
    """Module labels (N,), eq. (1): n_i = 2 (i - 1) / (N - 1) - 1, from -1 at the base to +1 at the tip."""
    if modules < 2:
        raise ValueError(f"eq. (1) gives no label to a robot of {modules} module; at least 2")
    return 2.0 * np.arange(modules) / (modules - 1) - 1.0


def feature_names(kind: str, history: int) -> list[str]:
    """The F = T (S + A) + 1 features of a module at control step t, in order. T = `history` time steps."""
    names = []
    for slot in range(history):
        state, action = slot - history + 2, slot - history
        at = "desired" if slot == history - 1 else f"t{state:+d}" if state else "t"
        names += [f"{name}[{at}]" for name in KINDS[kind].state]
        names += [f"{name}[t{action:+d}]" for name in KINDS[kind].action]
    return [*names, "label"]


def features(states: Array, actions: Array) -> Array:
    """The features (..., N, F) of one control step t.

    states (..., T, N, S): steps t - T + 2 to t, then the desired state (in training: the one really reached);
    actions (..., T, N, A): steps t - T to t - 1.
    """
    slots = np.moveaxis(np.concatenate([states, actions], axis=-1), -3, -2)  # (..., N, T, S + A)
    flat = slots.reshape(*slots.shape[:-2], -1)
    label = np.broadcast_to(labels(flat.shape[-2])[:, None], (*flat.shape[:-1], 1))
    return np.concatenate([flat, label], axis=-1)


class Window:
    """The history that the loop keeps: T - 1 measured states and T applied actions, before a step all at rest."""

    def __init__(self, history: int, state: Array, action_size: int):
        """`state` (N, S): the robot's state at rest, which fills the history together with zero actions."""
        state = np.asarray(state, dtype=np.float64)
        modules, size = state.shape
        self._rows = features(np.stack([state] * history), np.zeros((history, modules, action_size)))
        slots = self._rows[:, :-1].reshape(modules, history, size + action_size)  # a view: what it gets, the rows get
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
        """Appends the action (N, A) that was really sent in this step, after every limit."""
        self._actions[:, :-1] = self._actions[:, 1:]
        self._actions[:, -1] = action


def episode_features(states: Array, actions: Array, history: int) -> Array:
    """The features (K, N, F) of every step of an episode that starts at rest: states (K + 1, N, S), actions
    (K, N, A). Row t has the action of step t as its target. Equal to a `Window` fed step by step (tested)."""
    steps = len(actions)
    states = np.concatenate([np.repeat(states[:1], history - 2, axis=0), states]) if history > 2 else states
    actions = np.concatenate([np.zeros((history, *actions.shape[1:])), actions[:-1]])
    index = np.arange(steps)[:, None] + np.arange(history)
    first = 1 if history == 1 else 0
    return features(states[index + first], actions[index])
