"""The control step: from measured configurations to an actuation within all limits. The control loop of the robot and
the simulated rollouts share it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.control.actuation import limited, module_actuators
from modsoft.runtime.control.correction import Correction, NoCorrection
from modsoft.runtime.control.features import Window, state_of
from modsoft.runtime.robot import Robot
from modsoft.runtime.safety import check_actuation


class Policy(Protocol):
    """`actuate`: features (N, F) of a control step to actuation (N, A), not limited. `history`: time steps T of the
    features."""

    @property
    def history(self) -> int: ...
    @property
    def actuate(self) -> Callable[[Array], Array]: ...


class Control(Protocol):
    """Decides on the actuations of one run of the loop: `Controller`, or `Sequence`."""

    applied: Array  # (N, A), in force
    target: Array | None  # see `Controller`
    raw: Array | None

    def compute(self, measured: Array | None, desired: Array, next_desired: Array) -> Array: ...
    def preview(self, target: Array) -> Array: ...
    def record(self, actuation: Array) -> None: ...
    def skip(self) -> None: ...


class Controller:
    """The controller of one run: feature window, last measured state, applied actuation. In each control step call
    `compute`, then `record`."""

    def __init__(self, robot: Robot, policy: Policy, rest: Array, correction: Correction | None = None):
        """rest: configuration (N, 3) at the start, where the actuation is 0. correction: a new object, or None."""
        self._robot, self._policy = robot, policy
        self._correction = NoCorrection() if correction is None else correction
        self._state = state_of(rest, robot.motion)
        self.window = Window(policy.history, self._state, robot.action_size)
        self.applied = np.zeros((robot.modules, robot.action_size))
        self.target: Array | None = None  # (N, 3), input of the policy in this step; None without a computation
        self.raw: Array | None = None  # (N, A), output of the policy, before the limits

    def compute(self, measured: Array | None, desired: Array, next_desired: Array) -> Array:
        """Computes the actuation (N, A) of this step; `record` confirms that it was applied.

        measured: configuration (N, 3) at the start of the step, or None without a valid frame, which holds the applied
        actuation. desired, next_desired: desired configurations (N, 3) at the start and at the end of the step. Raises
        `ModelError` if the policy's output is not finite or far outside [-1, 1].
        """
        if measured is not None:
            self._state = state_of(measured, self._robot.motion)
        self.window.observe(self._state)
        if measured is None:
            return self.applied
        self.target = self._correction.shifted(next_desired, desired, measured)
        self.raw = self._output(self.target)
        actuation = self._within_limits(self.raw)
        self._correction.record_output(self.raw, actuation)
        return actuation

    def preview(self, target: Array) -> Array:
        """The actuation (N, A) for a target configuration (N, 3) with the present window. Changes no state. Raises
        `ModelError` as `compute` does."""
        return self._within_limits(self._output(target))

    def record(self, actuation: Array) -> None:
        """Ends the step. actuation (N, A): the computed one, or the previous one if the computed one was not sent."""
        self.applied = actuation
        self.window.applied(actuation)
        self.target = self.raw = None

    def skip(self) -> None:
        """Records a step without a computation: the last state is repeated, the actuation is held."""
        self.window.observe(self._state)
        self.window.applied(self.applied)

    def _output(self, target: Array) -> Array:
        return self._policy.actuate(self.window.features(state_of(target, self._robot.motion)))

    def _within_limits(self, raw: Array) -> Array:
        check_actuation(raw)
        largest_step = self._robot.limits.largest_actuation_step
        return limited(raw, self.applied, largest_step, module_actuators(self._robot.directions))


class Sequence:
    """Actuations that are known before the run, one for each step, as for the collection of data. A step without a
    valid frame holds the applied actuation; the sequence goes on meanwhile."""

    target: Array | None = None
    raw: Array | None = None

    def __init__(self, robot: Robot, actuations: Array):
        """actuations (K, N, A). They are limited as those of a controller."""
        self._robot, self._actuations, self._step = robot, actuations, 0
        self.applied = np.zeros((robot.modules, robot.action_size))

    def compute(self, measured: Array | None, desired: Array, next_desired: Array) -> Array:
        """The actuation (N, A) of this step; see `Controller.compute`. The desired configurations have no effect."""
        if measured is None:
            return self.applied
        largest_step, actuators = self._robot.limits.largest_actuation_step, module_actuators(self._robot.directions)
        return limited(self._actuations[self._step], self.applied, largest_step, actuators)

    def preview(self, target: Array) -> Array:
        """The applied actuation: there is no computation to prepare."""
        return self.applied

    def record(self, actuation: Array) -> None:
        self.applied = actuation
        self._step += 1

    def skip(self) -> None:
        self._step += 1
