"""What the timer registers of the valves did, against what the runtime's log says was commanded."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from modsoft.hil.record import Record
from modsoft.runtime.arrays import Array

ACKNOWLEDGED_P99_MS = 30.0  # a set-point that was never acknowledged counts as so long on its way
SETTLING_S = 0.03  # after acknowledgement and slew: some loops of the firmware; the board's lateness comes on top
FOR_EVER_NS = 1 << 62


class Span(NamedTuple):
    """A set-point in force, and the one before it, in counts of every channel that the board has. It is taken at some
    time after `from_ns` and reached by `settled_ns`."""

    before: Array
    commanded: Array
    from_ns: int
    settled_ns: int
    until_ns: int


def spans(record: Record) -> Iterator[Span]:
    """Every set-point: the first one, those of the ticks, and at last the vent, which is a set-point of 0 for ever."""
    if record.start_ns is None:
        return
    channels = record.outputs.duty.shape[1]
    scale = full_counts_per_bar(record)
    set_points_bar = [record.start_bar[:channels], *record.commanded_bar[:, :channels], np.zeros(channels)]
    begins_ns = [record.start_ns, *(int(at) for at in record.mono_ns), record.end_ns, FOR_EVER_NS]
    took_ms = [ACKNOWLEDGED_P99_MS, *np.nan_to_num(record.acknowledged_ms, nan=ACKNOWLEDGED_P99_MS)]
    took_ms.append(ACKNOWLEDGED_P99_MS)
    before = np.zeros(channels)
    for k, commanded in enumerate(set_points_bar):
        slew_s = float(np.max(np.abs(commanded - before))) / record.slew_bar_per_s
        settling_s = took_ms[k] * 1e-3 + slew_s + SETTLING_S + np.nan_to_num(record.board_late_ms) * 1e-3
        settled_ns = begins_ns[k] + round(settling_s * 1e9)
        yield Span(before * scale, commanded * scale, begins_ns[k], settled_ns, begins_ns[k + 1])
        before = commanded


def full_counts_per_bar(record: Record) -> float:
    assert record.robot.valve is not None  # the rig runs no other robots
    return record.outputs.counts / record.robot.valve.full_scale_bar


def valve_difference(record: Record) -> Array:
    """Largest difference (K + 1,) of timer registers from what the log says was commanded, in counts, over all channels
    and all the time from when the slew must have settled until the next tick starts; the first is that of the set-point
    before the first tick. NaN: no such time."""
    channels = record.outputs.duty.shape[1]
    if record.commanded_bar[:, channels:].any():
        return np.full(len(record.tick) + 1, np.inf)  # a set-point for a channel that the board does not have
    worst = []
    for span in list(spans(record))[:-1]:  # the vent has its own line
        worst.append(math.nan)
        if span.settled_ns <= span.until_ns:
            stood = record.outputs.between(span.settled_ns, span.until_ns) * record.outputs.counts
            worst[-1] = float(np.max(np.abs(stood - span.commanded)))
    return np.array(worst)


def valve_excursion(record: Record) -> Array:
    """Largest distance (K + 2,) of any timer register, at any time, from the range between the set-point in force and
    the one before it, in counts; the last is that of the vent."""
    worst = []
    for span in spans(record):
        stood = record.outputs.between(span.from_ns, span.until_ns) * record.outputs.counts
        low, high = np.minimum(span.before, span.commanded), np.maximum(span.before, span.commanded)
        worst.append(np.max(np.maximum(low - stood, stood - high), initial=0.0))
    return np.array(worst)


def largest_duty_before(record: Record) -> float:
    """Of all channels, until the runtime gave its first set-point; ever, where it gave none."""
    until_ns = FOR_EVER_NS if record.start_ns is None else record.start_ns
    return float(np.max(record.outputs.between(-FOR_EVER_NS, until_ns)))


def vent_limit_ms(record: Record) -> float:
    """The way from the largest pressure down, at the board's slew, after a request as slow as an acknowledgement."""
    assert record.robot.valve is not None
    way_s = record.robot.valve.p_max_bar / record.slew_bar_per_s
    return ACKNOWLEDGED_P99_MS + (way_s + SETTLING_S) * 1e3 + float(np.nan_to_num(record.board_late_ms))
