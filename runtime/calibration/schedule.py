"""Set-points that are known before a calibration, one row a control step, and what is measured meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.board.protocol import CHANNELS
from modsoft.runtime.control.features import angle_between_deg
from modsoft.runtime.errors import LostInRun
from modsoft.runtime.robot import Chamber, Robot

PERIOD_S = 0.1  # of a row, for every robot: the board reports its pressures as often
MEAN_ROWS = 9  # of a mean
MARGIN_ROWS = 20  # steps after the last row, for those without a valid frame
LEAST_SAMPLES = 4  # of a mean; missed steps leave rows without a sample


class Sample(NamedTuple):
    """What is measured at the end of a row of the schedule."""

    row: int
    configuration: Array  # (N, 3)
    base: Array  # (4, 4), pose of the base's tool
    applied_bar: Array  # (channels,) set-points that the board reports
    measured_bar: Array  # (channels,), NaN for a channel without a sensor


class Mean(NamedTuple):
    """Means of the samples of some rows; `scatter_deg`: standard deviation of one axis in one sample."""

    configuration: Array
    base: Array
    applied_bar: Array
    measured_bar: Array
    scatter_deg: float


class ScheduledPressures:
    """Control of the loop: row after row of pressures (R, channels), bar. A step without a valid frame holds the
    pressures, so that no valve opens unobserved; zeros before the first row and after the last.

    read: the pose of the base's tool, and the pressures that the board applies and measures. watch: called with every
    sample; its errors end the run.
    """

    target: Array | None = None
    raw: Array | None = None

    def __init__(
        self,
        robot: Robot,
        rows_bar: Array,
        read: Callable[[], tuple[Array, Array, Array]],
        watch: Callable[[Sample], None] = lambda sample: None,
    ):
        self.applied = np.zeros((robot.modules, robot.action_size))  # the valves are set directly
        self.samples: list[Sample] = []
        self.row = -1  # in force
        self._rows_bar, self._read, self._watch = rows_bar, read, watch

    def compute(self, measured: Array | None, desired: Array, next_desired: Array) -> Array:
        """Takes a sample and sets the next row; see `Controller.compute`."""
        if measured is not None:
            if 0 <= self.row < len(self._rows_bar):
                self.samples.append(Sample(self.row, measured, *self._read()))
                self._watch(self.samples[-1])
            self.row += 1
        return self.applied

    def set_points_bar(self, actuation: Array) -> Array:
        """Pressures (channels,), bar, of the row in force."""
        return self._rows_bar[self.row] if 0 <= self.row < len(self._rows_bar) else np.zeros(CHANNELS)

    def preview(self, target: Array) -> Array:
        return self.applied

    def record(self, actuation: Array) -> None:
        """Has no effect: the row is set by `compute`."""

    def skip(self) -> None:
        """Has no effect: the valves hold their pressures."""

    def check_complete(self) -> None:
        """`LostInRun` if the run ended before the last row, because too many steps had no valid frame."""
        if self.row < len(self._rows_bar):
            raise LostInRun(
                f"only {max(self.row, 0)} of {len(self._rows_bar)} steps were measured, the others had no valid frame; "
                "look at the tracker and the markers, then start again"
            )


def mean_of(samples: Sequence[Sample], last_row: int, rows: int = MEAN_ROWS) -> Mean:
    """Mean of the samples of `rows` rows up to `last_row`. `LostInRun` for too few."""
    chosen = [sample for sample in samples if last_row - rows < sample.row <= last_row]
    if len(chosen) < min(LEAST_SAMPLES, rows):
        raise LostInRun(
            f"{len(chosen)} samples of a pressure, expected at least {min(LEAST_SAMPLES, rows)}: this computer is too "
            "busy, close other programs and start again"
        )
    configurations = np.array([sample.configuration for sample in chosen])
    configuration = configurations.mean(axis=0)
    configuration /= np.linalg.norm(configuration, axis=-1, keepdims=True)
    freedom = 2 * len(configuration) * (len(chosen) - 1)  # two axes of each module
    return Mean(
        configuration,
        np.mean([sample.base for sample in chosen], axis=0),
        np.mean([sample.applied_bar for sample in chosen], axis=0),
        np.mean([sample.measured_bar for sample in chosen], axis=0),
        float(np.sqrt(np.sum(angle_between_deg(configurations, configuration) ** 2) / freedom)),
    )


def for_calibration(robot: Robot, channels: Sequence[int]) -> Robot:
    """The robot with the rate of a calibration, the same time without valid frames, and chambers on these channels, so
    that the board drives them; where the chambers are is not yet known."""
    limits, period_s = robot.limits, robot.loop.period_s
    frames = max(1, round(limits.invalid_frames * period_s / PERIOD_S))
    direction_deg = robot.actuators.directions_deg[0]
    return msgspec.structs.replace(
        robot,
        loop=msgspec.structs.replace(robot.loop, hz=1.0 / PERIOD_S),
        limits=msgspec.structs.replace(limits, invalid_frames=frames),
        chambers=tuple(Chamber(module=1, direction_deg=direction_deg, channel=each) for each in channels),
    )
