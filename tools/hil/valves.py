"""The valve outputs, from the timer registers, against the set-points of the run log."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from modsoft.hil.record import Record
from modsoft.runtime.arrays import Array

ACKNOWLEDGED_P99_MS = 30.0  # limit; also assumed for a set-point without acknowledgement
SETTLING_S = 0.03  # after acknowledgement and slew: some loops of the firmware; the board's lateness is added
UNBOUNDED_NS = 1 << 62


class Span(NamedTuple):
    """A set-point in force and the one before it, in counts, for every channel of the board. The board receives it
    after `from_ns`; its outputs have reached it by `settled_ns`."""

    before: Array
    commanded: Array
    from_ns: int
    settled_ns: int
    until_ns: int


def spans(record: Record) -> Iterator[Span]:
    """Every set-point: the first one, those of the ticks, and the vent, a set-point of 0 without end."""
    if record.start_ns is None:
        return
    channels = record.outputs.duty.shape[1]
    scale = full_counts_per_bar(record)
    set_points_bar = [record.start_bar[:channels], *record.commanded_bar[:, :channels], np.zeros(channels)]
    begins_ns = [record.start_ns, *(int(at) for at in record.mono_ns), record.end_ns, UNBOUNDED_NS]
    delays_ms = [ACKNOWLEDGED_P99_MS, *np.nan_to_num(record.acknowledged_ms, nan=ACKNOWLEDGED_P99_MS)]
    delays_ms.append(ACKNOWLEDGED_P99_MS)
    before = np.zeros(channels)
    for k, commanded in enumerate(set_points_bar):
        slew_s = float(np.max(np.abs(commanded - before))) / record.slew_bar_per_s
        late_ms = np.nan_to_num(record.board_late_ms) + record.outputs_age_ms
        settling_s = (delays_ms[k] + late_ms) * 1e-3 + slew_s + SETTLING_S
        settled_ns = begins_ns[k] + round(settling_s * 1e9)
        yield Span(before * scale, commanded * scale, begins_ns[k], settled_ns, begins_ns[k + 1])
        before = commanded


def full_counts_per_bar(record: Record) -> float:
    assert record.robot.valve is not None  # the rig runs no other robots
    return record.outputs.counts / record.robot.valve.full_scale_bar


def valve_difference(record: Record) -> Array:
    """Largest difference (K + 1,) of the timer registers from the logged set-point, in counts, over all channels, from
    the end of the slew to the start of the next tick; row 0: the set-point before the first tick. NaN: no such time."""
    channels = record.outputs.duty.shape[1]
    if record.commanded_bar[:, channels:].any():
        return np.full(len(record.tick) + 1, np.inf)  # a set-point for a channel that the board does not have
    largest = []
    for span in list(spans(record))[:-1]:  # the vent has its own criterion
        largest.append(math.nan)
        if span.settled_ns <= span.until_ns:
            counts = record.outputs.between(span.settled_ns, span.until_ns) * record.outputs.counts
            largest[-1] = float(np.max(np.abs(counts - span.commanded)))
    return np.array(largest)


def valve_excursion(record: Record) -> Array:
    """Largest distance (K + 2,) of any timer register, at any time, from the range between the set-point in force and
    the one before it, in counts; the last row is the vent."""
    largest = []
    for span in spans(record):
        counts = record.outputs.between(span.from_ns, span.until_ns) * record.outputs.counts
        low, high = np.minimum(span.before, span.commanded), np.maximum(span.before, span.commanded)
        largest.append(np.max(np.maximum(low - counts, counts - high), initial=0.0))
    return np.array(largest)


def largest_duty_before(record: Record) -> float:
    """Largest duty of all channels before the first set-point, or in the whole run where none was sent."""
    until_ns = UNBOUNDED_NS if record.start_ns is None else record.start_ns
    return float(np.max(record.outputs.between(-UNBOUNDED_NS, until_ns)))


def vent_limit_ms(record: Record) -> float:
    """Time of a vent from the largest pressure at the board's slew, after the longest acknowledgement, ms."""
    assert record.robot.valve is not None
    ramp_s = record.robot.valve.p_max_bar / record.slew_bar_per_s
    late_ms = float(np.nan_to_num(record.board_late_ms)) + record.outputs_age_ms
    return ACKNOWLEDGED_P99_MS + (ramp_s + SETTLING_S) * 1e3 + late_ms
