"""The verdict on a run of the rig: one line for each acceptance, from the run log, the timer registers and the plant.

The sources are independent of each other: what the runtime says it did (`run.jsonl`), what the emulated board's timer
registers held (`board.jsonl`), and where the simulated robot really was (`plant.jsonl`). Nothing here reads a clock
or a file; `modsoft.hil.record` does.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

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
from modsoft.runtime.control.features import angle_between_deg, bending_error_deg
from modsoft.runtime.statistics import spread

# ---- What a run has to show -------------------------------------------------------------------------------------

FEWEST_TICKS = 100  # below it a 99th percentile says nothing
MISSED_TICKS = 0
HELD_TICKS = 0
LATENESS_P99_MS = 20.0
VALVE_COUNTS = 1.0  # of the timer: a set-point is rounded to counts once
DROPPED_BYTES = 0
CHAMBERS_AT_END_BAR = 0.02
DESIRED_OFF = 1e-9  # of a component: the log rounds to nine digits
MEASURED_OFF_DEG = 1.0  # the tracker rounds, and its frame is up to 40 ms old while the robot moves
# Mean tracking error of each module, degrees, by task and number of modules: about twice what four minutes of training
# on three modules were measured to reach: down 0.05 1.03 1.88 and 0.95 1.81, edge 0.10 0.58 3.11 and 0.74 2.51.
TRACKING_DEG: dict[tuple[str, int], list[float]] = {
    ("down", 3): [0.5, 2.5, 4.0],
    ("edge", 3): [0.5, 1.5, 6.0],
    ("down", 2): [2.0, 3.5],
    ("edge", 2): [1.5, 5.0],
}
# Limits of the host-load checks: beyond these the timing says more about the host than about the software. A stall
# of the board lengthens the acknowledgements that are judged and spares its own time-outs: one heartbeat of it (100 ms;
# the shortest time-out is 300 ms) hides nothing. The plant catches up; a quarter of a control period is still in time.
BOARD_LATE_MS = 100.0
BOARD_SLIPPED_PERCENT = 0.5  # of the run, in stalls
PLANT_LATE_MS = 100.0


class Criterion(NamedTuple):
    """One line of the verdict. `timing` lines are void on a host that did not keep up."""

    name: str
    found: str
    limit: str
    ok: bool
    timing: bool = False


class Verdict(NamedTuple):
    """`word`: passed, failed, or not judged; `reason` says why where it is not passed."""

    word: str
    reason: str
    criteria: list[Criterion]
    host_load_checks: list[Criterion]

    @property
    def exit_code(self) -> int:
        return {"passed": 0, "failed": 1, "not judged": 3}[self.word]

    def __str__(self) -> str:
        return f"{self.word}: {self.reason}" if self.reason else self.word


# ---- Figures ------------------------------------------------------------------------------------------------------


def p99(values: Array) -> float:
    """The measured value that 99 percent do not exceed. NaN of nothing."""
    found = spread(list(values))
    return found["p99"] if found else math.nan


def tracking_error_deg(record: Record) -> Array:
    """|bending angle measured at the start of tick k - desired angle of tick k|, (K, N): the paper's convention."""
    return bending_error_deg(record.configuration, record.desired)


def desired_off(record: Record) -> float:
    """Largest difference of a component of the logged desired configurations from the task's own, by tick."""
    if np.any(record.tick >= record.steps):
        return math.inf
    return _worst(np.abs(record.desired - record.asked[record.tick]))


def measured_off_deg(record: Record) -> Array:
    """Angle (K, N) between the configuration that the runtime used and the plant's own when that frame came in."""
    plant, when = record.plant_configuration, record.plant_mono_ns
    at = np.clip(np.searchsorted(when, record.frame_mono_ns), 1, len(when) - 1)
    share = (record.frame_mono_ns - when[at - 1]) / (when[at] - when[at - 1])
    share = np.clip(share, 0.0, 1.0)[:, None, None]
    return angle_between_deg(record.configuration, (1 - share) * plant[at - 1] + share * plant[at])


# ---- Verdict ------------------------------------------------------------------------------------------------------


def at_most(name: str, found: float, limit: float, unit: str = "", timing: bool = False) -> Criterion:
    """A line that holds when found <= limit; NaN never holds."""
    words = f"at most {limit:g}{unit}" if limit else "0"
    return Criterion(name, f"{found:.3g}{unit}", words, bool(found <= limit), timing)


def criteria(record: Record) -> list[Criterion]:
    """Every acceptance of the run, timing ones marked."""
    count = len(record.tick)
    late_ms = p99(record.lateness_ms)
    unacknowledged = int(np.isnan(record.acknowledged_ms).sum())
    acknowledged = record.acknowledged_ms[~np.isnan(record.acknowledged_ms)]
    differences = valve_difference(record)
    highest = float(np.max(record.outputs.duty, initial=0.0)) * record.outputs.counts
    allowed = round(record.robot.valve.p_max_bar * full_counts_per_bar(record), 2) if record.robot.valve else 0.0
    running = [event for event in record.board_events if count and event["mono_ns"] >= record.mono_ns[0]]
    watchdogs = sum(event["event"] == "watchdog" for event in record.board_events)
    faulty = [f"0x{value:04x}" for value in np.unique(record.faults[record.faults != 0])]
    not_running = [state for state in record.state if state != "RUNNING"]
    lines = [
        Criterion("exit code of modsoft-runtime", str(record.runtime_exit), "0", record.runtime_exit == 0),
        Criterion("ticks", str(count), str(record.steps), count == record.steps),
        at_most("desired configurations off the task's own", desired_off(record), DESIRED_OFF),
        at_most("missed ticks", record.missed, MISSED_TICKS, timing=True),
        at_most("ticks held for want of a good tracker frame", record.held, HELD_TICKS, timing=True),
        Criterion(
            "lateness of a tick, 99th percentile",
            f"{late_ms:.2f} ms",
            f"below {LATENESS_P99_MS:g} ms",
            late_ms < LATENESS_P99_MS,
            True,
        ),
        at_most("set-points never acknowledged", unacknowledged, 0, timing=True),
        at_most(
            "set-point to acknowledgement, 99th percentile", p99(acknowledged), ACKNOWLEDGED_P99_MS, " ms", timing=True
        ),
        at_most(
            "valve outputs off the log, worst of every tick and channel", _worst(differences), VALVE_COUNTS, " counts"
        ),
        at_most(
            "valve outputs outside old and new set-point, worst of all times and channels",
            _worst(valve_excursion(record)),
            VALVE_COUNTS,
            " counts",
        ),
        at_most("largest valve output ever", highest, allowed + VALVE_COUNTS, " counts"),
        at_most("largest duty before the first set-point", largest_duty_before(record), 0.0),
        at_most("ticks without time for the valves to settle", int(np.isnan(differences).sum()), 0),
        Criterion("faults of the board", ", ".join(faulty) or "none", "none", not faulty),
        at_most("ticks that the board did not follow", len(not_running), 0),
        at_most("resets in the run", sum(event["event"] == "reset" for event in running), 0),
        at_most("watchdog resets", watchdogs, 0),
        at_most("bytes dropped by the board's receiver", record.board_dropped_bytes, DROPPED_BYTES),
        Criterion("the board's word that it vented", "yes" if record.said_vented else "no", "yes", record.said_vented),
        at_most(
            "valve outputs at 0 permanently, after the vent began",
            record.outputs.vented_after_ms(record.end_us),
            vent_limit_ms(record),
            " ms",
        ),
        at_most(
            "highest chamber pressure at the end",
            float(np.max(record.plant_bar[-1])) if len(record.plant_bar) else math.nan,
            CHAMBERS_AT_END_BAR,
            " bar",
        ),
    ]
    if count and len(record.plant_mono_ns) > 1:
        off = measured_off_deg(record)
        lines.append(at_most("configuration used, off the plant's own", _worst(off), MEASURED_OFF_DEG, "°"))
        mean = np.nanmean(tracking_error_deg(record), axis=0)
        for module, limit in enumerate(TRACKING_DEG.get((record.task, record.robot.modules), [])):
            name = f"tracking error of module {module + 1}, mean"
            lines.append(at_most(name, float(mean[module]), limit, "°", timing=True))
    else:
        lines.append(Criterion("configuration used, off the plant's own", "no ticks", "some", False))
    return lines


def host_load_checks(record: Record) -> list[Criterion]:
    """Whether the board and the plant were real time."""
    plant_ms = float(np.max(record.plant_late_ms)) if len(record.plant_late_ms) else math.nan
    return [
        at_most("emulated board behind real time, at most", record.board_late_ms, BOARD_LATE_MS, " ms"),
        at_most("run lost to stalls of the board", record.board_slipped_percent, BOARD_SLIPPED_PERCENT, " %"),
        at_most("simulated robot behind real time, at most", plant_ms, PLANT_LATE_MS, " ms"),
    ]


def judge(record: Record) -> Verdict:
    """Passed only when every acceptance holds on a host that kept up, in a run long enough to say so."""
    lines, seen = criteria(record), host_load_checks(record)
    slow = [line for line in seen if not line.ok]
    broken = [line for line in lines if not line.ok and not (line.timing and slow)]
    if broken:
        return Verdict("failed", "; ".join(f"{line.name} {line.found}" for line in broken), lines, seen)
    if slow:
        why = "; ".join(f"{line.name} {line.found} ({line.limit})" for line in slow)
        return Verdict("not judged", f"the host was too slow: {why}", lines, seen)
    if record.steps < FEWEST_TICKS:
        return Verdict("not judged", f"{record.steps} ticks, at least {FEWEST_TICKS} are needed", lines, seen)
    return Verdict("passed", "", lines, seen)


def _worst(values: Array) -> float:
    return float(np.nanmax(values)) if np.isfinite(values).any() else math.nan
