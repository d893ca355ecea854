"""The criteria that a run of the rig has to meet, from the run log, the timer registers and the simulated robot.

The three sources are independent: the runtime's log (`run.jsonl`), the emulated board's timer registers (`board.jsonl`)
and the state of the simulated robot (`plant.jsonl`). Nothing here reads a clock or a file; `modsoft.hil.record` does.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from modsoft.hil.record import Record
from modsoft.hil.valves import (
    ACKNOWLEDGED_P99_MS,
    full_counts_per_bar,
    largest_duty_before,
    valve_difference,
    valve_excursion,
    vent_limit_ms,
)
from modsoft.runtime.arrays import Array
from modsoft.runtime.clock import LATE_MS
from modsoft.runtime.control.features import angle_between_deg, error_deg
from modsoft.runtime.statistics import spread

# ---- Limits ----------------------------------------------------------------------------------------------------

MIN_TICKS = 100  # fewer give no 99th percentile
MISSED_TICKS = 0
HELD_TICKS = 0
LATENESS_P99_MS = LATE_MS
VALVE_COUNTS = 1.0  # of the timer: a set-point is rounded to counts once
APPLIED_UNITS = 1.0  # of the protocol, 10 Pa: a set-point is rounded to units once
DROPPED_BYTES = 0
CHAMBERS_AT_END_BAR = 0.02
DESIRED_ERROR = 1e-9  # of a component: the log rounds to nine digits
MEASUREMENT_ERROR_DEG = 1.0  # the tracker rounds, and its frame is up to 40 ms old while the robot moves
# A configuration is that of two tools, so its noise has a standard deviation of sqrt(2) times that of a tool.
LARGEST_BY_NOISE = 6.0 * math.sqrt(2.0)  # in a run, of the standard deviation of a tool
MEAN_BY_NOISE = math.sqrt(2.0)
# Mean tracking error of each module, degrees, by task and number of modules: about twice what four minutes of training
# on three modules were measured to reach: down 0.05 1.03 1.88 and 0.95 1.81, edge 0.10 0.58 3.11 and 0.74 2.51.
TRACKING_DEG: dict[tuple[str, int], list[float]] = {
    ("down", 3): [0.5, 2.5, 4.0],
    ("edge", 3): [0.5, 1.5, 6.0],
    ("down", 2): [2.0, 3.5],
    ("edge", 2): [1.5, 5.0],
}
# Limits of the host-load checks. Beyond them the timing depends on the host more than on the software. A stall of the
# board lengthens the measured acknowledgements and delays its own time-outs: a stall of one heartbeat (100 ms; the
# shortest time-out is 300 ms) hides no fault. The simulated robot catches up; a quarter of a control period is in time.
BOARD_LATE_MS = 100.0
BOARD_SLIPPED_PERCENT = 0.5  # of the run, in stalls
PLANT_LATE_MS = 100.0


class Criterion(NamedTuple):
    """One criterion with its measured value. `timing` criteria are void on a host that did not keep up. met: None where
    the run could not see the value."""

    name: str
    measured: str
    limit: str
    met: bool | None
    timing: bool = False


class Assessment(NamedTuple):
    """outcome: passed, failed, or inconclusive; reason: empty where the run passed."""

    outcome: str
    reason: str
    criteria: list[Criterion]
    host_load_checks: list[Criterion]

    @property
    def exit_code(self) -> int:
        return {"passed": 0, "failed": 1, "inconclusive": 3}[self.outcome]

    def __str__(self) -> str:
        return f"{self.outcome}: {self.reason}" if self.reason else self.outcome


# ---- Figures ------------------------------------------------------------------------------------------------------


def p99(values: Array) -> float:
    """The measured value that 99 percent do not exceed; NaN for no values."""
    figures = spread(list(values))
    return figures["p99"] if figures else math.nan


def tracking_error_deg(record: Record) -> Array:
    """Error (K, N) of the configuration measured at the start of tick k from that desired in tick k, degrees: the
    paper's convention. Of planar robots the difference of the bending angles."""
    return error_deg(record.configuration, record.desired, record.robot.motion)


def desired_error(record: Record) -> float:
    """Largest difference of a component of the logged desired configurations from those of the task."""
    if np.any(record.tick >= record.steps):
        return math.inf
    return _largest(np.abs(record.desired - record.reference[record.tick]))


def measurement_error_deg(record: Record) -> Array:
    """Angle (K, N) between the configuration that the runtime used and the simulated robot's at that frame's time."""
    return angle_between_deg(record.configuration, true_configuration(record, record.frame_mono_ns))


def true_configuration(record: Record, at_ns: NDArray[np.int64]) -> Array:
    """Configuration (T, N, 3) of the simulated robot at the times (T,), between its states in a straight line."""
    plant, times_ns = record.plant_configuration, record.plant_mono_ns
    after = np.clip(np.searchsorted(times_ns, at_ns), 1, len(times_ns) - 1)
    weight = (at_ns - times_ns[after - 1]) / (times_ns[after] - times_ns[after - 1])
    weight = np.clip(weight, 0.0, 1.0)[:, None, None]
    return (1 - weight) * plant[after - 1] + weight * plant[after]


def _largest(values: Array) -> float:
    return float(np.nanmax(values)) if np.isfinite(values).any() else math.nan


# ---- Criteria -----------------------------------------------------------------------------------------------------


def at_most(name: str, value: float, limit: float, unit: str = "", timing: bool = False) -> Criterion:
    """Met when value <= limit; never met by NaN."""
    limit_text = f"at most {limit:g}{unit}" if limit else "0"
    return Criterion(name, f"{value:.3g}{unit}", limit_text, bool(value <= limit), timing)


def criteria(record: Record) -> list[Criterion]:
    """Every criterion of the run."""
    return [*loop_criteria(record), *valve_criteria(record), *board_criteria(record), *robot_criteria(record)]


def loop_criteria(record: Record) -> list[Criterion]:
    """The control loop, from the run log."""
    count, late_ms = len(record.tick), p99(record.lateness_ms)
    missing = np.isnan(record.acknowledged_ms)
    acknowledged_ms = p99(record.acknowledged_ms[~missing])
    return [
        Criterion("exit code of modsoft-runtime", str(record.runtime_exit), "0", record.runtime_exit == 0),
        Criterion("ticks", str(count), str(record.steps), count == record.steps),
        at_most("desired configurations: difference from the task's", desired_error(record), DESIRED_ERROR),
        at_most("missed ticks", record.missed, MISSED_TICKS, timing=True),
        at_most("held ticks: no valid tracker frame", record.held, HELD_TICKS, timing=True),
        Criterion(
            "lateness of a tick, 99th percentile",
            f"{late_ms:.2f} ms",
            f"below {LATENESS_P99_MS:g} ms",
            late_ms < LATENESS_P99_MS,
            True,
        ),
        at_most("set-points without acknowledgement", int(missing.sum()), 0, timing=True),
        at_most(
            "set-point to acknowledgement, 99th percentile", acknowledged_ms, ACKNOWLEDGED_P99_MS, " ms", timing=True
        ),
    ]


def not_seen(line: Criterion) -> Criterion:
    """The criterion in a run that cannot see its value."""
    return line._replace(measured="not seen", met=None)


def valve_criteria(record: Record) -> list[Criterion]:
    """The valve outputs against the logged set-points: from the timer registers, or, with a real board, from its
    reports; and the venting that it reports."""
    vented = Criterion("vented, as reported by the board", _yes(record.reported_vented), "yes", record.reported_vented)
    if record.sees_registers:
        return [*register_criteria(record), vented]
    return [*map(not_seen, register_criteria(record)), *reported_criteria(record), vented]


def reported_criteria(record: Record) -> list[Criterion]:
    """The applied pressures that a real board reports, against the logged set-points. A count is 10 Pa."""
    assert record.robot.valve is not None  # the rig runs no other robots
    scale_bar = record.robot.valve.full_scale_bar / record.outputs.counts
    in_bar = {
        "largest difference from the settled set-point": _largest(valve_difference(record)),
        "largest distance outside old and new set-point": _largest(valve_excursion(record)),
        "largest before the first set-point": largest_duty_before(record) * record.outputs.counts,
    }
    name, limit = "applied pressures, as reported", f"at most {APPLIED_UNITS * scale_bar * 1e3:g} mbar"
    lines = [
        Criterion(f"{name}: {what}", f"{units * scale_bar * 1e3:.3g} mbar", limit, bool(units <= APPLIED_UNITS))
        for what, units in in_bar.items()
    ]
    vented_ms = record.outputs.vented_after_ms(record.end_us)
    return [*lines, at_most(f"{name}: all 0, after the vent began", vented_ms, vent_limit_ms(record), " ms")]


def register_criteria(record: Record) -> list[Criterion]:
    """The valve outputs, from the timer registers."""
    differences = valve_difference(record)
    highest = float(np.max(record.outputs.duty, initial=0.0)) * record.outputs.counts
    allowed = round(record.robot.valve.p_max_bar * full_counts_per_bar(record), 2) if record.robot.valve else 0.0
    vented_ms = record.outputs.vented_after_ms(record.end_us)
    return [
        at_most(
            "valve outputs: largest difference from the settled set-point",
            _largest(differences),
            VALVE_COUNTS,
            " counts",
        ),
        at_most(
            "valve outputs: largest distance outside old and new set-point",
            _largest(valve_excursion(record)),
            VALVE_COUNTS,
            " counts",
        ),
        at_most("largest valve output", highest, allowed + VALVE_COUNTS, " counts"),
        at_most("largest duty before the first set-point", largest_duty_before(record), 0.0),
        at_most("ticks without time for the valves to settle", int(np.isnan(differences).sum()), 0),
        at_most("all valve outputs at 0, after the vent began", vented_ms, vent_limit_ms(record), " ms"),
    ]


def board_criteria(record: Record) -> list[Criterion]:
    """Faults, resets and losses of the board."""
    count = len(record.tick)
    in_run = [event for event in record.board_events if count and event["mono_ns"] >= record.mono_ns[0]]
    watchdogs = sum(event["event"] == "watchdog" for event in record.board_events)
    faults = [f"0x{value:04x}" for value in np.unique(record.faults[record.faults != 0])]
    not_running = [state for state in record.state if state != "RUNNING"]
    reported = [
        Criterion("faults of the board", ", ".join(faults) or "none", "none", not faults),
        at_most("ticks with the board not RUNNING", len(not_running), 0),
    ]
    emulated = [
        at_most("resets in the run", sum(event["event"] == "reset" for event in in_run), 0),
        at_most("watchdog resets", watchdogs, 0),
        at_most("bytes dropped by the board's receiver", record.board_dropped_bytes, DROPPED_BYTES),
    ]
    return [*reported, *(emulated if record.sees_registers else map(not_seen, emulated))]


def robot_criteria(record: Record) -> list[Criterion]:
    """The simulated robot: pressures at the end, measured configurations, tracking errors of the shipped tasks."""
    pressure_bar = float(np.max(record.plant_bar[-1])) if len(record.plant_bar) else math.nan
    lines = [at_most("highest chamber pressure at the end", pressure_bar, CHAMBERS_AT_END_BAR, " bar")]
    name = "measured configuration: angle to the simulated robot's"
    if not len(record.tick) or len(record.plant_mono_ns) < 2:
        return [*lines, Criterion(name, "no ticks", f"at most {MEASUREMENT_ERROR_DEG:g}°", False)]
    largest_deg = MEASUREMENT_ERROR_DEG + LARGEST_BY_NOISE * record.noise_deg
    lines.append(at_most(name, _largest(measurement_error_deg(record)), largest_deg, "°"))
    mean_deg = np.nanmean(tracking_error_deg(record), axis=0)
    for module, limit in enumerate(TRACKING_DEG.get((record.task, record.robot.modules), [])):
        name = f"tracking error of module {module + 1}, mean"
        limit_deg = limit + MEAN_BY_NOISE * record.noise_deg
        lines.append(at_most(name, float(mean_deg[module]), limit_deg, "°", timing=True))
    return lines


def _yes(value: bool) -> str:
    return "yes" if value else "no"


def host_load_checks(record: Record) -> list[Criterion]:
    """Whether the board and the simulated robot ran in real time."""
    plant_ms = float(np.max(record.plant_late_ms)) if len(record.plant_late_ms) else math.nan
    plant = at_most("simulated robot behind real time", plant_ms, PLANT_LATE_MS, " ms")
    if not record.sees_registers:  # a real board is always in real time
        return [plant]
    return [
        at_most("emulated board behind real time", record.board_late_ms, BOARD_LATE_MS, " ms"),
        at_most("time lost to stalls of the board", record.board_slipped_percent, BOARD_SLIPPED_PERCENT, " %"),
        plant,
    ]


def assess(record: Record) -> Assessment:
    """Passed when every criterion that the run could see is met, on a host that kept up, in a run of at least
    `MIN_TICKS`."""
    lines, host_load = criteria(record), host_load_checks(record)
    slow = [line for line in host_load if not line.met]
    unmet = [line for line in lines if line.met not in (True, None) and not (line.timing and slow)]
    if unmet:
        return Assessment("failed", "; ".join(f"{line.name} {line.measured}" for line in unmet), lines, host_load)
    if slow:
        reason = "; ".join(f"{line.name} {line.measured} ({line.limit})" for line in slow)
        return Assessment("inconclusive", f"the host was too slow: {reason}", lines, host_load)
    if record.steps < MIN_TICKS:
        reason = f"{record.steps} ticks, at least {MIN_TICKS} are needed"
        return Assessment("inconclusive", reason, lines, host_load)
    return Assessment("passed", "", lines, host_load)
