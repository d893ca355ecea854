"""A run of the control loop on the stepped rig: what the robot did, and what the runtime measured and applied."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from modsoft.hil.stepped import SteppedRig
from modsoft.runtime.arrays import Array
from modsoft.runtime.calibration.use import UsedCalibration
from modsoft.runtime.clock import Ticker
from modsoft.runtime.control.controller import Control
from modsoft.runtime.devices import Devices
from modsoft.runtime.errors import LostInRun
from modsoft.runtime.log_record import Record, TickRecord
from modsoft.runtime.loop import Loop
from modsoft.runtime.statistics import TickStatistics


class Motion(NamedTuple):
    """K control steps of N modules. Configurations are those at the start of each step, and at the end."""

    true_configuration: Array  # (K + 1, N, 3) of the simulated robot
    measured: Array  # (K + 1, N, 3) by the runtime; NaN without a valid frame
    actuation: Array  # (K, N, A) applied


def run(
    rig: SteppedRig,
    control: Callable[[Array], Control],
    desired: Array,
    calibration: UsedCalibration | None = None,
) -> Motion:
    """Arms the board, runs the loop for the steps of `desired` (K, N, 3) and vents. control: see `Loop`; calibration:
    of the tracker's tools.

    Raises what ends the loop earlier, and `LostInRun` where the board does not confirm the venting.
    """
    robot, arm = rig.robot, rig.plant.arm
    true_configuration, ticks = list[Array](), list[TickRecord]()

    def record(line: Record) -> None:
        if isinstance(line, TickRecord):  # on this clock no time has passed since the step began
            ticks.append(line)
            true_configuration.append(np.array(arm.configuration))

    devices = Devices(robot, rig.frames, rig.board, rig.clock, rig.wait, calibration)
    rig.board.arm(robot)
    validator = devices.validator()
    rest = devices.rest(validator, missing=LostInRun)
    ticker = Ticker(robot.loop.period_s, rig.clock, rig.wait)
    statistics = TickStatistics(robot, len(desired))
    Loop(robot, control, desired, rig.frames, validator, rig.board, ticker, devices.stop, record, statistics).run(rest)
    measured = [tick.configuration for tick in ticks]
    measured.append(validator.check(rig.frames.latest(), rig.clock()).configuration)
    unknown = np.full((robot.modules, 3), np.nan)
    motion = Motion(
        np.array([*true_configuration, arm.configuration]),
        np.array([unknown if each is None else each for each in measured]),
        np.array([tick.actuation for tick in ticks]),
    )
    if not rig.board.vent():
        raise LostInRun("the run on the stepped rig is done, but the board did not confirm the venting")
    return motion
