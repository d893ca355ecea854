"""The host-load check of the tests against the wall clock."""

import os
import signal
import time

import host_load
import pytest
from _pytest.reports import TestReport


def report(outcome):
    return TestReport("test_x.py::test_x", ("test_x.py", 3, "test_x"), {}, outcome, "assert 1 == 2", "call")


def test_failure_counts_unless_the_host_stalled():
    assert host_load.excused(report("failed"), 0.09).failed
    assert host_load.excused(report("passed"), 0.5).passed
    skipped = host_load.excused(report("failed"), 0.25)
    assert skipped.skipped
    assert "stalled for 250 ms" in skipped.longrepr[2]
    assert skipped.sections == [("failure while the host stalled", "assert 1 == 2")]


@pytest.mark.realtime
def test_stall_is_measured_once():
    load = host_load.HostLoad()
    load.worst_s()
    os.kill(load._sleeper.pid, signal.SIGSTOP)
    time.sleep(0.3)
    os.kill(load._sleeper.pid, signal.SIGCONT)
    assert load.worst_s() >= 0.25
    assert load.worst_s() < 0.25
    load.close()
