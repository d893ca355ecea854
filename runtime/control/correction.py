"""Online correction around the network: the accumulated configuration error shifts what the network is asked for.

The network is an inverse of the robot; where it is a little wrong, or the robot is not the one it was trained on, its
error is nearly the same from one period to the next. With the sum of the errors so far added to the desired
configuration the network stays as it is and the error goes to zero all the same: integral control in the network's own
coordinates.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.choices import CORRECTIONS
from modsoft.runtime.errors import UsageError

# How much of an error that stays the same is taken off in each period. Chosen on random smooth references of four and
# six modules, never on the tasks that are reported: more takes off more, but from 0.5 on some robots of six modules
# swing at the edge of their workspace. With 0.5 degrees of noise 0.3 leaves less than 0.5 does.
GAIN = 0.4
LARGEST_SHIFT = 0.4  # of the unit vector
ANTI_WINDUP_DECAY = 0.5  # of the sum, in each period in which a module cannot do more


class Correction(Protocol):
    """What stands between the task and the network for one run."""

    def shifted(self, ahead: Array, desired: Array, measured: Array) -> Array:
        """What the network is asked for, (N, 3) unit vectors: `ahead` is desired at the end of this period, `desired`
        was at its start, where the robot is `measured`, all (N, 3)."""
        ...

    def record_output(self, raw: Array, applied: Array) -> None:
        """The network's answer `raw` (N, A), and what is applied of it after every limit."""
        ...


class NoCorrection:
    """The network alone."""

    def shifted(self, ahead: Array, desired: Array, measured: Array) -> Array:
        return np.asarray(ahead)

    def record_output(self, raw: Array, applied: Array) -> None:
        pass


class IntegralCorrection:
    """Integral control of each module's configuration; made anew for every run."""

    def __init__(self, modules: int, gain: float = GAIN, largest: float = LARGEST_SHIFT):
        self.gain, self.largest = gain, largest
        self.sum = np.zeros((modules, 3))
        self._held = np.zeros(modules, dtype=bool)  # modules whose last answer did not go out as it was

    def shifted(self, ahead: Array, desired: Array, measured: Array) -> Array:
        ahead = np.asarray(ahead)
        error = np.asarray(desired) - measured
        # Anti-windup at the unit sphere: what points out of it asks for nothing that a module can do, but would have
        # to be undone when the desired configuration turns.
        summed = _across(self.sum + self.gain * error, ahead)
        size = np.linalg.norm(summed, axis=-1, keepdims=True)
        summed *= np.minimum(1.0, self.largest / np.maximum(size, 1e-12))
        # Anti-windup at saturation: a module that cannot do more lets go of its sum. Beyond what can be reached the
        # network alone errs less than with a sum that was held from where it still could: a quarter less at the tip.
        grows = np.linalg.norm(summed, axis=-1) > np.linalg.norm(self.sum, axis=-1)
        self.sum = np.where((self._held & grows)[:, None], (1.0 - ANTI_WINDUP_DECAY) * self.sum, summed)
        shifted = ahead + self.sum
        return shifted / np.linalg.norm(shifted, axis=-1, keepdims=True)

    def record_output(self, raw: Array, applied: Array) -> None:
        self._held = np.any(raw != applied, axis=-1)


def _across(vectors: Array, directions: Array) -> Array:
    """The part of vectors (N, 3) that is at right angles to the unit vectors `directions` (N, 3)."""
    return vectors - np.sum(vectors * directions, axis=-1, keepdims=True) * directions


def by_name(name: str, modules: int) -> Correction:
    """A new correction for one run; name: one of `CORRECTIONS`, `UsageError` for any other."""
    match name:
        case "none":
            return NoCorrection()
        case "integral":
            return IntegralCorrection(modules)
    raise UsageError(f"no correction {name!r}; expected {' or '.join(CORRECTIONS)}")
