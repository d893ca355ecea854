"""Integral control around the network: the accumulated configuration error shifts the reference of the network.

The network is an inverse model of the robot. Where the model is inaccurate, or the robot differs from the one in the
training data, the error changes little from one period to the next. Adding the sum of past errors to the desired
configuration removes it without a change of the network.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.choices import CORRECTIONS
from modsoft.runtime.errors import UsageError

# Fraction of a constant error that is removed in each period. Tuned on random smooth references of four and six
# modules, not on the reported tasks. A larger gain removes more, but from 0.5 some robots of six modules oscillate at
# the edge of their workspace. With 0.5 degrees of noise the error is smaller at 0.3 than at 0.5.
GAIN = 0.4
LARGEST_SHIFT = 0.4  # norm, relative to the unit vectors
ANTI_WINDUP_DECAY = 0.5  # fraction of the sum that is dropped in each period in which a module saturates


class Correction(Protocol):
    """Corrects the reference of the network; one object for each run."""

    def shifted(self, next_desired: Array, desired: Array, measured: Array) -> Array:
        """The shifted reference (N, 3), unit vectors. next_desired, desired: desired configurations (N, 3) at the end
        and at the start of this period; measured: configuration (N, 3) at its start."""
        ...

    def record_output(self, raw: Array, applied: Array) -> None:
        """Takes the network's output `raw` (N, A) and the `applied` actuation (N, A), after all limits."""
        ...


class NoCorrection:
    """Passes the reference on unchanged."""

    def shifted(self, next_desired: Array, desired: Array, measured: Array) -> Array:
        return np.asarray(next_desired)

    def record_output(self, raw: Array, applied: Array) -> None:
        pass


class IntegralCorrection:
    """Integral control of each module's configuration."""

    def __init__(self, modules: int, gain: float = GAIN, largest: float = LARGEST_SHIFT):
        self.gain, self.largest = gain, largest
        self.sum = np.zeros((modules, 3))
        self._saturated = np.zeros(modules, dtype=bool)  # modules whose last output was limited

    def shifted(self, next_desired: Array, desired: Array, measured: Array) -> Array:
        next_desired = np.asarray(next_desired)
        error = np.asarray(desired) - measured
        # Anti-windup at the unit sphere: a component along the reference has no effect, but would have to be removed
        # when the reference turns.
        summed = _tangential(self.sum + self.gain * error, next_desired)
        norm = np.linalg.norm(summed, axis=-1, keepdims=True)
        summed *= np.minimum(1.0, self.largest / np.maximum(norm, 1e-12))
        # Anti-windup at saturation: the sum decays. For references out of reach the network alone has a smaller error
        # (a quarter less at the tip) than with the sum held at its value before saturation.
        grows = np.linalg.norm(summed, axis=-1) > np.linalg.norm(self.sum, axis=-1)
        self.sum = np.where((self._saturated & grows)[:, None], (1.0 - ANTI_WINDUP_DECAY) * self.sum, summed)
        shifted = next_desired + self.sum
        return shifted / np.linalg.norm(shifted, axis=-1, keepdims=True)

    def record_output(self, raw: Array, applied: Array) -> None:
        self._saturated = np.any(raw != applied, axis=-1)


def _tangential(vectors: Array, directions: Array) -> Array:
    """Components of vectors (N, 3) perpendicular to the unit vectors `directions` (N, 3)."""
    return vectors - np.sum(vectors * directions, axis=-1, keepdims=True) * directions


def by_name(name: str, modules: int) -> Correction:
    """A new correction for one run; name: one of `CORRECTIONS`, `UsageError` for any other."""
    match name:
        case "none":
            return NoCorrection()
        case "integral":
            return IntegralCorrection(modules)
    raise UsageError(f"no correction {name!r}; expected {' or '.join(CORRECTIONS)}")
