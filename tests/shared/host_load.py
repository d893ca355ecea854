"""The host-load check: whether the machine stalled during a test against the wall clock.

A process sleeps for 5 ms at a time and measures how late it wakes up. A machine that delays it by more than LIMIT_S
delays the runtime and the rig too: a late control tick is then no fault of theirs.
"""

import subprocess
import sys

import pytest

LIMIT_S = 0.1  # as in modsoft.hil.criteria: the shortest time-out of the board is 0.3 s
SLEEPERS: set[int] = set()  # process ids of running checks
_SLEEPER = """
import select, sys, time
worst = 0.0
last = time.monotonic()
while True:
    readable, _, _ = select.select([sys.stdin], [], [], 0.005)
    now = time.monotonic()
    worst, last = max(worst, now - last - 0.005), now
    if readable:
        if not sys.stdin.readline():
            break
        print(worst, flush=True)
        worst = 0.0
"""


class HostLoad:
    """Measures from its start; `worst_s` returns the longest stall since the last call."""

    def __init__(self) -> None:
        self._sleeper = subprocess.Popen(
            [sys.executable, "-c", _SLEEPER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        SLEEPERS.add(self._sleeper.pid)

    def worst_s(self) -> float:
        assert self._sleeper.stdin is not None
        assert self._sleeper.stdout is not None
        self._sleeper.stdin.write("\n")
        self._sleeper.stdin.flush()
        return float(self._sleeper.stdout.readline())

    def close(self) -> None:
        assert self._sleeper.stdin is not None
        self._sleeper.stdin.close()
        self._sleeper.wait()
        SLEEPERS.discard(self._sleeper.pid)


def excused(report: pytest.TestReport, worst_s: float) -> pytest.TestReport:
    """The report of a test against the wall clock; a failure while the host stalled becomes a skipped test with the
    reason."""
    if report.failed and worst_s > LIMIT_S:
        reason = f"inconclusive: host-load check, this machine stalled for {worst_s * 1e3:.0f} ms during the test"
        report.sections.append(("failure while the host stalled", str(report.longrepr)))
        report.outcome = "skipped"
        report.longrepr = (report.nodeid, report.location[1] or 0, f"Skipped: {reason}")
    return report
