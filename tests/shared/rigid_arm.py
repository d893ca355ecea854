"""A simulated robot without dynamics, for tests of what surrounds it."""

import numpy as np

from modsoft.runtime.control.features import from_directors


class RigidArm:
    """An arm whose chambers are at their set-points at once and whose modules bend by the difference, 1 rad a bar."""

    def __init__(self, modules):
        self.pressures = np.zeros((modules, 2))
        self.time_s = 0.0

    def set_pressures(self, bar):
        self.pressures = np.array(bar)

    def advance(self, duration_s):
        self.time_s += duration_s

    @property
    def directors(self):
        angle = np.cumsum(self.pressures[:, 0] - self.pressures[:, 1])
        zero, one = np.zeros_like(angle), np.ones_like(angle)
        rows = [
            np.stack([np.cos(angle), zero, -np.sin(angle)], -1),
            np.stack([zero, one, zero], -1),
            np.stack([np.sin(angle), zero, np.cos(angle)], -1),
        ]
        return np.stack(rows, axis=1)

    @property
    def configuration(self):
        return from_directors(self.directors)

    @property
    def positions(self):
        return np.cumsum(self.directors[:, 2] * 0.05, axis=0)
