"""Checks of a soak's faults and runs, from their traces: detection, messages, valve outputs, run log."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from modsoft.hil import outputs, record, valves
from modsoft.hil.criteria import DESIRED_ERROR, VALVE_COUNTS, desired_error
from modsoft.hil.faults import BOARD_ALONE_MS, Fault
from modsoft.runtime.arrays import Array
from modsoft.runtime.errors import LostInRun
from modsoft.runtime.log_reader import Run

Line = dict[str, Any]


@dataclass
class InjectedFault:
    """A fault and the reaction to it."""

    fault: Fault
    run: int
    at_s: float  # since the start of the soak
    mono_ns: int
    detected_ms: float | None = None  # until a tick of the log showed it
    code: int | None = None  # exit code of the run that it ended
    message: str = ""  # last line of that run
    vented_ms: float | None = None  # emulated, until every valve was at 0 permanently, where the board vented alone
    failures: list[str] = field(default_factory=list)


@dataclass
class SoakRun:
    """A run of the soak. memory_mib: (seconds since its start, resident memory). above, below, off: largest difference
    of a timer register from the set-points of the log, in counts."""

    number: int
    ticks: int = 0
    code: int = 0
    seconds: float = 0.0
    memory_mib: list[tuple[float, float]] = field(default_factory=list)
    above_counts: float = 0.0
    below_counts: float = 0.0
    off_counts: float = 0.0
    vented_ms: float | None = None  # emulated, after the runtime began to vent
    stalled_ms: float = 0.0  # of the emulated board, in total
    failures: list[str] = field(default_factory=list)


def check_log(run: SoakRun, log: Run, messages: str) -> None:
    """The log is complete and ordered, and has the exit code and the reason of the run."""
    numbers = [tick.tick for tick in log.ticks]
    if numbers != sorted(set(numbers)):
        run.failures.append("ticks of the log out of order")
    if run.code < 0:
        return  # killed: the log has no end
    if log.meta["exit_code"] != run.code:
        run.failures.append(f"exit code of the log: {log.meta['exit_code']}")
    if log.end is None:
        run.failures.append("the log has no end")
    if log.meta["lines_lost"]:
        run.failures.append(f"{log.meta['lines_lost']} lines of the log lost")
    if run.code and log.meta["reason"] not in messages:
        run.failures.append("the log and the terminal give different reasons")


def check_fault(injected: InjectedFault, run: SoakRun, ended: bool, messages: str, events: list[Line]) -> None:
    """The fault was detected; where it ended the run, the messages name it; the board vented in time."""
    fault = injected.fault
    if ended:
        injected.code = run.code
        injected.message = (messages.strip().splitlines() or [""])[-1] if run.code > 0 else ""
        if not fault.codes:
            injected.failures.append(f"it ended the run with {run.code}")
        elif not fault.explains(run.code, messages):
            injected.failures.append(f"expected exit code {fault.codes} and {fault.message!r}")
    elif not fault.is_transient:
        injected.failures.append("the run continued")
    if fault.is_transient and injected.detected_ms is None and not ended:
        injected.failures.append("not detected")
    if fault.vents_ms is not None:
        since_us = outputs.emulated_us(events, injected.mono_ns)
        injected.vented_ms = outputs.read_outputs(events).vented_after_ms(since_us)
        if not injected.vented_ms <= fault.vents_ms:
            injected.failures.append(f"valves at 0 after {injected.vented_ms:.0f} ms, limit {fault.vents_ms:.0f}")


def check_vent(run: SoakRun, trace: record.Record) -> None:
    """Every valve was at 0 in time after the runtime began to vent, in emulated time: after the ramp, or, where the
    runtime had lost the board and sent it nothing, after the board's own time-out."""
    if trace.end_ns < 0 or run.code < 0:
        return
    run.vented_ms = trace.outputs.vented_after_ms(trace.end_us)
    limit_ms = BOARD_ALONE_MS if run.code == LostInRun.exit_code else valves.vent_limit_ms(trace)
    if not run.vented_ms <= limit_ms:
        run.failures.append(f"valves at 0 {run.vented_ms:.0f} ms after the vent began, limit {limit_ms:.0f}")


def check_valves(run: SoakRun, trace: record.Record, stopped_ns: int | None) -> None:
    """No valve was above or below its set-points, or off a set-point that was acknowledged and settled; all were at 0
    in the end. stopped_ns: from then on the board may vent by itself."""
    if trace.start_ns is None:
        return
    stopped_ns = trace.end_ns if stopped_ns is None else stopped_ns
    _compare_outputs(run, trace, stopped_ns)
    differences = ((run.above_counts, "above"), (run.below_counts, "below"), (run.off_counts, "off"))
    for counts, relation in differences:
        if counts > VALVE_COUNTS:
            run.failures.append(f"a valve {counts:.0f} counts {relation} its set-point")
    if valves.largest_duty_before(trace) > 0:
        run.failures.append("a valve was open before the first set-point")
    if not desired_error(trace) <= DESIRED_ERROR:
        run.failures.append("the logged desired configurations are not the task's")
    if trace.outputs.duty[-1:].any():
        run.failures.append("a valve was left open")


def _compare_outputs(run: SoakRun, trace: record.Record, stopped_ns: int) -> None:
    """Sets above_counts, below_counts and off_counts of the run."""
    low = high = np.zeros(trace.outputs.duty.shape[1])
    acknowledged = [True, *~np.isnan(trace.acknowledged_ms), False]

    def counts_between(start_ns: int, end_ns: int) -> Array:
        return trace.outputs.between(start_ns, end_ns) * trace.outputs.counts

    for span, received in zip(valves.spans(trace), acknowledged, strict=True):
        # A set-point without acknowledgement may not have arrived: then the one before is still in force.
        low, high = np.minimum(low, span.commanded), np.maximum(high, span.commanded)
        until_ns = min(span.until_ns, stopped_ns)
        run.above_counts = max(run.above_counts, float(np.max(counts_between(span.from_ns, span.until_ns) - high)))
        if span.from_ns < stopped_ns:
            run.below_counts = max(run.below_counts, float(np.max(low - counts_between(span.from_ns, until_ns))))
        if received and span.settled_ns < until_ns:
            settled = counts_between(span.settled_ns, until_ns)
            run.off_counts = max(run.off_counts, float(np.max(np.abs(settled - span.commanded))))
            low = high = span.commanded
