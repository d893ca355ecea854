"""Line and branch coverage of the firmware by its native tests: a table, and exit code 1 below 100 %.

All files of `firmware/` that are compiled natively: the logic (frame.c, output.c, supervisor.c), and the files that
access the hardware (pwm.c, sensors.c, boot.c), on a chip of plain memory.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import click

ROOT = Path(__file__).resolve().parent.parent
BUILD = ROOT / "build" / "coverage"
FILES = ("frame.c", "output.c", "supervisor.c", "protocol.h", "pwm.c", "sensors.c", "boot.c")
TESTS = ("test_frame.py", "test_output.py", "test_supervisor.py", "test_chip.py")


def _run_tests() -> None:
    """Build with counters and run the tests on that build."""
    shutil.rmtree(BUILD, ignore_errors=True)
    instrument = "INSTRUMENT=-O0 --coverage -fprofile-update=single"
    out = os.path.relpath(BUILD, ROOT / "firmware")
    subprocess.run(["make", "-s", "-C", str(ROOT / "firmware"), "native", f"OUT={out}", instrument], check=True)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    # The loops of `corrupt` assert no more than the tests, and would cover lines that no test checks.
    command += ["-k", "not corrupted_and_repeated", *(str(ROOT / "tests" / "firmware" / name) for name in TESTS)]
    tests = subprocess.run(command, cwd=ROOT, env={**os.environ, "MODSOFT_NATIVE_FIRMWARE": str(BUILD)}, check=False)
    if tests.returncode != 0:
        sys.exit("coverage: the tests fail; correct that first, see make test")


Counts = dict[tuple[str, int], int]


def _count() -> tuple[Counts, dict[tuple[str, int, int], int]]:
    """Return how often each (file, line) and each (file, line, branch) was executed, summed over all libraries."""
    lines: Counts = defaultdict(int)
    branches: dict[tuple[str, int, int], int] = defaultdict(int)
    for counters in sorted(BUILD.rglob("*.gcda")):
        command = ["gcov", "--json-format", "--branch-probabilities", "--stdout", str(counters)]
        done = subprocess.run(command, cwd=BUILD, capture_output=True, text=True, check=True)
        for file in json.loads(done.stdout)["files"]:
            name = Path(file["file"]).name
            for line in file["lines"]:
                lines[name, line["line_number"]] += line["count"]
                for number, branch in enumerate(line["branches"]):
                    branches[name, line["line_number"], number] += branch["count"]
    return lines, branches


def _table(lines: Counts, branches: dict[tuple[str, int, int], int]) -> bool:
    """Print the table; return whether everything is covered."""
    complete = True
    print(f"{'file':14} {'lines':>12} {'branches':>12}   not covered")
    for name in FILES:
        of_lines = [count for (file, _), count in lines.items() if file == name]
        of_branches = [count for (file, _, _), count in branches.items() if file == name]
        missed = {line for (file, line), count in lines.items() if file == name and not count}
        missed |= {line for (file, line, _), count in branches.items() if file == name and not count}
        shares = [f"{sum(map(bool, counts))}/{len(counts)}" for counts in (of_lines, of_branches)]
        print(f"{name:14} {shares[0]:>12} {shares[1]:>12}   {', '.join(map(str, sorted(missed))) or '-'}")
        complete &= bool(of_lines) and not missed
    return complete


@click.command(help=__doc__)
def main() -> None:
    _run_tests()
    if not _table(*_count()):
        sys.exit("coverage: below 100 %: test the missing lines, or delete unreachable code")


if __name__ == "__main__":
    main()
