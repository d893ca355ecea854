"""The verdict: a made-up flawless run passes, and every flaw planted in it breaks its own line and no other."""

import math
from dataclasses import replace

import numpy as np
import pytest
from flawless import COUNTS, PERIOD_NS, START_NS, TICKS, flawless_run, outputs_at, slewed, told

from modsoft.hil import criteria as judging
from modsoft.hil.criteria import judge
from modsoft.hil.valves import valve_difference
from modsoft.runtime.control.features import bending_angle_deg, from_angles_deg


@pytest.fixture
def flawless():
    return flawless_run()


def broken(verdict):
    return [line.name for line in verdict.criteria if not line.ok]


def test_a_flawless_run_passes(flawless):
    verdict = judge(flawless)
    assert broken(verdict) == []
    assert str(verdict) == "passed"
    assert verdict.exit_code == 0


def changed(array, index, value):
    array = array.copy()
    array[index] = value
    return array


def other_duty(record, shift, rows=slice(60, 61), channel=0):
    """The registers of one channel off by `shift` counts for some rows."""
    duty = record.outputs.duty.copy()
    duty[rows, channel] += shift / COUNTS
    return record.outputs._replace(duty=duty)


def unsettled(record):
    """A change of one channel by three counts in the middle of a settled tick, taken back 10 ms later."""
    at = record.mono_ns[50] + 300_000_000
    row = int(np.searchsorted(record.outputs.mono_ns, at))
    glitch = record.outputs.duty[row - 1].copy()
    glitch[3] += 3 / COUNTS
    return outputs_at(
        np.insert(record.outputs.mono_ns, row, [at, at + 10_000_000]),
        np.insert(record.outputs.duty, row, [glitch, record.outputs.duty[row - 1]], axis=0),
    )


def slower(valves):
    """The same registers, at half the slew: the time since a tick twice as long."""
    since = (valves.mono_ns - START_NS) % PERIOD_NS
    return outputs_at(valves.mono_ns + since, valves.duty)


def late_valves(record):
    """Every change 250 ms later than commanded."""
    return outputs_at(record.outputs.mono_ns + 250_000_000, record.outputs.duty)


OFF_THE_LOG = "valve outputs off the log, worst of every tick and channel"
OUTSIDE = "valve outputs outside old and new set-point, worst of all times and channels"
LARGEST = "largest valve output ever"
BEFORE = "largest duty before the first set-point"
VENTED = "valve outputs at 0 permanently, after the vent began"
P_MAX_COUNTS = 0.35 / 3 * COUNTS  # 477.9

# Of the registers: each breaks the lines named with it, and no other.
WILD = {
    "full duty for 2 s before anything": (
        lambda r: told(r, r.start_ns - 3_000_000_000, r.start_ns - 1_000_000_000, COUNTS),
        {BEFORE, LARGEST},
    ),
    "a count just before the first set-point": (
        lambda r: told(r, r.start_ns - 2_000_000, r.start_ns - 1_000_000, 1),
        {BEFORE},
    ),
    "full duty for 10 ms, 12 ms after a tick": (
        lambda r: told(r, r.mono_ns[60] + 12_000_000, r.mono_ns[60] + 22_000_000, COUNTS),
        {OUTSIDE, LARGEST},
    ),
    "the largest pressure for 10 ms, 12 ms after a tick": (
        lambda r: told(r, r.mono_ns[60] + 12_000_000, r.mono_ns[60] + 22_000_000, 478, channel=4),
        {OUTSIDE},
    ),
    "two counts above the first set-point, on the way to it": (
        lambda r: told(r, r.start_ns + 12_000_000, r.start_ns + 22_000_000, round(0.08 / 3 * COUNTS) + 2),
        {OUTSIDE},
    ),
    "open again for 0.9 s after the vent": (
        lambda r: told(r, r.end_ns + 400_000_000, r.end_ns + 1_300_000_000, 300),
        {OUTSIDE, VENTED},
    ),
    "one count again after the vent": (lambda r: told(r, r.end_ns + 400_000_000, r.end_ns + 401_000_000, 1), {VENTED}),
    "one count that stays": (lambda r: other_duty(r, 1, rows=slice(-1, None)), {VENTED}),
    "vented too late": (lambda r: told(r, r.end_ns + 1_000_000, r.end_ns + 240_000_000, 1), {VENTED}),
}

FLAWS = {
    "exit code of modsoft-runtime": lambda r: {"runtime_exit": 79},
    "ticks": lambda r: {"asked": np.concatenate([r.asked, r.asked[-1:]])},
    "desired configurations off the task's own": lambda r: {
        "desired": changed(r.desired, (70, 1, 0), r.desired[70, 1, 0] + 2e-9)
    },
    "missed ticks": lambda r: {"missed": 1},
    "ticks held for want of a good tracker frame": lambda r: {"held": 1},
    "lateness of a tick, 99th percentile": lambda r: {"lateness_ms": changed(r.lateness_ms, slice(0, 2), 20.0)},
    "set-points never acknowledged": lambda r: {"acknowledged_ms": changed(r.acknowledged_ms, 7, math.nan)},
    "set-point to acknowledgement, 99th percentile": lambda r: {
        "acknowledged_ms": changed(r.acknowledged_ms, slice(0, 2), 51.0)
    },
    "faults of the board": lambda r: {"faults": changed(r.faults, 40, 4)},
    "ticks that the board did not follow": lambda r: {"state": [*r.state[:-1], "FAULT"]},
    "resets in the run": lambda r: {
        "board_events": [*r.board_events, {"event": "reset", "cause": "external", "mono_ns": r.mono_ns[9]}]
    },
    "watchdog resets": lambda r: {"board_events": [{"event": "watchdog", "mono_ns": r.mono_ns[0] - 1}]},
    "bytes dropped by the board's receiver": lambda r: {"board_dropped_bytes": 1},
    "the board's word that it vented": lambda r: {"said_vented": False},
    "highest chamber pressure at the end": lambda r: {"plant_bar": changed(r.plant_bar, (-1, 2, 1), 0.05)},
    "ticks without time for the valves to settle": lambda r: {"acknowledged_ms": changed(r.acknowledged_ms, 60, 400.0)},
    "configuration used, off the plant's own": lambda r: {
        "plant_configuration": from_angles_deg(np.full((len(r.plant_mono_ns), 3), 60.0))
    },
}


@pytest.mark.parametrize("name", FLAWS)
def test_each_flaw_breaks_its_own_line(flawless, name):
    verdict = judge(replace(flawless, **FLAWS[name](flawless)))
    assert broken(verdict) == [name]
    assert verdict.word == "failed"
    assert name in verdict.reason
    assert verdict.exit_code == 1


def test_no_line_goes_without_a_flaw(flawless):
    tracking = {f"tracking error of module {module}, mean" for module in (1, 2, 3)}  # see below
    wild = {line for _, lines in WILD.values() for line in lines}
    assert {line.name for line in judge(flawless).criteria} == {*FLAWS, OFF_THE_LOG, *wild, *tracking}


@pytest.mark.parametrize("name", WILD)
def test_wild_valves_break_their_lines(flawless, name):
    valves, lines = WILD[name]
    verdict = judge(replace(flawless, outputs=valves(flawless)))
    assert set(broken(verdict)) == lines
    assert verdict.word == "failed"


def test_a_runtime_that_never_gave_a_set_point_opens_no_valve(flawless):
    verdict = judge(replace(flawless, start_ns=None))
    assert BEFORE in broken(verdict)


def test_another_task_than_the_one_asked_for_fails(flawless):
    verdict = judge(replace(flawless, asked=-flawless.asked))
    assert broken(verdict) == ["desired configurations off the task's own"]
    longer = judge(replace(flawless, asked=flawless.asked[:-1]))
    assert set(broken(longer)) == {"ticks", "desired configurations off the task's own"}


def test_a_board_slower_than_the_robot_file_has_its_time_to_settle(flawless):
    """Its way takes twice as long as the robot file's slew says."""
    far = np.where(np.arange(TICKS)[:, None] % 2, 0.35, 0.08) * (np.arange(12) < 6)
    valves, end = slewed(flawless.start_bar, far)
    half = replace(flawless, commanded_bar=far, outputs=slower(valves), end_ns=end, end_us=end * 1e-3)
    assert OFF_THE_LOG in broken(judge(half))
    assert broken(judge(replace(half, slew_bar_per_s=1.0))) == []


@pytest.mark.parametrize("valves", [unsettled, late_valves, lambda r: other_duty(r, 2, rows=slice(0, -1))])
def test_valves_that_do_not_follow_the_log_fail(flawless, valves):
    assert OFF_THE_LOG in broken(judge(replace(flawless, outputs=valves(flawless))))


def test_a_valve_that_answers_another_channel_fails(flawless):
    duty = flawless.outputs.duty[:, [1, 0, *range(2, 12)]]
    assert set(broken(judge(replace(flawless, outputs=flawless.outputs._replace(duty=duty))))) == {OFF_THE_LOG, OUTSIDE}


def test_every_tick_is_compared(flawless):
    assert np.isfinite(valve_difference(flawless)).all()
    assert np.nanmax(valve_difference(flawless)) <= 0.5


def test_one_count_is_rounding(flawless):
    """Half a count of rounding stands in the registers already; another half is the firmware's right."""
    duty = flawless.outputs.duty.copy()
    duty[:-1] += 0.4 / COUNTS
    assert judge(replace(flawless, outputs=flawless.outputs._replace(duty=duty))).word == "passed"


def test_a_slow_host_voids_the_timing_and_nothing_else(flawless):
    slow = {"board_late_ms": 180.0}
    verdict = judge(replace(flawless, **slow, lateness_ms=np.full(TICKS, 60.0), missed=3))
    assert verdict.word == "not judged"
    assert verdict.exit_code == 3
    assert "the host was too slow" in verdict.reason
    assert "180 ms" in verdict.reason
    worse = judge(replace(flawless, **slow, faults=changed(flawless.faults, 3, 1)))
    assert worse.word == "failed"


def test_many_short_stalls_are_a_slow_host(flawless):
    verdict = judge(replace(flawless, board_late_ms=30.0, board_slipped_percent=0.6))
    assert verdict.word == "not judged"
    assert "stalls" in verdict.reason


def test_a_slow_plant_is_a_slow_host(flawless):
    late = changed(flawless.plant_late_ms, 70, 200.0)
    assert judge(replace(flawless, plant_late_ms=late)).word == "not judged"


def test_a_short_run_is_not_judged(flawless):
    short = {
        name: getattr(flawless, name)[:50]
        for name in "tick mono_ns lateness_ms desired configuration frame_mono_ns commanded_bar acknowledged_ms".split()
    }
    record = replace(
        flawless, **short, asked=flawless.asked[:50], faults=flawless.faults[:50], state=flawless.state[:50]
    )
    valves, end = slewed(flawless.start_bar, flawless.commanded_bar[:50])
    verdict = judge(replace(record, outputs=valves, end_ns=end, end_us=end * 1e-3))
    assert broken(verdict) == []
    assert verdict.word == "not judged"
    assert "at least 100" in verdict.reason


def test_a_run_without_a_tick_fails_in_words(flawless):
    empty = {
        name: getattr(flawless, name)[:0]
        for name in "tick mono_ns lateness_ms desired configuration frame_mono_ns commanded_bar acknowledged_ms".split()
    }
    verdict = judge(replace(flawless, **empty, runtime_exit=65, faults=flawless.faults[:0], state=[]))
    assert verdict.word == "failed"
    assert "exit code of modsoft-runtime" in broken(verdict)
    assert "ticks" in broken(verdict)


def test_tracking_has_limits_by_task_and_modules(flawless, monkeypatch):
    monkeypatch.setitem(judging.TRACKING_DEG, ("down", 3), [1.0, 2.0, 3.0])
    assert judge(flawless).word == "passed"
    off = flawless.configuration.copy()
    off[:, 1] = from_angles_deg(bending_angle_deg(flawless.desired[:, 1]) + 2.1)
    plant = np.repeat(off, 20, axis=0)
    verdict = judge(
        replace(
            flawless,
            configuration=off,
            plant_configuration=plant,
            plant_mono_ns=START_NS + np.arange(len(plant)) * 20_000_000,
            frame_mono_ns=flawless.mono_ns,
            plant_bar=np.zeros((len(plant), 3, 2)),
        )
    )
    assert broken(verdict) == ["tracking error of module 2, mean"]


def test_percentiles_are_values_that_were_measured():
    assert judging.p99(np.array([1.0, 2.0, 50.0])) == 50.0
    assert math.isnan(judging.p99(np.array([])))
