"""The frame rate of a device, learned from its frame numbers and the host's clock."""

from __future__ import annotations

LEARN_S = 2.0  # before there is a rate
ENOUGH_S = 60.0  # then the rate is final: one frame of error in a minute
TOLERANCE_S = 0.1  # a frame further off the line is not used: late, or the device counts from another number


class FrameRate:
    """A straight line through host times over frame numbers. `hz` is its slope, None before `LEARN_S`, and becomes
    more precise until `ENOUGH_S`. A known rate is kept."""

    def __init__(self, hz: float | None = None):
        self.hz = hz
        self._span_s = 0.0 if hz is None else ENOUGH_S  # over which `hz` was learned
        self._count, self._first, self._last, self._first_s = 0, 0, 0, 0.0
        self._sums: tuple[float, ...] = ()

    def add(self, number: int, at_s: float) -> None:
        """A new frame: its number and the host's time in seconds."""
        if self._span_s >= ENOUGH_S:
            return
        if self._count and (number <= self._last or self._is_off(number, at_s)):
            self._count = 0
        if not self._count:
            self._first, self._first_s, self._sums = number, at_s, (0.0, 0.0, 0.0, 0.0)
        self._last = number
        n, t = number - self._first, at_s - self._first_s
        self._count += 1
        self._sums = tuple(old + new for old, new in zip(self._sums, (n, t, n * t, t * t), strict=True))
        span_s = at_s - self._first_s
        if span_s >= max(LEARN_S, self._span_s) and n > 0:
            self.hz, self._span_s = self._slope(), span_s

    def _slope(self) -> float:
        """Least squares, frames a second."""
        n, t, nt, tt = self._sums
        return (nt - n * t / self._count) / (tt - t * t / self._count)

    def _is_off(self, number: int, at_s: float) -> bool:
        """Whether this frame is off the line by more than the tolerance; unknown before there is a rate."""
        if self.hz is None:
            return False
        n, t, *_ = self._sums
        expected_s = self._first_s + (t + (number - self._first) * self._count / self.hz - n / self.hz) / self._count
        return abs(at_s - expected_s) > TOLERANCE_S
