"""One pneumatic robot of the compiled fleet with the interface of `elastica.Arm`, for the stepped rig."""

from __future__ import annotations

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.errors import ModsoftError
from modsoft.training.simulation.fleet import _FORCE, _GOAL, Fleet
from modsoft.training.simulation.parameters import PASCAL_PER_BAR, PlantParameters


class FleetArm:
    """Starts at rest at activation 0. Its motion is that of PyElastica up to rounding, in a twentieth of the time."""

    def __init__(self, parameters: PlantParameters, modules: int) -> None:
        self._fleet = Fleet(parameters, modules, 1, "explicit")
        self._newton_per_bar = -PASCAL_PER_BAR * self._fleet.section_m2
        self._remainder_s = 0.0

    @property
    def configuration(self) -> Array:
        """(N, 3)"""
        return self._fleet.configuration[0]

    @property
    def positions(self) -> Array:
        """Module ends (N, 3), m."""
        return self._fleet.positions[0]

    @property
    def directors(self) -> Array:
        """(N, 3, 3), rows d1, d2, d3 in the lab frame."""
        return self._fleet.directors[0]

    @property
    def pressures(self) -> Array:
        """Pressures in the chambers (N, n), bar, after the lags of valve and chamber."""
        return self._fleet.drive[0, :, :, _FORCE, 0] / self._newton_per_bar

    def set_pressures(self, bar: Array) -> None:
        """Set-points of the chambers (N, n), bar, until the next call."""
        self._fleet.drive[0, :, :, _GOAL] = self._newton_per_bar * np.asarray(bar)[..., None]

    def advance(self, duration_s: float) -> None:
        """Advances in whole time steps; the remainder is added to the next call. Raises `ModsoftError` when the
        simulation diverges."""
        step_s = self._fleet.time_step_s
        self._remainder_s += duration_s
        steps = round(self._remainder_s / step_s)
        self._remainder_s -= steps * step_s
        self._fleet.advance(steps * step_s)
        if not self._fleet.alive[0]:
            raise ModsoftError("the simulated robot is no longer finite; expected a bounded motion")

    def reset(self) -> None:
        """Sets the state to rest, exactly as after construction."""
        self._fleet.reset()
        self._remainder_s = 0.0
