"""Traces to figures: rows of timer registers, and how long after an instant the valves are at 0 for good."""

import json
import math

import numpy as np
import pytest

from modsoft.hil import record

TOP = 4095


def pwm(t_ms, channel, duty, lag_ns=0):
    counts = round(duty * (TOP + 1))
    raw = [counts - 1, TOP] if counts else [0, 0]
    return {"event": "pwm", "t_us": t_ms * 1e3, "mono_ns": int(t_ms * 1e6) + lag_ns, "channel": channel,
            "duty": duty, "raw": raw}  # fmt: skip


READY = {"event": "ready", "channels": 3, "t_us": 0.0, "mono_ns": 0}


def test_a_change_of_one_channel_leaves_the_others():
    found = record.valves([READY, pwm(1, 0, 0.25), pwm(2, 2, 0.5), pwm(3, 0, 0.0)])
    np.testing.assert_array_equal(found.duty, [[0.25, 0, 0], [0.25, 0, 0.5], [0, 0, 0.5]])
    np.testing.assert_array_equal(found.mono_ns, [1_000_000, 2_000_000, 3_000_000])
    assert found.counts == 4096


def test_a_board_that_never_opened_a_valve_has_a_trace_too():
    found = record.valves([READY])
    assert found.duty.shape == (0, 3)
    assert found.counts == 4096


def test_timers_of_different_tops_are_refused():
    other = pwm(2, 1, 0.5) | {"raw": [10, 255]}
    with pytest.raises(ValueError, match="tops"):
        record.valves([READY, pwm(1, 0, 0.25), other])


def test_vented_counts_emulated_time():
    # emulated time runs 3 ms behind at the end: the stamps of the cycle counter count
    events = [READY, pwm(1, 0, 0.1), pwm(2, 1, 0.1), pwm(400, 0, 0.0), pwm(500, 1, 0.0, lag_ns=3_000_000)]
    assert record.vented_after_ms(events, since_ns=100_000_000) == pytest.approx(400.0)


def test_vented_means_for_good():
    events = [READY, pwm(1, 0, 0.1), pwm(400, 0, 0.0), pwm(900, 0, 0.2)]
    assert math.isnan(record.vented_after_ms(events, since_ns=100_000_000))
    assert record.vented_after_ms([*events, pwm(1000, 0, 0.0)], 100_000_000) == pytest.approx(900.0)


def test_vented_already_is_no_time_at_all():
    assert record.vented_after_ms([READY, pwm(1, 0, 0.1), pwm(2, 0, 0.0)], 5_000_000) == 0.0


def test_lateness_is_that_of_the_run():
    late = [{"event": "late", "late_us": us, "mono_ns": ns} for us, ns in ((90e3, 0), (30e3, 2e9), (25e3, 3e9))]
    found = record._board_lateness(late, {"max_late_us": 90e3}, start_ns=1e9, end_ns=int(11e9))
    assert found == {"board_late_ms": 30.0, "board_slipped_percent": pytest.approx(0.55)}
    assert record._board_lateness([], {"max_late_us": 7e3}, 1e9, int(11e9))["board_late_ms"] == 7.0
    assert math.isnan(record._board_lateness([], {}, 1e9, int(11e9))["board_late_ms"])


def test_a_line_cut_by_a_kill_is_left_out(tmp_path):
    (tmp_path / "x.jsonl").write_text(json.dumps({"tick": 0}) + "\n" + '{"tick": 1, "con')
    assert record.lines(tmp_path / "x.jsonl") == [{"tick": 0}]


def test_the_firmware_has_a_hash_on_either_board():
    assert len(record.firmware_sha256("native")) == 64
