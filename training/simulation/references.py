"""Random references of the cable robot: what controllers are tuned and checked on, so that no reported task is needed.

Made of what the tasks are made of (supplement S1 to S4), in random order and at random speed, up to twice the tasks'.
"""

from __future__ import annotations

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.control.tasks import SIMULATED_STEPS

FARTHEST_DEG = 53.2  # v_z 0.6: the farthest that a task asks of a module
WHOLE_DEG = 150.0  # the farthest that the paper's tasks ask of all modules together is 146
SHORTEST_STEPS, LONGEST_STEPS = 25, 90
FASTEST_DEG = 3.6  # of turn about z a step; the tasks' is 1.8


def random_reference(modules: int, *, seed: int, steps: int = SIMULATED_STEPS) -> Array:
    """Desired configurations (steps, N, 3), [v_x, v_y, v_z], of one robot; the same for the same seed.

    Pieces of 25 to 90 steps: spirals (v_z goes to a new value while the module turns about z), arcs (v_z stays) and
    stays (nothing moves). How far a module bends at most is drawn once for each, up to v_z = 0.6; one in three begins
    with a jump from rest. In half of them all modules turn together, each with its own direction towards the
    others, as in the tasks; in the others each turns at its own speed. Corners are rounded over 1 to 15 steps.
    """
    random = np.random.default_rng([seed, modules])
    deepest = 1.0 - np.cos(np.radians(_largest_deg(random, modules)))
    together = random.random() < 0.5
    depth = _depth(random, modules) if random.random() < 1 / 3 else np.zeros(modules)
    azimuth_deg = random.uniform(-180.0, 180.0, modules)
    if together:
        azimuth_deg = azimuth_deg[0] + random.choice([0.0, 180.0], modules)
    depths, azimuths_deg = [depth[None]], [azimuth_deg[None]]
    while sum(map(len, depths)) < steps:
        length = int(random.integers(SHORTEST_STEPS, LONGEST_STEPS + 1))
        kind = random.choice(["spiral", "arc", "stay"], p=[0.5, 0.35, 0.15]) if depth.any() else "spiral"
        after = _depth(random, modules) if kind == "spiral" else depth
        rate_deg = 0.0 if kind == "stay" else random.uniform(-FASTEST_DEG, FASTEST_DEG, 1 if together else modules)
        share = np.arange(1, length + 1)[:, None]
        depths.append(depth + (after - depth) * share / length)
        azimuths_deg.append(azimuth_deg + rate_deg * share)
        depth, azimuth_deg = depths[-1][-1], azimuths_deg[-1][-1]
    window = int(random.integers(1, 16))
    v_z = 1.0 - deepest * _rounded(np.concatenate(depths)[:steps], window)
    azimuth = np.radians(_rounded(np.concatenate(azimuths_deg)[:steps], window))
    side = np.sqrt(1.0 - v_z**2)
    return np.stack([side * np.sin(azimuth), side * np.cos(azimuth), v_z], axis=-1)


def _largest_deg(random: np.random.Generator, modules: int) -> Array:
    """The largest bend of each module; the tip's is always large, as in the tasks."""
    largest = FARTHEST_DEG * random.random(modules)
    largest[-1] = FARTHEST_DEG * random.uniform(0.85, 1.0)
    largest[:-1] *= min(1.0, (WHOLE_DEG - largest[-1]) / largest[:-1].sum())
    return largest


def _depth(random: np.random.Generator, modules: int) -> Array:
    """How deep the modules bend (N,), of 1 - v_z at their largest bend: deep more often than not."""
    return np.sqrt(random.random(modules))


def _rounded(values: Array, window: int) -> Array:
    """Mean over `window` steps ahead; the last value goes on."""
    padded = np.concatenate([values, np.repeat(values[-1:], window - 1, axis=0)])
    return np.lib.stride_tricks.sliding_window_view(padded, window, axis=0).mean(axis=-1)
