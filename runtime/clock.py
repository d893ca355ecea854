"""The clock of the loop: ticks at absolute deadlines of a monotonic clock. A late tick is skipped, not repeated."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

SLICE_S = 0.05  # waiting is cut into slices so that a lost device is noticed between two ticks
SPIN_S = 0.001
LATE_MS = 20.0  # a step or an acknowledgement later than this is late: 5 % of the period at 2.5 Hz


def spinning(wait: Callable[[float], object], now: Callable[[], float] = time.monotonic) -> Callable[[float], object]:
    """`wait` for a `Ticker`, but without sleep for the last millisecond: a process that sleeps loses the
    processor, and its caches, to other processes."""

    def wait_or_spin(seconds: float) -> None:
        if seconds > SPIN_S:
            wait(seconds)
            return
        until_s = now() + seconds
        while now() < until_s:
            pass

    return wait_or_spin


@dataclass(frozen=True)
class Tick:
    """A control step: number `index`, due at `due_s`, begun at `start_s`, after `missed` skipped steps."""

    index: int
    due_s: float
    start_s: float
    missed: int

    @property
    def lateness_s(self) -> float:
        return self.start_s - self.due_s


class Ticker:
    """Step k is due at start + k * period, computed from k each time so that no error adds up.

    A step may begin, and send, until half a period after it was due; later than that it is skipped. It also waits for
    half a period after the last command, which a halted process may have sent late. So two commands are never less than
    half a period apart, even if the process was starved. `now` must be monotonic: a step of the wall clock has no
    effect.
    """

    def __init__(
        self,
        period_s: float,
        now: Callable[[], float] = time.monotonic,
        wait: Callable[[float], object] = time.sleep,
    ):
        """`wait(seconds)` may return early, for instance at a stop request."""
        self.period_s = period_s
        self.now = now
        self._wait = wait
        self._start_s = now()
        self._sent_s = -math.inf
        self._index = -1

    def start(self, delay_s: float = 0.0) -> None:
        """Step 0 is due `delay_s` from now."""
        self._start_s = self.now() + delay_s
        self._index = -1

    def due_s(self, index: int) -> float:
        """When a step is due, seconds of the clock."""
        return self._start_s + index * self.period_s

    def too_late(self, index: int) -> bool:
        """Whether this step may no longer send. Checked again before sending, after a long step."""
        return self.now() - self.due_s(index) > self.period_s / 2

    def sent(self) -> None:
        """A command has just been sent."""
        self._sent_s = self.now()

    def next(
        self, idle: Callable[[], None] = lambda: None, prepare: Callable[[float], float] = lambda left_s: left_s
    ) -> Tick:
        """Waits for the next step. Calls `idle` at least once, then every 50 ms; passes its errors on.

        `prepare` is called before every wait with the seconds that are left, and returns how many of them to wait: it
        may use a part of the time, and returns 0 to be called again at once.
        """
        index = self._index + 1
        idle()
        while True:
            left_s = max(self.due_s(index), self._sent_s + self.period_s / 2) - self.now()
            if left_s > 0:
                wait_s = min(left_s, SLICE_S, prepare(left_s))
                if wait_s > 0:
                    self._wait(wait_s)
                    idle()
            elif self.too_late(index):
                behind = (self.now() - self._start_s) / self.period_s - 0.5
                index = max(index + 1, math.ceil(behind))
            else:
                break
        missed, self._index = index - self._index - 1, index
        return Tick(index, self.due_s(index), self.now(), missed)
