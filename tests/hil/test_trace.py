"""When the valves are closed, read from the events of an emulated board."""

import math

from modsoft.hil.trace import rises, vented_us


def pwm(t_us, channel, duty):
    return {"event": "pwm", "t_us": t_us, "channel": channel, "duty": duty}


OPEN = [pwm(1.0, 0, 0.1), pwm(2.0, 1, 0.2), {"event": "command", "t_us": 3.0}]


def test_the_last_one_to_close_counts():
    trace = [*OPEN, pwm(4.0, 1, 0.0), pwm(5.0, 0, 0.05), pwm(6.0, 0, 0.0), {"event": "stats", "t_us": 9.0}]
    assert vented_us(trace, 3) == 6.0
    assert vented_us(trace) == 6.0


def test_open_at_the_end_is_never_vented():
    assert vented_us([*OPEN, pwm(4.0, 1, 0.0)], 3) == math.inf
    assert vented_us([*OPEN, pwm(4.0, 1, 0.0), pwm(5.0, 0, 0.0), pwm(6.0, 1, 0.1)], 3) == math.inf


def test_nothing_seen_is_not_vented():
    assert vented_us(OPEN, 3) == math.inf
    assert vented_us([*OPEN, pwm(4.0, 1, 0.0), pwm(5.0, 0, 0.0)], 5) == math.inf


def test_a_rise_is_seen_only_where_asked_and_against_what_stood_before():
    assert rises(OPEN) == 2
    assert rises([*OPEN, pwm(4.0, 0, 0.05), pwm(5.0, 0, 0.1), pwm(6.0, 1, 0.2)], 3) == 1
