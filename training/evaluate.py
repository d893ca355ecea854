"""What a controller is worth: the simulated robot in closed loop, and its distance from what was desired."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from modsoft.runtime.actuation import limited
from modsoft.runtime.configuration import Window, bending_error_deg, state_of
from modsoft.runtime.robot import Robot
from modsoft.training.checkpoint import network_of

Array = NDArray[np.float64]
Actuate = Callable[[Array], Array]


def closed_loop(robot: Robot, arm: Any, actuate: Actuate, history: int, desired: Array) -> tuple[Array, Array]:
    """Drives `arm` (`modsoft.training.arm.Arm`, at rest) along `desired` (K, N, 3) as the runtime would.

    actuate: features (N, F) -> actuation (N, A). At step k it is given desired[k], as the state to be reached at the
    end of the period. Returns configurations (K + 1, N, 3) at the start of every period and after the last, and the
    actions applied (K, N, A).
    """
    kind = robot.robot.kind
    configuration = [arm.configuration]
    actions = np.zeros((len(desired), robot.modules, robot.action_size))
    window = Window(history, state_of(configuration[0], kind), robot.action_size)
    previous = np.zeros_like(actions[0])
    for k, target in enumerate(desired):
        window.observe(state_of(configuration[-1], kind))
        raw = actuate(window.features(state_of(target, kind)))
        previous = actions[k] = limited(raw, previous, robot.limits.largest_actuation_step)
        window.applied(actions[k])
        arm.step(actions[k], robot.loop.period_s)
        configuration.append(arm.configuration)
    return np.stack(configuration), actions


def actuate_with(checkpoint: dict[str, Any]) -> Actuate:
    """The checkpoint's network as a controller: features (N, F) -> actuation (N, A)."""
    network = network_of(checkpoint)

    def actuate(features: Array) -> Array:
        with torch.no_grad():
            return network(torch.from_numpy(features.astype(np.float32))[None])[0].double().numpy()

    return actuate


def angle_errors_deg(configuration: Array, desired: Array) -> Array:
    """|bending angle - desired bending angle| (K, N), degrees, of a planar robot: configuration measured at the start
    of period k against the desired one of step k, as the paper counts it. A controller that reaches every desired
    configuration exactly, one period later, is still charged with what the task moves in a period."""
    return bending_error_deg(configuration[: len(desired)], desired)


def configuration_errors_percent(configuration: Array, desired: Array) -> Array:
    """|configuration - desired| (K, N), percent of the unit vector's length, at the same steps."""
    return 100.0 * np.linalg.norm(configuration[: len(desired)] - desired, axis=-1)
