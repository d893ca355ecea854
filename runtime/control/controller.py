"""The control step, once: from the measured configurations to an actuation within every limit. The loop on the robot
and every simulated rollout run this code."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.control.actuation import limited
from modsoft.runtime.control.correction import Correction, NoCorrection
from modsoft.runtime.control.features import Window, state_of
from modsoft.runtime.robot import Robot
from modsoft.runtime.safety import check_actuation


class Policy(Protocol):
    """Features (N, F) of a control step to actuation (N, A), not limited; `history`: time steps T in the features."""

    @property
    def history(self) -> int: ...
    @property
    def actuate(self) -> Callable[[Array], Array]: ...


class Controller:
    """One object a run. It holds the feature window, the last measured state and the actuation in force; in each
    control step `compute` is called once, then `record`."""

    def __init__(self, robot: Robot, policy: Policy, rest: Array, correction: Correction | None = None):
        """rest: configuration (N, 3) at the start, with actuation 0 in force. correction: a new one, or none."""
        self._robot, self._policy = robot, policy
        self._correction = NoCorrection() if correction is None else correction
        self._state = state_of(rest, robot.kind)
        self.window = Window(policy.history, self._state, robot.action_size)
        self.applied = np.zeros((robot.modules, robot.action_size))  # in force
        self.target: Array | None = None  # (N, 3) that the policy was asked for in this step, None where it was not
        self.raw: Array | None = None  # its answer (N, A), before every limit

    def compute(self, measured: Array | None, desired: Array, next_desired: Array) -> Array:
        """The actuation (N, A) for this step, which is not in force before `record`.

        measured: configuration (N, 3) at the start of the step, or None without a valid frame: the actuation in force
        is held. desired, next_desired: desired configurations (N, 3) at the start and at the end of the step. Raises
        `ModelError` for an answer that is not finite or far out of [-1, 1].
        """
        kind = self._robot.kind
        if measured is not None:
            self._state = state_of(measured, kind)
        self.window.observe(self._state)
        if measured is None:
            return self.applied
        self.target = self._correction.shifted(next_desired, desired, measured)
        self.raw = self._policy.actuate(self.window.features(state_of(self.target, kind)))
        check_actuation(self.raw)
        actuation = limited(self.raw, self.applied, self._robot.limits.largest_actuation_step)
        self._correction.record_output(self.raw, actuation)
        return actuation

    def record(self, actuation: Array) -> None:
        """Ends the step with the actuation (N, A) that is in force: the computed one, or the one before where it was
        not sent."""
        self.applied = actuation
        self.window.applied(actuation)
        self.target = self.raw = None

    def skip(self) -> None:
        """A step that passed without a computation: the last state counts again, the actuation is held."""
        self.window.observe(self._state)
        self.window.applied(self.applied)
