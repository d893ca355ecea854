"""The valve outputs of the emulated board over time, from its `pwm` events."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from modsoft.runtime.arrays import Array

Event = dict[str, Any]

FULL_COUNTS = 4096  # of the firmware's timers, where no output ever opened


class ValveOutputs(NamedTuple):
    """Duties of all channels from the timer registers. Row j holds from event j until event j + 1."""

    mono_ns: NDArray[np.int64]  # (E,), CLOCK_MONOTONIC of the host
    t_us: Array  # (E,), emulated time: the board's cycle counter
    duty: Array  # (E, channels), 0 to 1
    floating: NDArray[np.bool_]  # (E, channels), the pin is an input
    counts: int  # of a full duty

    def between(self, start_ns: int, end_ns: int) -> Array:
        """Every duty (n, channels) in force at some time in [start, end]; zeros before the first row."""
        first = int(np.searchsorted(self.mono_ns, start_ns, side="right")) - 1
        last = int(np.searchsorted(self.mono_ns, end_ns, side="right"))
        rows = self.duty[max(first, 0) : last]
        return np.vstack([np.zeros((1, self.duty.shape[1])), rows]) if first < 0 else rows

    def vented_after_ms(self, since_us: float) -> float:
        """Emulated milliseconds from `since_us` until every output is at 0 permanently: 0 where all of them are at 0
        from then on, infinite where one is open at the end."""
        open_rows = np.flatnonzero(self.duty.any(axis=1))
        if not len(open_rows):
            return 0.0
        closed_row = open_rows[-1] + 1
        return max(0.0, float(self.t_us[closed_row] - since_us) * 1e-3) if closed_row < len(self.duty) else math.inf


def read_outputs(events: Sequence[Event]) -> ValveOutputs:
    """The outputs over time, a row for each change. `ValueError` where the timers count to different tops."""
    changes = [event for event in events if event["event"] == "pwm"]
    ready = [event["channels"] for event in events if event["event"] == "ready"]
    channels = max([*ready, *(event["channel"] + 1 for event in changes)], default=0)
    duty, floating = np.zeros((len(changes), channels)), np.zeros((len(changes), channels), dtype=bool)
    current, floating_now = np.zeros(channels), np.zeros(channels, dtype=bool)
    for row, event in enumerate(changes):
        current[event["channel"]] = event["duty"]
        floating_now[event["channel"]] = event.get("floating", False)
        duty[row], floating[row] = current, floating_now
    tops = {event["raw"][1] for event in changes if event["duty"] > 0}
    if len(tops) > 1:
        raise ValueError(f"the board's timers count to different tops: {sorted(tops)}")
    return ValveOutputs(
        np.array([event["mono_ns"] for event in changes], dtype=np.int64),
        np.array([event["t_us"] for event in changes], dtype=np.float64),
        duty,
        floating,
        max(tops, default=FULL_COUNTS - 1) + 1,
    )


def read_reported(events: Sequence[Event]) -> ValveOutputs:
    """The applied pressures of a real board by its STATUS, a row for each, times of arrival. A full duty is the full
    scale of the valves, so that a count is the unit of the protocol, 10 Pa."""
    hello = next(event for event in events if event["event"] == "serial")
    reports = [event for event in events if event["event"] == "status"]
    shape = len(reports), hello["channels"]
    applied = np.array([event["applied"][: hello["channels"]] for event in reports], dtype=np.float64)
    return ValveOutputs(
        np.array([event["mono_ns"] for event in reports], dtype=np.int64),
        np.array([event["t_us"] for event in reports], dtype=np.float64),
        applied.reshape(shape) / hello["p_full"],
        np.zeros(shape, dtype=bool),
        hello["p_full"],
    )


def emulated_us(events: Sequence[Event], mono_ns: float) -> float:
    """An instant of CLOCK_MONOTONIC in emulated time, by the last event before it; NaN before the first event."""
    before = [event for event in events if event["mono_ns"] <= mono_ns]
    return before[-1]["t_us"] + (mono_ns - before[-1]["mono_ns"]) * 1e-3 if before else math.nan
