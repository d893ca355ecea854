"""What an emulated board's events say about its valves, in emulated time."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from modsoft.hil.board.emulator import Event


def vented_us(trace: Sequence[Event], since: int = 0) -> float:
    """Emulated time (us) of the event in `trace[since:]` that closed the last open output, the others closed before.

    Infinite where none was closed there, and where one is open at the end, also one that opened again.
    """
    closed_us = math.inf
    for index, event, duties in _duties(trace):
        if index >= since:
            closed_us = math.inf if any(duties.values()) else event["t_us"]
    return closed_us


def rises(trace: Sequence[Event], since: int = 0) -> int:
    """How often an output of any channel went up in `trace[since:]`."""
    before: dict[int, float] = {}
    count = 0
    for index, event, duties in _duties(trace):
        channel = event["channel"]
        count += index >= since and duties[channel] > before.get(channel, 0.0)
        before[channel] = duties[channel]
    return count


def _duties(trace: Sequence[Event]) -> Iterator[tuple[int, Event, dict[int, float]]]:
    """Every change of an output, with its index in the trace and the duties of all channels after it."""
    duties: dict[int, float] = {}
    for index, event in enumerate(trace):
        if event["event"] == "pwm":
            duties[event["channel"]] = event["duty"]
            yield index, event, duties
