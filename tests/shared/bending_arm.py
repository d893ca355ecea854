"""A simulated arm in closed form, for tests: chambers in any directions, fast, and as stiff as a real one."""

import math

import numpy as np

from modsoft.runtime.control.features import from_directors

DEG_PER_BAR = (14.5, 82.0, 200.0)  # of each module, base first, as those of pneumatic-3 at 0.19 bar
MODULE_M = 0.085


class BendingArm:
    """Each module bends away from its chambers in proportion to the sum of their pressures, with the time constant
    `lag_s`; a share `coupling` of its bend appears in the modules beside it, in the opposite direction."""

    def __init__(self, modules, directions_deg=(180.0, 0.0), lag_s=0.09, coupling=0.05, deg_per_bar=DEG_PER_BAR):
        angles = np.radians(directions_deg)
        self._away = -np.round(np.stack([np.cos(angles), np.sin(angles)], -1), 15)
        self._deg_per_bar = np.array([*deg_per_bar, *[deg_per_bar[-1]] * modules])[:modules]
        self._lag_s, self._coupling = lag_s, coupling
        self.set_bar = np.zeros((modules, len(directions_deg)))
        self.pressures = self.set_bar.copy()
        self.advance(0.0)

    def set_pressures(self, bar):
        self.set_bar = np.array(bar)

    def advance(self, duration_s):
        left = np.exp(-duration_s / self._lag_s) if self._lag_s else 0.0
        self.pressures = self.set_bar + (self.pressures - self.set_bar) * left
        self.directors = self._directors()  # (N, 3, 3), rows d1, d2, d3

    def _directors(self):
        bends = np.radians(self._deg_per_bar)[:, None] * (self.pressures @ self._away)  # (N, 2)
        beside = np.zeros_like(bends)
        beside[1:] += bends[:-1]
        beside[:-1] += bends[1:]
        frames, frame = [], np.eye(3)
        for x, y in bends - self._coupling * beside:
            frame = rotation(np.array([-y, x, 0.0])).T @ frame
            frames.append(frame)
        return np.array(frames)

    @property
    def configuration(self):
        return from_directors(self.directors)

    @property
    def positions(self):
        axes = np.concatenate([[[0.0, 0.0, 1.0]], self.directors[:, 2]])
        middles = axes[:-1] + axes[1:]
        return np.cumsum(MODULE_M * middles / np.linalg.norm(middles, axis=-1, keepdims=True), axis=0)


def rotation(vector):
    """Rotation matrix (3, 3) of a rotation vector, rad."""
    x, y, z = vector
    angle = math.sqrt(x * x + y * y + z * z)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    first, second = (math.sin(angle) / angle, (1 - math.cos(angle)) / angle**2) if angle else (1.0, 0.5)
    return np.eye(3) + first * cross + second * (cross @ cross)
