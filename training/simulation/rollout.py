"""Rollouts: simulated robots under given actions or in closed loop with controllers, and the errors that remain."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from modsoft.runtime.arrays import Array
from modsoft.runtime.control.controller import Controller
from modsoft.runtime.control.correction import Correction, NoCorrection
from modsoft.runtime.control.features import bending_error_deg
from modsoft.runtime.control.tasks import next_reference
from modsoft.runtime.robot import Robot

Actuate = Callable[[Array], Array]
Measure = Callable[[int, Array], Array | None]


class Robots(Protocol):
    """Simulated robots that advance together: `fleet.Fleet`, or `fleet.Arms`."""

    count: int

    @property
    def configuration(self) -> Array: ...
    @property
    def positions(self) -> Array: ...
    @property
    def directors(self) -> Array: ...
    @property
    def alive(self) -> NDArray[np.bool_]: ...
    def step(self, actuation: Array, period_s: float | None = None) -> None: ...


def exactly(step: int, configuration: Array) -> Array | None:
    """A `Measure` without error."""
    return configuration


@dataclass
class ControllerSetup:
    """The controller of one simulated robot, and its task.

    actuate: features (N, F) -> actuation (N, A); desired (K, N, 3): configurations at the start of each period.
    measure: (step, true configuration (N, 3)) -> the measured one, or None for a lost frame. The controller then holds
    the actuation, as on the real robot.
    """

    robot: Robot
    actuate: Actuate
    history: int
    desired: Array
    correction: Correction = field(default_factory=NoCorrection)
    measure: Measure = exactly


class Rollout(NamedTuple):
    """The states of B robots at the start of each of K periods and after the last, and the actions in between.

    A robot that diverges is NaN in all states from the end of that period on; its actions stay finite. The rollout of
    one robot (`robots`) has no axis B.
    """

    configuration: Array  # (K + 1, B, N, 3), [v_x, v_y, v_z]
    actions: Array  # (K, B, N, A)
    positions: Array  # (K + 1, B, N, 3), m, of the module ends
    directors: Array  # (K + 1, B, N, 3, 3), rows d1, d2, d3 in the lab frame

    def robots(self) -> list[Rollout]:
        """The rollout of each robot."""
        return [Rollout(*(values[:, b] for values in self)) for b in range(self.actions.shape[1])]


def rollout(simulator: Robots, source: Array | Sequence[ControllerSetup], *, period_s: float | None = None) -> Rollout:
    """Advances the robots of `simulator` by one control period for each action.

    source: actions (K, B, N, A), or one controller setup for each robot. A controller computes its action as on the
    real robot (`Controller`): at step k its target is desired[k + 1], the state at the end of the period. All tasks
    have the same length K, and the robots start at rest.
    period_s: the simulator's own control period by default; with controllers that of the robot file.
    """
    if isinstance(source, np.ndarray):
        actions, choose = source, lambda step, state: source[step]
    else:
        controllers = _Controllers(simulator, source)
        actions, choose, period_s = controllers.actions, controllers.compute, source[0].robot.loop.period_s
    states = [_state(simulator)]
    for step in range(len(actions)):
        simulator.step(choose(step, states[-1][0]), period_s)
        states.append(_state(simulator))
    configuration, positions, directors = (np.stack(values) for values in zip(*states, strict=True))
    return Rollout(configuration, np.asarray(actions), positions, directors)


def _state(simulator: Robots) -> tuple[Array, Array, Array]:
    state = simulator.configuration, simulator.positions, simulator.directors
    diverged = ~simulator.alive
    for values in state:
        values[diverged] = np.nan  # a divergence in the middle of a rod does not show at the module ends yet
    return state


class _Controllers:
    """One controller for each robot; keeps the actions (K, B, N, A)."""

    def __init__(self, simulator: Robots, setups: Sequence[ControllerSetup]) -> None:
        steps = len(setups[0].desired)
        if len(setups) != simulator.count or any(len(setup.desired) != steps for setup in setups):
            raise ValueError(
                f"found {len(setups)} controller setups for {simulator.count} robots, expected one for each robot, "
                "with tasks of the same length"
            )
        robot = setups[0].robot
        self.actions = np.zeros((steps, len(setups), robot.modules, robot.action_size))
        self._setups = setups
        self._controllers = [
            Controller(setup.robot, setup, rest, setup.correction)
            for setup, rest in zip(setups, simulator.configuration, strict=True)
        ]
        self._targets = [next_reference(setup.desired) for setup in setups]

    def compute(self, step: int, configuration: Array) -> Array:
        """The actions (B, N, A) of a step, for the configurations (B, N, 3) at its start."""
        actions = self.actions[step]
        for b, (setup, controller) in enumerate(zip(self._setups, self._controllers, strict=True)):
            is_alive = bool(np.isfinite(configuration[b]).all())
            measured = setup.measure(step, configuration[b]) if is_alive else None
            actions[b] = controller.compute(measured, setup.desired[step], self._targets[b][step])
            controller.record(actions[b])
        return actions


def angle_errors_deg(configuration: Array, desired: Array) -> Array:
    """|bending angle - desired bending angle| (K, N), degrees, of a planar robot.

    configuration (K + 1, N, 3): the one at the start of period k is compared with desired[k], as in the paper.
    """
    return bending_error_deg(configuration[: len(desired)], desired)


def configuration_errors_percent(configuration: Array, desired: Array) -> Array:
    """|configuration - desired| (K, N), percent of the unit vector's length, at the same steps."""
    return 100.0 * np.linalg.norm(configuration[: len(desired)] - desired, axis=-1)
