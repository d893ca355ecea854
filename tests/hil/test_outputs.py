"""The valve outputs over time: rows of timer registers, the time until all are closed, and how often one went up."""

import math

import numpy as np
import pytest
from floating_pins import command_down_after_ms
from output_rises import rises

from modsoft.hil.outputs import emulated_us, read_outputs

TOP = 4095
READY = {"event": "ready", "channels": 3, "t_us": 0.0, "mono_ns": 0}


def pwm(t_ms, channel, duty, lag_ns=0):
    counts = round(duty * (TOP + 1))
    raw = [counts - 1, TOP] if counts else [0, 0]
    times = {"t_us": t_ms * 1e3, "mono_ns": int(t_ms * 1e6) + lag_ns}
    return {"event": "pwm", **times, "channel": channel, "duty": duty, "raw": raw}


def test_change_of_one_channel_leaves_the_others():
    outputs = read_outputs([READY, pwm(1, 0, 0.25), pwm(2, 2, 0.5), pwm(3, 0, 0.0)])
    np.testing.assert_array_equal(outputs.duty, [[0.25, 0, 0], [0.25, 0, 0.5], [0, 0, 0.5]])
    np.testing.assert_array_equal(outputs.mono_ns, [1_000_000, 2_000_000, 3_000_000])
    np.testing.assert_array_equal(outputs.t_us, [1000.0, 2000.0, 3000.0])
    assert outputs.counts == 4096


def test_board_that_never_opened_a_valve_has_no_rows():
    outputs = read_outputs([READY])
    assert outputs.duty.shape == (0, 3)
    assert outputs.counts == 4096
    assert outputs.vented_after_ms(0.0) == 0.0


def test_timers_of_different_tops_are_refused():
    other = pwm(2, 1, 0.5) | {"raw": [10, 255]}
    with pytest.raises(ValueError, match="tops"):
        read_outputs([READY, pwm(1, 0, 0.25), other])


def test_vented_when_the_last_output_closes():
    events = [pwm(1, 0, 0.1), pwm(2, 1, 0.2), pwm(4, 1, 0.0), pwm(5, 0, 0.05), pwm(6, 0, 0.0)]
    assert read_outputs(events).vented_after_ms(3e3) == pytest.approx(3.0)


def test_vented_counts_emulated_time():
    # emulated time runs 3 ms behind at the end: the stamps of the cycle counter count
    events = [READY, pwm(1, 0, 0.1), pwm(2, 1, 0.1), pwm(400, 0, 0.0), pwm(500, 1, 0.0, lag_ns=3_000_000)]
    assert read_outputs(events).vented_after_ms(emulated_us(events, 100_000_000)) == pytest.approx(400.0)


def test_output_that_opens_again_is_not_vented():
    events = [READY, pwm(1, 0, 0.1), pwm(400, 0, 0.0), pwm(900, 0, 0.2)]
    assert read_outputs(events).vented_after_ms(100e3) == math.inf
    assert read_outputs([*events, pwm(1000, 0, 0.0)]).vented_after_ms(100e3) == pytest.approx(900.0)


def test_outputs_closed_before_the_instant_take_no_time():
    assert read_outputs([READY, pwm(1, 0, 0.1), pwm(2, 0, 0.0)]).vented_after_ms(5e3) == 0.0


def test_emulated_time_is_that_of_the_last_event_before():
    assert emulated_us([READY, pwm(10, 0, 0.1, lag_ns=2_000_000)], 13_000_000) == pytest.approx(11e3)
    assert math.isnan(emulated_us([READY], -1))


def test_rises_are_counted_against_the_duty_before():
    events = [pwm(1, 0, 0.1), pwm(2, 1, 0.2), {"event": "command"}]
    assert rises(events) == 2
    assert rises([*events, pwm(4, 0, 0.05), pwm(5, 0, 0.1), pwm(6, 1, 0.2)], 3) == 1


def test_command_of_a_floating_pin_falls_only_with_a_pull_down():
    """0.35 bar of 3 bar; the pin floats from 10 ms to 2 s, when the firmware drives it low."""
    full = 0.35 / 3.0
    events = [READY, pwm(1, 0, full), pwm(10, 0, 0.0) | {"floating": True}, pwm(2000, 0, 0.0)]
    outputs = read_outputs(events)
    expected_ms = 110.0 * math.log(0.35 / 0.05)
    assert command_down_after_ms(outputs, 10e3, 3e6, pull_downs=True) == pytest.approx(expected_ms, abs=1.5)
    assert command_down_after_ms(outputs, 10e3, 3e6, pull_downs=False) == pytest.approx(1990.0, abs=1.5)
    assert command_down_after_ms(outputs, 10e3, 1e6, pull_downs=False) == math.inf
    assert command_down_after_ms(read_outputs(events[:2]), 10e3, 1e6, pull_downs=True) == math.inf
    assert command_down_after_ms(read_outputs([READY]), 0.0, 1e4, pull_downs=False) == 0.0
