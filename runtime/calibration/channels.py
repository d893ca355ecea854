"""Which hose is where: one valve after the other gives a pulse of pressure, and the tracker shows what bends.

A chamber bends its module away from itself. Everything here is a function of measurements; `procedure` measures.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.board.protocol import CHANNELS
from modsoft.runtime.calibration.schedule import MEAN_ROWS, PERIOD_S, Mean, Sample, mean_of
from modsoft.runtime.control.features import angle_between_deg
from modsoft.runtime.errors import Tripped
from modsoft.runtime.layout import listed
from modsoft.runtime.robot import Chamber, Robot

REST_ROWS = 12
# Shares of the pressure: a fifth at first, until the board has reported it, so that a valve with a larger full scale
# than in the robot file is noticed below the pressure.
RAMP = (0.2, 0.2, 0.2, 0.6, 1.0)
# Ramp and hold are shorter than the two seconds after which the firmware vents for a sensor that does not agree.
HOLD_ROWS = 12
VENT_ROWS = 13
PULSE_ROWS = len(RAMP) + HOLD_ROWS + VENT_ROWS

LEAST_BEND_DEG = 1.0  # that counts as motion
NOISE_FACTOR = 4.5  # and this many standard deviations of the mean
FAR_DEG = 40.0  # from the direction of every chamber; a third of the distance between two where that is less
OTHER_MODULE = 0.5  # share of the largest bend: another module that bends as much is moved by the same hose
STAYS_OPEN = 0.5  # share of bend or pressure that is left after a pulse
EMPTYING_ROWS = VENT_ROWS  # so long a chamber may have the pressure of before
TOO_HIGH, TOO_HIGH_BAR = 1.5, 0.03  # pressure above this factor and margin of the set-point


class Pulse(NamedTuple):
    """What the pulse of one channel did."""

    channel: int
    bend_deg: Array  # (N,) angle by which each module bent
    direction_deg: Array  # (N,) direction of that bend, from +x towards +y, 0 to 360
    left_deg: Array  # (N,) angle that was left after it
    least_deg: float  # smaller angles are noise
    base_deg: float  # rotation of the base's tool
    pressure_bar: float  # of the board's set-point
    rise_bar: Array  # (channels,) rise of each sensor; NaN without one
    left_bar: Array  # (channels,) what was left of it
    vented_bar: Array  # (channels,) readings before the pulse

    @property
    def module(self) -> int | None:
        """Index of the module that bent most; None if none moved."""
        most = int(np.argmax(self.bend_deg))
        return most if self.bend_deg[most] >= self.least_deg else None

    @property
    def share(self) -> float:
        """Rise of the channel's own sensor as a share of the pressure; NaN without a sensor."""
        return float(self.rise_bar[self.channel] / self.pressure_bar)


def schedule(channels: Sequence[int], pressure_bar: float) -> Array:
    """Set-points (R, CHANNELS), bar: rest, then a pulse of each channel."""
    pulse = np.zeros(PULSE_ROWS)
    pulse[: len(RAMP)] = RAMP
    pulse[len(RAMP) : len(RAMP) + HOLD_ROWS] = 1.0
    rows = np.zeros((REST_ROWS + PULSE_ROWS * len(channels), CHANNELS))
    for number, channel in enumerate(channels):
        start = REST_ROWS + PULSE_ROWS * number
        rows[start : start + PULSE_ROWS, channel] = pressure_bar * pulse
    return rows


def channel_of_row(channels: Sequence[int], row: int) -> int | None:
    """The channel whose pulse this row belongs to."""
    return None if row < REST_ROWS else channels[min((row - REST_ROWS) // PULSE_ROWS, len(channels) - 1)]


def pulse_of(samples: Sequence[Sample], channels: Sequence[int], number: int) -> Pulse:
    """The pulse of `channels[number]`; its samples are complete."""
    start = REST_ROWS + PULSE_ROWS * number
    before = mean_of(samples, start - 1)
    during = mean_of(samples, start + len(RAMP) + HOLD_ROWS - 1)
    after = mean_of(samples, start + PULSE_ROWS - 1)
    vented = before.configuration + after.configuration  # half-way, because a soft module returns only nearly
    vented /= np.linalg.norm(vented, axis=-1, keepdims=True)
    x, y, _ = np.moveaxis(during.configuration - vented, -1, 0)
    scatter_deg = np.sqrt(np.mean([each.scatter_deg**2 for each in (before, during, after)]))
    return Pulse(
        channels[number],
        angle_between_deg(during.configuration, vented),
        np.degrees(np.arctan2(y, x)) % 360.0,
        angle_between_deg(after.configuration, before.configuration),
        max(LEAST_BEND_DEG, NOISE_FACTOR * float(scatter_deg) * (1.5 / MEAN_ROWS) ** 0.5),  # of one mean and of two
        _rotation_deg(before, during),
        float(during.applied_bar[channels[number]]),
        during.measured_bar - before.measured_bar,
        after.measured_bar - before.measured_bar,
        before.measured_bar,
    )


def _rotation_deg(before: Mean, during: Mean) -> float:
    """Rotation of the base's tool, degrees, from the means of its axes."""
    axes = [mean.base[:3, :3] / np.linalg.norm(mean.base[:3, :3], axis=0) for mean in (before, during)]
    cosine = (np.trace(axes[0].T @ axes[1]) - 1.0) / 2.0
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


class Watch:
    """Ends the run at a pressure above the set-point, and at a valve that stays open after its pulse."""

    def __init__(self, channels: Sequence[int], rows_bar: Array):
        self._channels, self._rows_bar = channels, rows_bar
        self._samples: list[Sample] = []
        self._vented_bar: Array | None = None  # (channels,) readings of the sensors at rest

    def __call__(self, sample: Sample) -> None:
        """Raises `Tripped`."""
        self._samples.append(sample)
        if sample.row < REST_ROWS:
            return
        if self._vented_bar is None:
            self._vented_bar = mean_of(self._samples, REST_ROWS - 1).measured_bar
        self._check_pressure(sample, sample.measured_bar - self._vented_bar)
        number, row = divmod(sample.row - REST_ROWS, PULSE_ROWS)
        if row == PULSE_ROWS - 1:
            check_closed(pulse_of(self._samples, self._channels, number))

    def _check_pressure(self, sample: Sample, rise_bar: Array) -> None:
        row_bar = self._rows_bar[max(0, sample.row - EMPTYING_ROWS) : sample.row + 1].max()
        most = int(np.argmax(np.nan_to_num(rise_bar, nan=-np.inf)))
        if not rise_bar[most] > TOO_HIGH * row_bar + TOO_HIGH_BAR:  # NaN: no sensor
            return
        channel = channel_of_row(self._channels, sample.row)
        raise Tripped(
            f"the sensor at A{most} measures {rise_bar[most]:.2f} bar during the pulse of channel {channel}, expected "
            f"at most {row_bar:.2f}: compare full_scale_bar under [valve] and [sensors] with the labels"
        )


def check_closed(pulse: Pulse) -> None:
    """`Tripped` if the valve stays open after its pulse."""
    module, channel = pulse.module, pulse.channel
    left = []
    if module is not None and pulse.left_deg[module] > max(pulse.least_deg, STAYS_OPEN * pulse.bend_deg[module]):
        left.append(f"module {module + 1} is still bent by {pulse.left_deg[module]:.0f} degrees")
    if pulse.left_bar[channel] > STAYS_OPEN * pulse.pressure_bar:
        left.append(f"its sensor still measures {pulse.left_bar[channel]:.2f} bar")
    if left:
        raise Tripped(
            f"channel {channel}: {' and '.join(left)} {VENT_ROWS * PERIOD_S:.1f} s after its pulse, expected 0: its "
            "valve stays open; shut off the air and look at it"
        )


class Place(NamedTuple):
    """A chamber."""

    module: int  # from 1
    direction_deg: float

    def __str__(self) -> str:
        return f"module {self.module} at {self.direction_deg:g} degrees"


def describe(pulse: Pulse, place: Place | None) -> str:
    """What a pulse did, in a line."""
    what = str(place) if place is not None else "no module moves" if pulse.module is None else "no single chamber"
    if place is not None:
        what += f", bends it by {pulse.bend_deg[place.module - 1]:.1f} degrees"
    rise_bar = pulse.rise_bar[pulse.channel]
    what += "; no sensor" if np.isnan(rise_bar) else f"; {rise_bar:.2f} of {pulse.pressure_bar:.2f} bar"
    return f"channel {pulse.channel}: {what}"


def place_of(pulse: Pulse, robot: Robot) -> tuple[Place | None, float]:
    """The chamber at the hose of a channel that moves a module, by the nearest direction of `directions_deg`, and how
    far that is, degrees. None where it is too far."""
    assert pulse.module is not None
    chamber_deg = (pulse.direction_deg[pulse.module] + 180.0) % 360.0
    directions = np.array(robot.actuators.directions_deg)
    distances = np.abs((directions - chamber_deg + 180.0) % 360.0 - 180.0)
    nearest = int(np.argmin(distances))
    gaps = [abs((a - b + 180.0) % 360.0 - 180.0) for a in directions for b in directions if a != b]
    if distances[nearest] > min(FAR_DEG, min(gaps) / 3.0):
        return None, float(distances[nearest])
    return Place(pulse.module + 1, robot.actuators.directions_deg[nearest]), float(distances[nearest])


def chambers(robot: Robot, places: dict[int, Place]) -> tuple[Chamber, ...]:
    """`[[chambers]]` in the order of the robot file, on these channels. Gain and offset belong to the valve, so that
    they stay with its channel."""
    channels = {place: channel for channel, place in places.items()}
    before = {each.channel: each for each in robot.chambers}
    chosen = []
    for chamber in robot.chambers:
        channel = channels[Place(chamber.module, chamber.direction_deg)]
        valve = before.get(channel)
        chosen.append(
            Chamber(
                module=chamber.module,
                direction_deg=chamber.direction_deg,
                channel=channel,
                gain=1.0 if valve is None else valve.gain,
                offset_bar=0.0 if valve is None else valve.offset_bar,
            )
        )
    return tuple(chosen)


def changes(before: Robot, after: Sequence[Chamber]) -> list[str]:
    """What `[[chambers]]` would change, one line each."""
    lines = []
    old = {(each.module, each.direction_deg): each for each in before.chambers}
    for chamber in after:
        previous = old[chamber.module, chamber.direction_deg]
        parts = [
            f"{name} {getattr(previous, name):g} -> {getattr(chamber, name):g}"
            for name in ("channel", "gain", "offset_bar")
            if getattr(previous, name) != getattr(chamber, name)
        ]
        if parts:
            lines.append(f"{Place(chamber.module, chamber.direction_deg)}: {', '.join(parts)}")
    return lines


def exchanged(before: Robot, places: dict[int, Place]) -> list[str]:
    """The modules whose hoses are exchanged with each other, against the robot file: one line each."""
    lines = []
    for module in range(1, before.modules + 1):
        old = {each.channel: each.direction_deg for each in before.chambers if each.module == module}
        new = {channel: place.direction_deg for channel, place in places.items() if place.module == module}
        if old.keys() == new.keys() and old != new:
            moved = sorted(channel for channel in old if old[channel] != new[channel])
            lines.append(f"module {module}: the hoses of channels {listed(moved)} are exchanged")
    return lines
