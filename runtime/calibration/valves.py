"""Gain and offset of every valve with a pressure sensor, from five pressures a chamber.

The firmware's set-points are compared with the sensors, whose readings of the vented chambers are subtracted. A valve
that gives a * p + b for a set-point p gives the pressure p for the set-point gain * p + offset_bar, with gain = 1 / a
and offset_bar = -b / a. Everything here is a function of measurements; `procedure` measures.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.board.protocol import CHANNELS
from modsoft.runtime.calibration.channel_faults import NO_PRESSURE, OFFSET_BAR, wrong_full_scale
from modsoft.runtime.calibration.channels import EMPTYING_ROWS, REST_ROWS
from modsoft.runtime.calibration.schedule import Sample, mean_of
from modsoft.runtime.errors import Tripped
from modsoft.runtime.layout import listed
from modsoft.runtime.robot import Chamber, Robot, Valve

LEVELS = 5
LEVEL_ROWS = 10  # at every pressure
LOWEST_ROWS = 4  # at the smallest pressure after it, before the firmware vents for a sensor that does not agree
LEVEL_MEAN_ROWS = 3
CHANNEL_ROWS = LEVELS * (LEVEL_ROWS + LOWEST_ROWS)
LEAST_SLOPE, MOST_SLOPE = 0.8, 1.25  # of a valve and a sensor without a fault
LARGEST_OFFSET_BAR = 0.03
LARGEST_RESIDUAL_BAR = 0.005  # root mean square
SHORTFALL_BAR = 0.005  # of the largest pressure: the board's limit cuts it off
DIGITS = 4  # of gain and offset
TOO_HIGH, TOO_HIGH_BAR = 1.3, 0.05  # pressure above this factor and margin of the set-point


class Fit(NamedTuple):
    """A line through the pressures of one channel: measured = slope * set-point + intercept_bar."""

    channel: int
    vented_bar: float  # reading without pressure, subtracted from the others
    slope: float
    intercept_bar: float
    residual_bar: float  # root mean square of the levels
    other: int | None  # input that follows the set-points instead of the channel's own

    @property
    def gain(self) -> float:
        return round(1.0 / self.slope, DIGITS)

    @property
    def offset_bar(self) -> float:
        return round(-self.intercept_bar / self.slope, DIGITS) + 0.0  # not -0.0


def levels_bar(valve: Valve) -> Array:
    """The pressures (LEVELS,), bar, over the range of the robot file."""
    return np.linspace(valve.p_min_bar, valve.p_max_bar, LEVELS)


def schedule(chambers: Sequence[int], sensed: Sequence[int], valve: Valve) -> Array:
    """Set-points (R, CHANNELS), bar: vented; then the levels of one channel with a sensor after the other, with all
    others at the smallest pressure, as in a run that bends one module. chambers, sensed: channels."""
    blocks = [np.zeros((REST_ROWS, CHANNELS))]
    lowest = np.zeros(CHANNELS)
    lowest[list(chambers)] = valve.p_min_bar
    for channel in sensed:
        block = np.tile(lowest, (LEVELS, LEVEL_ROWS + LOWEST_ROWS, 1))
        block[:, :LEVEL_ROWS, channel] = levels_bar(valve)[:, None]
        blocks.append(block.reshape(-1, CHANNELS))
    return np.concatenate(blocks)


def channel_of_row(sensed: Sequence[int], row: int) -> int | None:
    """The channel whose levels this row belongs to."""
    number = (row - REST_ROWS) // CHANNEL_ROWS
    return None if row < REST_ROWS or number >= len(sensed) else sensed[number]


class Watch:
    """Ends the run at a pressure far above the set-points."""

    def __init__(self, sensed: Sequence[int], rows_bar: Array):
        self._sensed, self._rows_bar = sensed, rows_bar

    def __call__(self, sample: Sample) -> None:
        """Raises `Tripped`."""
        set_bar = self._rows_bar[max(0, sample.row - EMPTYING_ROWS) : sample.row + 1].max()
        measured_bar = np.nan_to_num(sample.measured_bar, nan=-np.inf)
        most = int(np.argmax(measured_bar))
        if sample.row >= REST_ROWS and measured_bar[most] > TOO_HIGH * set_bar + TOO_HIGH_BAR:
            raise Tripped(
                f"the sensor at A{most} measures {measured_bar[most]:.2f} bar, expected at most {set_bar:.2f}: its "
                "valve stays open, or full_scale_bar under [valve] or [sensors] is not that of the label"
            )


def fit_of(samples: Sequence[Sample], sensed: Sequence[int], number: int) -> Fit:
    """The line of `sensed[number]` by least squares."""
    channel, vented_bar = sensed[number], mean_of(samples, REST_ROWS - 1).measured_bar
    starts = REST_ROWS + CHANNEL_ROWS * number + (LEVEL_ROWS + LOWEST_ROWS) * np.arange(LEVELS)
    means = [mean_of(samples, int(start) + LEVEL_ROWS - 1, LEVEL_MEAN_ROWS) for start in starts]
    set_bar = np.array([mean.applied_bar[channel] for mean in means])
    measured_bar = np.array([mean.measured_bar for mean in means]) - vented_bar  # (LEVELS, channels)
    slope, intercept_bar = np.polyfit(set_bar, measured_bar[:, channel], 1)
    residuals = measured_bar[:, channel] - (slope * set_bar + intercept_bar)
    rises = {each: np.ptp(measured_bar[:, each]) / np.ptp(set_bar) for each in sensed if each != channel}
    other = max(rises, key=lambda each: float(rises[each]), default=None)
    follows = slope < NO_PRESSURE and other is not None and rises[other] > LEAST_SLOPE
    return Fit(
        channel,
        float(vented_bar[channel]),
        float(slope),
        float(intercept_bar),
        float(np.sqrt(np.mean(residuals**2))),
        other if follows else None,
    )


def faults(fits: Sequence[Fit]) -> list[str]:
    """What the lines show, one line each; a gain would hide it."""
    scale = wrong_full_scale([fit.slope for fit in fits], LEAST_SLOPE, MOST_SLOPE)
    if scale:
        return [scale]
    return [line for fit in fits if (line := fault_of(fit))]


def fault_of(fit: Fit) -> str:
    """The fault of a single channel; empty without one."""
    name = f"channel {fit.channel}"
    if fit.other is not None:
        return f"{name}: its pressure shows at the input A{fit.other}, expected A{fit.channel}: exchange the wires"
    if fit.slope < NO_PRESSURE:
        return f"{name}: its sensor measures no pressure: its valve is dead or without air, or the sensor is missing"
    if fit.residual_bar > LARGEST_RESIDUAL_BAR:
        return (
            f"{name}: its pressures are {fit.residual_bar:.3f} bar off a line (rms), expected at most "
            f"{LARGEST_RESIDUAL_BAR:g}: look at its valve, its supply and its sensor"
        )
    if fit.slope < LEAST_SLOPE:
        return f"{name}: its sensor measures {fit.slope:.2f} times the set-point: a leak in its hose or chamber"
    if fit.slope > MOST_SLOPE:
        return f"{name}: its sensor measures {fit.slope:.2f} times the set-point: compare full scales with the labels"
    if abs(fit.offset_bar) > LARGEST_OFFSET_BAR:
        return (
            f"{name}: the valve needs an offset of {fit.offset_bar:+.3f} bar, expected at most {LARGEST_OFFSET_BAR:g}: "
            "look at its zero adjustment and the common ground"
        )
    return ""


def notes(fits: Sequence[Fit], robot: Robot) -> list[str]:
    """Results, one line each, and which chambers have no sensor."""
    assert robot.valve is not None
    lines = []
    for fit in fits:
        if fault_of(fit):
            continue
        line = (
            f"channel {fit.channel}: gain {fit.gain:g}, offset {fit.offset_bar:+g} bar, residual "
            f"{1000 * fit.residual_bar:.1f} mbar (rms)"
        )
        if abs(fit.vented_bar) > OFFSET_BAR:
            line += f"; its sensor's zero is {fit.vented_bar:+.3f} bar: adjust it, or correct zero_v under [sensors]"
        largest_bar = fit.slope * robot.valve.p_max_bar + fit.intercept_bar
        if largest_bar < robot.valve.p_max_bar - SHORTFALL_BAR:
            line += f"; at the board's limit of {robot.valve.p_max_bar:g} bar it reaches only {largest_bar:.3f}"
        lines.append(line)
    sensed = {fit.channel for fit in fits}
    if missing := sorted(each.channel for each in robot.chambers if each.channel not in sensed):
        lines.append(f"no sensor at channels {listed(missing)}: their gain and offset stay as they are")
    return lines


def chambers(robot: Robot, fits: Sequence[Fit]) -> tuple[Chamber, ...]:
    """`[[chambers]]` with the gains and offsets of the lines."""
    by_channel = {fit.channel: fit for fit in fits}
    return tuple(
        each
        if (fit := by_channel.get(each.channel)) is None
        else msgspec.structs.replace(each, gain=fit.gain, offset_bar=fit.offset_bar)
        for each in robot.chambers
    )
