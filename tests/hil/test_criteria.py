"""The criteria: the reference run meets all of them, and each fault planted in it violates its own criterion only."""

import math
from dataclasses import replace

import numpy as np
import pytest
from reference_run import COUNTS, PERIOD_NS, START_NS, TICKS, outputs_at, reference_run, slewed, with_output

from modsoft.hil import criteria
from modsoft.hil.criteria import assess
from modsoft.hil.valves import valve_difference
from modsoft.runtime.control.features import bending_angle_deg, from_angles_deg


@pytest.fixture
def reference():
    return reference_run()


def unmet(assessment):
    return [line.name for line in assessment.criteria if not line.met]


def test_reference_run_passes(reference):
    assessment = assess(reference)
    assert unmet(assessment) == []
    assert str(assessment) == "passed"
    assert assessment.exit_code == 0


def with_value(array, index, value):
    array = array.copy()
    array[index] = value
    return array


def other_duty(record, shift, rows=slice(60, 61), channel=0):
    """The outputs with one channel shifted by `shift` counts in some rows."""
    duty = record.outputs.duty.copy()
    duty[rows, channel] += shift / COUNTS
    return record.outputs._replace(duty=duty)


def unsettled(record):
    """A change of one channel by three counts for 10 ms in the middle of a settled tick."""
    at = record.mono_ns[50] + 300_000_000
    row = int(np.searchsorted(record.outputs.mono_ns, at))
    glitch = record.outputs.duty[row - 1].copy()
    glitch[3] += 3 / COUNTS
    return outputs_at(
        np.insert(record.outputs.mono_ns, row, [at, at + 10_000_000]),
        np.insert(record.outputs.duty, row, [glitch, record.outputs.duty[row - 1]], axis=0),
    )


def slower(valves):
    """The same outputs at half the slew: the time since a tick is twice as long."""
    since = (valves.mono_ns - START_NS) % PERIOD_NS
    return outputs_at(valves.mono_ns + since, valves.duty)


def late_valves(record):
    """Every change of an output 250 ms later."""
    return outputs_at(record.outputs.mono_ns + 250_000_000, record.outputs.duty)


DIFFERENCE = "valve outputs: largest difference from the settled set-point"
OUTSIDE = "valve outputs: largest distance outside old and new set-point"
LARGEST = "largest valve output"
BEFORE = "largest duty before the first set-point"
VENTED = "all valve outputs at 0, after the vent began"
P_MAX_COUNTS = 0.35 / 3 * COUNTS  # 477.9

# Faults of the outputs: each violates the criteria named with it, and no other.
OUTPUT_FAULTS = {
    "full duty for 2 s before anything": (
        lambda r: with_output(r, r.start_ns - 3_000_000_000, r.start_ns - 1_000_000_000, COUNTS),
        {BEFORE, LARGEST},
    ),
    "a count just before the first set-point": (
        lambda r: with_output(r, r.start_ns - 2_000_000, r.start_ns - 1_000_000, 1),
        {BEFORE},
    ),
    "full duty for 10 ms, 12 ms after a tick": (
        lambda r: with_output(r, r.mono_ns[60] + 12_000_000, r.mono_ns[60] + 22_000_000, COUNTS),
        {OUTSIDE, LARGEST},
    ),
    "the largest pressure for 10 ms, 12 ms after a tick": (
        lambda r: with_output(r, r.mono_ns[60] + 12_000_000, r.mono_ns[60] + 22_000_000, 478, channel=4),
        {OUTSIDE},
    ),
    "two counts above the first set-point, on the way to it": (
        lambda r: with_output(r, r.start_ns + 12_000_000, r.start_ns + 22_000_000, round(0.08 / 3 * COUNTS) + 2),
        {OUTSIDE},
    ),
    "open again for 0.9 s after the vent": (
        lambda r: with_output(r, r.end_ns + 400_000_000, r.end_ns + 1_300_000_000, 300),
        {OUTSIDE, VENTED},
    ),
    "one count again after the vent": (
        lambda r: with_output(r, r.end_ns + 400_000_000, r.end_ns + 401_000_000, 1),
        {VENTED},
    ),
    "one count that stays": (lambda r: other_duty(r, 1, rows=slice(-1, None)), {VENTED}),
    "vented too late": (lambda r: with_output(r, r.end_ns + 1_000_000, r.end_ns + 240_000_000, 1), {VENTED}),
}

FAULTS = {
    "exit code of modsoft-runtime": lambda r: {"runtime_exit": 79},
    "ticks": lambda r: {"reference": np.concatenate([r.reference, r.reference[-1:]])},
    "desired configurations: difference from the task's": lambda r: {
        "desired": with_value(r.desired, (70, 1, 0), r.desired[70, 1, 0] + 2e-9)
    },
    "missed ticks": lambda r: {"missed": 1},
    "held ticks: no valid tracker frame": lambda r: {"held": 1},
    "lateness of a tick, 99th percentile": lambda r: {"lateness_ms": with_value(r.lateness_ms, slice(0, 2), 20.0)},
    "set-points without acknowledgement": lambda r: {"acknowledged_ms": with_value(r.acknowledged_ms, 7, math.nan)},
    "set-point to acknowledgement, 99th percentile": lambda r: {
        "acknowledged_ms": with_value(r.acknowledged_ms, slice(0, 2), 51.0)
    },
    "faults of the board": lambda r: {"faults": with_value(r.faults, 40, 4)},
    "ticks with the board not RUNNING": lambda r: {"state": [*r.state[:-1], "FAULT"]},
    "resets in the run": lambda r: {
        "board_events": [*r.board_events, {"event": "reset", "cause": "external", "mono_ns": r.mono_ns[9]}]
    },
    "watchdog resets": lambda r: {"board_events": [{"event": "watchdog", "mono_ns": r.mono_ns[0] - 1}]},
    "bytes dropped by the board's receiver": lambda r: {"board_dropped_bytes": 1},
    "vented, as reported by the board": lambda r: {"reported_vented": False},
    "highest chamber pressure at the end": lambda r: {"plant_bar": with_value(r.plant_bar, (-1, 2, 1), 0.05)},
    "ticks without time for the valves to settle": lambda r: {
        "acknowledged_ms": with_value(r.acknowledged_ms, 60, 400.0)
    },
    "measured configuration: angle to the simulated robot's": lambda r: {
        "plant_configuration": from_angles_deg(np.full((len(r.plant_mono_ns), 3), 60.0))
    },
}


@pytest.mark.parametrize("name", FAULTS)
def test_each_fault_violates_its_own_criterion(reference, name):
    assessment = assess(replace(reference, **FAULTS[name](reference)))
    assert unmet(assessment) == [name]
    assert assessment.outcome == "failed"
    assert name in assessment.reason
    assert assessment.exit_code == 1


def test_each_criterion_has_a_fault(reference):
    tracking = {f"tracking error of module {module}, mean" for module in (1, 2, 3)}  # see below
    of_outputs = {line for _, lines in OUTPUT_FAULTS.values() for line in lines}
    assert {line.name for line in assess(reference).criteria} == {*FAULTS, DIFFERENCE, *of_outputs, *tracking}


@pytest.mark.parametrize("name", OUTPUT_FAULTS)
def test_output_faults_violate_their_criteria(reference, name):
    valves, lines = OUTPUT_FAULTS[name]
    assessment = assess(replace(reference, outputs=valves(reference)))
    assert set(unmet(assessment)) == lines
    assert assessment.outcome == "failed"


def test_output_before_the_first_set_point_fails(reference):
    assessment = assess(replace(reference, start_ns=None))
    assert BEFORE in unmet(assessment)


def test_other_task_fails(reference):
    assessment = assess(replace(reference, reference=-reference.reference))
    assert unmet(assessment) == ["desired configurations: difference from the task's"]
    longer = assess(replace(reference, reference=reference.reference[:-1]))
    assert set(unmet(longer)) == {"ticks", "desired configurations: difference from the task's"}


def test_slower_board_has_its_time_to_settle(reference):
    """Its ramps take twice as long as with the slew of the robot file."""
    far = np.where(np.arange(TICKS)[:, None] % 2, 0.35, 0.08) * (np.arange(12) < 6)
    valves, end = slewed(reference.start_bar, far)
    half = replace(reference, commanded_bar=far, outputs=slower(valves), end_ns=end, end_us=end * 1e-3)
    assert DIFFERENCE in unmet(assess(half))
    assert unmet(assess(replace(half, slew_bar_per_s=1.0))) == []


@pytest.mark.parametrize("valves", [unsettled, late_valves, lambda r: other_duty(r, 2, rows=slice(0, -1))])
def test_outputs_that_do_not_follow_the_log_fail(reference, valves):
    assert DIFFERENCE in unmet(assess(replace(reference, outputs=valves(reference))))


def test_swapped_channels_fail(reference):
    duty = reference.outputs.duty[:, [1, 0, *range(2, 12)]]
    assert set(unmet(assess(replace(reference, outputs=reference.outputs._replace(duty=duty))))) == {
        DIFFERENCE,
        OUTSIDE,
    }


def test_every_tick_is_compared(reference):
    assert np.isfinite(valve_difference(reference)).all()
    assert np.nanmax(valve_difference(reference)) <= 0.5


def test_one_count_of_rounding_passes(reference):
    """The reference outputs contain half a count of rounding; the firmware may add another half."""
    duty = reference.outputs.duty.copy()
    duty[:-1] += 0.4 / COUNTS
    assert assess(replace(reference, outputs=reference.outputs._replace(duty=duty))).outcome == "passed"


def test_slow_host_voids_timing_only(reference):
    slow = {"board_late_ms": 180.0}
    assessment = assess(replace(reference, **slow, lateness_ms=np.full(TICKS, 60.0), missed=3))
    assert assessment.outcome == "inconclusive"
    assert assessment.exit_code == 3
    assert "the host was too slow" in assessment.reason
    assert "180 ms" in assessment.reason
    worse = assess(replace(reference, **slow, faults=with_value(reference.faults, 3, 1)))
    assert worse.outcome == "failed"


def test_many_short_stalls_are_a_slow_host(reference):
    assessment = assess(replace(reference, board_late_ms=30.0, board_slipped_percent=0.6))
    assert assessment.outcome == "inconclusive"
    assert "stalls" in assessment.reason


def test_slow_simulated_robot_is_a_slow_host(reference):
    late = with_value(reference.plant_late_ms, 70, 200.0)
    assert assess(replace(reference, plant_late_ms=late)).outcome == "inconclusive"


def test_short_run_is_inconclusive(reference):
    short = {
        name: getattr(reference, name)[:50]
        for name in "tick mono_ns lateness_ms desired configuration frame_mono_ns commanded_bar acknowledged_ms".split()
    }
    record = replace(
        reference, **short, reference=reference.reference[:50], faults=reference.faults[:50], state=reference.state[:50]
    )
    valves, end = slewed(reference.start_bar, reference.commanded_bar[:50])
    assessment = assess(replace(record, outputs=valves, end_ns=end, end_us=end * 1e-3))
    assert unmet(assessment) == []
    assert assessment.outcome == "inconclusive"
    assert "at least 100" in assessment.reason


def test_run_without_a_tick_fails(reference):
    empty = {
        name: getattr(reference, name)[:0]
        for name in "tick mono_ns lateness_ms desired configuration frame_mono_ns commanded_bar acknowledged_ms".split()
    }
    assessment = assess(replace(reference, **empty, runtime_exit=65, faults=reference.faults[:0], state=[]))
    assert assessment.outcome == "failed"
    assert "exit code of modsoft-runtime" in unmet(assessment)
    assert "ticks" in unmet(assessment)


def test_tracking_has_limits_by_task_and_modules(reference, monkeypatch):
    monkeypatch.setitem(criteria.TRACKING_DEG, ("down", 3), [1.0, 2.0, 3.0])
    assert assess(reference).outcome == "passed"
    off = reference.configuration.copy()
    off[:, 1] = from_angles_deg(bending_angle_deg(reference.desired[:, 1]) + 2.1)
    plant = np.repeat(off, 20, axis=0)
    assessment = assess(
        replace(
            reference,
            configuration=off,
            plant_configuration=plant,
            plant_mono_ns=START_NS + np.arange(len(plant)) * 20_000_000,
            frame_mono_ns=reference.mono_ns,
            plant_bar=np.zeros((len(plant), 3, 2)),
        )
    )
    assert unmet(assessment) == ["tracking error of module 2, mean"]


def test_percentiles_are_measured_values():
    assert criteria.p99(np.array([1.0, 2.0, 50.0])) == 50.0
    assert math.isnan(criteria.p99(np.array([])))


@pytest.fixture
def real_board(monkeypatch):
    """The reference run with a real board: a STATUS, in 10 Pa, takes the place of each change of a register."""
    monkeypatch.setattr("reference_run.COUNTS", 30_000)
    return replace(reference_run(), sees_registers=False, outputs_age_ms=120.0, board_late_ms=math.nan)


def test_run_with_a_real_board_passes_without_what_it_cannot_see(real_board):
    unseen = replace(real_board, board_dropped_bytes=math.nan, board_slipped_percent=math.nan)
    assessment = assess(unseen)
    assert str(assessment) == "passed"
    not_seen = {line.name for line in assessment.criteria if line.met is None}
    assert {line.measured for line in assessment.criteria if line.met is None} == {"not seen"}
    assert {"largest valve output", "resets in the run", "watchdog resets"} < not_seen
    assert len(not_seen) == 9
    assert [line.name for line in assessment.host_load_checks] == ["simulated robot behind real time"]


def test_real_board_that_reports_another_pressure_fails(real_board):
    off = real_board.outputs._replace(duty=real_board.outputs.duty + 5 / 30_000)
    assessment = assess(replace(real_board, outputs=off))
    assert "applied pressures, as reported: largest difference from the settled set-point 0.5" in assessment.reason
    assert "applied pressures, as reported: all 0, after the vent began inf ms" in assessment.reason
    assert "valve outputs" not in assessment.reason


def test_limits_of_measured_angles_include_the_noise_of_the_tracker(reference):
    limits = {line.name: line.limit for line in criteria.robot_criteria(reference)}
    noisy = {line.name: line.limit for line in criteria.robot_criteria(replace(reference, noise_deg=0.5))}
    assert limits["measured configuration: angle to the simulated robot's"] == "at most 1°"
    assert noisy["measured configuration: angle to the simulated robot's"] == "at most 5.24264°"
    assert limits["tracking error of module 1, mean"] == "at most 0.5°"
    assert noisy["tracking error of module 1, mean"] == "at most 1.20711°"
