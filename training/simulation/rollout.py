"""What a controller is worth: simulated robots in closed loop, and their distance from what was desired."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from modsoft.runtime.control.controller import Controller
from modsoft.runtime.control.correction import Correction, NoCorrection
from modsoft.runtime.control.features import bending_error_deg
from modsoft.runtime.control.tasks import next_reference
from modsoft.runtime.robot import Robot
from modsoft.training.checkpoint import network_of
from modsoft.training.simulation.fleet import Arms, Fleet

Array = NDArray[np.float64]
Actuate = Callable[[Array], Array]
Measure = Callable[[int, Array], Array | None]


def exactly(step: int, configuration: Array) -> Array | None:
    """A tracker without fault."""
    return configuration


@dataclass
class ControllerSetup:
    """Who drives one robot of a fleet through one task.

    actuate: features (N, F) -> actuation (N, A); desired (K, N, 3): configurations at the start of each period.
    measure: (step, true configuration (N, 3)) -> what the tracker says, or None for a lost frame, on which the runtime
    holds the action and remembers the state before.
    """

    actuate: Actuate
    history: int
    desired: Array
    correction: Correction = field(default_factory=NoCorrection)
    measure: Measure = exactly


class Rollout(NamedTuple):
    """What one robot did: at the start of every period and after the last, and the actions that were applied."""

    configuration: Array  # (K + 1, N, 3)
    actions: Array  # (K, N, A)
    positions: Array  # (K + 1, N, 3), m, of the module ends
    directors: Array  # (K + 1, N, 3, 3), rows d1, d2, d3 in the lab frame


def rollout(robot: Robot, robots: Fleet | Arms, pilots: Sequence[ControllerSetup]) -> list[Rollout]:
    """Drives `robots`, at rest, each by its own pilot as the runtime would (`modsoft.runtime.loop`): at step k the
    network is asked for desired[k + 1], the state at the end of the period. All tasks have the same length K."""
    steps = len(pilots[0].desired)
    if len(pilots) != robots.count or any(len(pilot.desired) != steps for pilot in pilots):
        raise ValueError(f"{len(pilots)} pilots for {robots.count} robots; expected one each, of tasks of one length")
    actions = np.zeros((steps, len(pilots), robot.modules, robot.action_size))
    states = [(robots.configuration, robots.positions, robots.directors)]
    controllers = [
        Controller(robot, pilot, rest, pilot.correction) for pilot, rest in zip(pilots, states[0][0], strict=True)
    ]
    targets = [next_reference(pilot.desired) for pilot in pilots]
    for k in range(steps):
        for b, (pilot, controller) in enumerate(zip(pilots, controllers, strict=True)):
            measured = pilot.measure(k, states[-1][0][b])
            actions[k, b] = controller.compute(measured, pilot.desired[k], targets[b][k])
            controller.record(actions[k, b])
        robots.step(actions[k], robot.loop.period_s)
        states.append((robots.configuration, robots.positions, robots.directors))
    configuration, positions, directors = (np.stack(values, axis=1) for values in zip(*states, strict=True))
    return [Rollout(configuration[b], actions[:, b], positions[b], directors[b]) for b in range(len(pilots))]


def actuate_with(checkpoint: dict[str, Any]) -> Actuate:
    """The checkpoint's network as a controller: features (N, F) -> actuation (N, A)."""
    network = network_of(checkpoint)

    def actuate(features: Array) -> Array:
        with torch.no_grad():
            return network(torch.from_numpy(features.astype(np.float32))[None])[0].double().numpy()

    return actuate


def angle_errors_deg(configuration: Array, desired: Array) -> Array:
    """|bending angle - desired bending angle| (K, N), degrees, of a planar robot: configuration (K + 1, N, 3) at the
    start of period k against the desired one of step k, as the paper counts it."""
    return bending_error_deg(configuration[: len(desired)], desired)


def configuration_errors_percent(configuration: Array, desired: Array) -> Array:
    """|configuration - desired| (K, N), percent of the unit vector's length, at the same steps."""
    return 100.0 * np.linalg.norm(configuration[: len(desired)] - desired, axis=-1)
