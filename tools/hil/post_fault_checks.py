"""What came of the faults and runs of a soak: noticed, named, valves right, log whole; from the files they left."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from modsoft.hil import outputs, record, valves
from modsoft.hil.criteria import DESIRED_ERROR, VALVE_COUNTS, desired_error
from modsoft.hil.faults import ON_ITS_OWN_MS, Fault
from modsoft.runtime.errors import LostInRun
from modsoft.runtime.log_reader import Run

Line = dict[str, Any]


@dataclass
class Injected:
    """A fault and what came of it."""

    fault: Fault
    run: int
    at_s: float  # since the soak began
    mono_ns: int
    noticed_ms: float | None = None  # until a line of the log said so
    code: int | None = None  # of the run, where it ended
    words: str = ""
    vented_ms: float | None = None  # emulated, until every valve was at 0 permanently, where the board vented alone
    wrong: list[str] = field(default_factory=list)


@dataclass
class Ran:
    """A run of the soak. memory_mib: (seconds since its start, resident memory). over, under, off: the worst timer
    register against the set-points of the log, in counts."""

    number: int
    ticks: int = 0
    code: int = 0
    seconds: float = 0.0
    memory_mib: list[tuple[float, float]] = field(default_factory=list)
    over_counts: float = 0.0
    under_counts: float = 0.0
    off_counts: float = 0.0
    vented_ms: float | None = None  # emulated, after the runtime began to vent
    stalled_ms: float = 0.0  # of the emulated board, in all
    wrong: list[str] = field(default_factory=list)


def judge_log(ran: Ran, read: Run, said: str) -> None:
    """A log that a person can follow: whole lines in order, the cause, the exit code."""
    numbers = [tick.tick for tick in read.ticks]
    if numbers != sorted(set(numbers)):
        ran.wrong.append("ticks of the log out of order")
    if ran.code < 0:
        return  # killed: the log ends where it was
    if read.meta["exit_code"] != ran.code:
        ran.wrong.append(f"the log says exit code {read.meta['exit_code']}")
    if read.end is None:
        ran.wrong.append("the log has no end")
    if read.meta["lines_lost"]:
        ran.wrong.append(f"{read.meta['lines_lost']} lines of the log lost")
    if ran.code and read.meta["reason"] not in said:
        ran.wrong.append("the log and the terminal give different reasons")


def judge_fault(each: Injected, ran: Ran, ended: bool, said: str, events: list[Line]) -> None:
    """Whether a fault was noticed, and, where it ended the run, named, and the valves at 0 in time."""
    fault = each.fault
    if ended:
        each.code = ran.code
        each.words = (said.strip().splitlines() or [""])[-1] if ran.code > 0 else ""
        if not fault.codes:
            each.wrong.append(f"it ended the run with {ran.code}")
        elif not fault.ended_well(ran.code, said):
            each.wrong.append(f"expected exit code {fault.codes} and {fault.says!r}")
    elif not fault.goes_by:
        each.wrong.append("the run went on")
    if fault.goes_by and each.noticed_ms is None and not ended:
        each.wrong.append("not noticed")
    if fault.vents_ms is not None:
        since_us = outputs.emulated_us(events, each.mono_ns)
        each.vented_ms = outputs.read_outputs(events).vented_after_ms(since_us)
        if not each.vented_ms <= fault.vents_ms:
            each.wrong.append(f"valves at 0 after {each.vented_ms:.0f} ms, allowed {fault.vents_ms:.0f}")


def judge_vent(ran: Ran, found: record.Record) -> None:
    """After a run that the runtime ended itself, every valve at 0 in time, on the board's own clock: by the ramp; where
    it had lost the board and so told it nothing, by the board's own timer."""
    if found.end_ns < 0 or ran.code < 0:
        return
    ran.vented_ms = found.outputs.vented_after_ms(found.end_us)
    limit_ms = ON_ITS_OWN_MS if ran.code == LostInRun.exit_code else valves.vent_limit_ms(found)
    if not ran.vented_ms <= limit_ms:
        ran.wrong.append(f"valves at 0 only {ran.vented_ms:.0f} ms after the vent began, allowed {limit_ms:.0f}")


def judge_valves(ran: Ran, found: record.Record, stopped_ns: int | None) -> None:
    """No valve ever above what was commanded or below it; none off it once a set-point was acknowledged and settled;
    all at 0 in the end. `stopped_ns`: from when on the board vents by itself, which is never wrong."""
    if found.start_ns is None:
        return
    low = high = np.zeros(found.outputs.duty.shape[1])
    acknowledged = [True, *~np.isnan(found.acknowledged_ms), False]
    stopped_ns = found.end_ns if stopped_ns is None else stopped_ns
    for span, known in zip(valves.spans(found), acknowledged, strict=True):
        # What was not acknowledged may not have arrived: then the set-point before still stands.
        low, high = np.minimum(low, span.commanded), np.maximum(high, span.commanded)
        stood = found.outputs.between(span.from_ns, span.until_ns) * found.outputs.counts
        ran.over_counts = max(ran.over_counts, float(np.max(stood - high)))
        if span.from_ns < stopped_ns:
            stood = found.outputs.between(span.from_ns, min(span.until_ns, stopped_ns)) * found.outputs.counts
            ran.under_counts = max(ran.under_counts, float(np.max(low - stood)))
        if known and span.settled_ns < min(span.until_ns, stopped_ns):
            stood = found.outputs.between(span.settled_ns, min(span.until_ns, stopped_ns)) * found.outputs.counts
            ran.off_counts = max(ran.off_counts, float(np.max(np.abs(stood - span.commanded))))
            low = high = span.commanded
    for counts, word in ((ran.over_counts, "above"), (ran.under_counts, "below"), (ran.off_counts, "off")):
        if counts > VALVE_COUNTS:
            ran.wrong.append(f"a valve {counts:.0f} counts {word} what was commanded")
    if valves.largest_duty_before(found) > 0:
        ran.wrong.append("a valve was open before the first set-point")
    if not desired_error(found) <= DESIRED_ERROR:
        ran.wrong.append("the log's desired configurations are not the task's")
    if found.outputs.duty[-1:].any():
        ran.wrong.append("a valve was left open")
