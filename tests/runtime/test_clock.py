"""The ticker, on virtual time."""

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from modsoft.runtime.clock import SLICE_S, SPIN_S, Ticker, spinning


class Time:
    """A clock that only moves when somebody waits or works. `overshoot` seconds are added to every wait."""

    def __init__(self, start_s: float = 1000.0):
        self.time_s = start_s
        self.overshoot = iter(())

    def now(self) -> float:
        return self.time_s

    def wait(self, seconds: float) -> None:
        assert 0 < seconds <= SLICE_S
        self.time_s += seconds + next(self.overshoot, 0.0)

    def ticker(self, period_s: float = 0.4) -> Ticker:
        ticker = Ticker(period_s, self.now, self.wait)
        ticker.start()
        return ticker


def test_punctual_ticks_are_due_at_multiples_of_the_period():
    time = Time()
    ticker = time.ticker()
    ticks = [ticker.next() for _ in range(1000)]
    assert [tick.index for tick in ticks] == list(range(1000))
    assert all(tick.missed == 0 for tick in ticks)
    assert ticks[-1].due_s == pytest.approx(1000.0 + 999 * 0.4, abs=1e-9)
    assert max(tick.lateness_s for tick in ticks) < 1e-9


def test_lateness_does_not_add_up():
    time = Time()
    ticker = time.ticker()
    for index in range(200):
        tick = ticker.next()
        assert tick.index == index
        assert tick.lateness_s == pytest.approx(0.0, abs=1e-9)
        time.time_s += 0.13  # the work of a step


def test_long_step_skips_one_slot_without_a_burst():
    time = Time()
    ticker = time.ticker()
    ticker.next()
    time.time_s += 0.4 + 0.21  # slot 1 is more than half a period late
    tick = ticker.next()
    assert (tick.index, tick.missed) == (2, 1)
    assert tick.start_s == pytest.approx(tick.due_s, abs=1e-9)


def test_slot_less_than_half_a_period_late_still_runs():
    time = Time()
    ticker = time.ticker()
    ticker.next()
    time.time_s += 0.4 + 0.19
    tick = ticker.next()
    assert (tick.index, tick.missed) == (1, 0)
    assert tick.lateness_s == pytest.approx(0.19)
    assert not ticker.too_late(1)
    time.time_s += 0.02
    assert ticker.too_late(1)


def test_ticker_keeps_its_phase_after_a_long_suspension():
    time = Time()
    ticker = time.ticker()
    ticker.next()
    time.time_s += 3600.0
    tick = ticker.next()
    assert (tick.index, tick.missed) == (9000, 8999)
    assert abs(tick.lateness_s) < 1e-6


def test_first_slot_can_be_postponed():
    time = Time()
    ticker = time.ticker()
    ticker.start(0.4)
    assert ticker.next().start_s == pytest.approx(1000.4)


def test_idle_is_called_at_least_every_slice_and_may_raise():
    time = Time()
    ticker = time.ticker()
    ticker.next()
    idle_times_s = []
    ticker.next(lambda: idle_times_s.append(time.time_s))
    assert len(idle_times_s) >= 0.4 / SLICE_S
    assert max(b - a for a, b in itertools.pairwise(idle_times_s)) <= SLICE_S + 1e-9

    def stop():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ticker.next(stop)


@given(
    st.lists(st.floats(0, 2), max_size=50),
    st.lists(st.tuples(st.floats(0, 2), st.floats(0, 2)), min_size=1, max_size=30),
    st.floats(0.01, 1.0),
)
def test_commands_are_never_less_than_half_a_period_apart(overshoots, work, period_s):
    """Whenever the process is halted: in a wait, in the work of a step, or just before its command is out."""
    time = Time()
    time.overshoot = iter(overshoots)
    ticker = time.ticker(period_s)
    sent, begun, slots, missed = [], [], [], 0
    for busy_s, halted_s in work:
        tick = ticker.next()
        missed += tick.missed
        assert 0 <= tick.lateness_s <= period_s / 2 + 1e-9
        slots.append(tick.index)
        begun.append(tick.start_s)
        time.time_s += busy_s
        if not ticker.too_late(tick.index):
            time.time_s += halted_s
            sent.append(time.time_s)
            ticker.sent()
    assert slots == sorted(set(slots))
    assert missed == slots[-1] + 1 - len(slots)  # every slot ran or was counted
    for times in (sent, begun):  # no burst, neither of commands nor of ticks
        assert all(b - a >= period_s / 2 - 1e-9 for a, b in itertools.pairwise(times))


@given(st.lists(st.floats(0, 2), max_size=30), st.integers(1, 30))
def test_never_two_ticks_in_one_period(overshoots, count):
    time = Time()
    time.overshoot = iter(overshoots)
    ticker = time.ticker()
    # a slot may begin until half a period after it was due
    periods = [math.ceil((ticker.next().start_s - 1000.0) / 0.4 - 0.5 - 1e-6) for _ in range(count)]
    assert periods == sorted(set(periods))


def test_delayed_command_postpones_the_next_slot():
    time = Time()
    ticker = time.ticker()
    ticker.next()
    time.time_s += 0.35
    ticker.sent()
    assert ticker.next().start_s == pytest.approx(1000.0 + 0.35 + 0.2)
    time.time_s += 0.45  # on its way until 1.0, which is when slot 2 is 0.2 late and slot 3 not yet due
    ticker.sent()
    tick = ticker.next()
    assert (tick.index, tick.missed) == (3, 1)
    assert tick.start_s == pytest.approx(1000.0 + 1.2)


def test_preparation_runs_during_the_wait_and_delays_no_slot():
    time = Time()
    ticker = time.ticker()
    ticker.next()
    used_at = []

    def prepare(left_s):
        if left_s > 0.011:
            return left_s - 0.01
        if left_s > 0.005:
            used_at.append(left_s)
            time.time_s += 0.004
            return 0.0
        return left_s

    tick = ticker.next(prepare=prepare)
    assert used_at == pytest.approx([0.01, 0.006])
    assert tick.lateness_s == pytest.approx(0.0, abs=1e-9)


def test_only_the_last_millisecond_is_waited_without_sleep():
    slept, times = [], itertools.count(0.0, SPIN_S / 4)
    wait = spinning(slept.append, lambda: next(times))
    wait(0.4)
    assert slept == [0.4]
    wait(SPIN_S)
    assert slept == [0.4]
    assert next(times) >= 5 * SPIN_S / 4
