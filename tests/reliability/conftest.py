"""One line for every row of the failure matrix that a test covers: printed, and written with `--matrix FILE`.

`make reliability` makes docs/reliability.md from these lines (tools/reliability.py).
"""

import json

import pytest

ROW = "matrix_row"  # name of the line in a test's report
CLOCKS = ("emulated", "virtual", "host", "none")  # of the worst figure


def pytest_addoption(parser):
    group = parser.getgroup("failure matrix")
    group.addoption("--matrix", metavar="FILE", help="append one JSON line for every row to this file")
    group.addoption("--matrix-full", action="store_true", help="the matrix's full number of tries; takes hours")


@pytest.fixture(scope="session")
def full(pytestconfig):
    """True with --matrix-full: `tries = 100 if full else 4`."""
    return pytestconfig.getoption("--matrix-full", default=False)


@pytest.fixture
def matrix_row(request):
    """matrix_row(6, fault="cable pulled", tries=10, limit="vented in 700 ms", worst="484 ms", clock="emulated").

    Called once for each line, before or after the test's assertions: a line is met if `met` is true and its test
    passed. fault: distinguishes the lines of a row (native, emulated). clock: "emulated" (the board's cycle counter),
    "virtual" (an injected clock), "host" (the wall clock) or "none". why: the reason, for a line that is not met.
    """

    def add(row, *, fault, tries, limit, worst, clock="none", met=True, why=""):
        assert 1 <= row <= 66, f"the failure matrix has no row {row}"
        assert clock in CLOCKS, f"clock {clock!r}, not one of {CLOCKS}"
        line = {"row": row, "fault": fault, "tries": int(tries), "limit": str(limit), "worst": str(worst)}
        request.node.user_properties.append((ROW, {**line, "clock": clock, "met": bool(met), "why": why}))

    return add


class RowLines:
    """Prints and writes the lines as the tests end, in the process that receives all reports (also under -n)."""

    def __init__(self, config):
        self.config = config

    def pytest_runtest_logreport(self, report):
        lines = [value for name, value in report.user_properties if name == ROW] if report.when == "call" else []
        path = self.config.getoption("--matrix", default=None)
        terminal = self.config.pluginmanager.get_plugin("terminalreporter")
        for line in lines:
            line = {**line, "met": line["met"] and report.passed, "test": report.nodeid}
            if terminal:
                terminal.ensure_newline()
                terminal.write_line(json.dumps({name: line[name] for name in ("row", "tries", "limit", "worst")}))
            if path:
                with open(path, "a", encoding="utf-8") as file:
                    file.write(json.dumps(line) + "\n")


def pytest_configure(config):
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(RowLines(config))
