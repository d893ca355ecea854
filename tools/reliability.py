"""The failure matrix: runs its tests and writes docs/reliability.md from the lines that they print.

`make reliability` runs tests/reliability with few tries, `tools/reliability.py --full` with the numbers of the matrix.
--full keeps the result of each test in a folder: the same command on the same commit skips the finished ones, and
writes the page once all tests have a result. To repeat a test, delete its file there.
Exit code 1 if a row is missing or not met.
"""

from __future__ import annotations  # above 300 lines: more than a third is the table of the rows

import json
import os
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import click

from modsoft.runtime import log
from modsoft.runtime.entry_point import entry
from modsoft.runtime.errors import ModelError, UsageError
from modsoft.runtime.files import check_not_input, read_text, written

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tools"))  # not there with PYTHONSAFEPATH, which our commands set for their children
import reliability_full  # noqa: E402

Line = dict[str, Any]
FIELDS = ("row", "fault", "tries", "limit", "worst", "clock", "met", "why", "test")


class Row(NamedTuple):
    """A row of the matrix: the fault, the required reaction, and the limit at which the row is met."""

    fault: str
    required: str
    accepted: str


ROWS: dict[int, Row] = {
    1: Row(
        "bit flips",
        "drop, count",
        "native parser 10^7 frames in tests, 10^8 on demand; firmware on the emulator 10^4 in tests, 10^6 on "
        "demand: 0 wrong applied, recovery within one frame",
    ),
    2: Row(
        "dropped, inserted bytes",
        "resynchronise at the next delimiter",
        "10^6: 0 wrong, the next good frame always accepted",
    ),
    3: Row("truncated frame, silence inside a frame", "discarded; the link timer still fires", "as row 2"),
    4: Row(
        "duplicated, reordered, replayed old session", "acknowledged or refused, not applied", "10^5: 0 applied again"
    ),
    5: Row(
        "garbage at line rate, 10 s",
        "vent by the link timer, then answer",
        "0 applied; vented in 700 ms; HELLO within 1 s after; no watchdog reset",
    ),
    6: Row("cable pulled", "board vents, host stops cleanly", "vented in 700 ms; host notices in 150 ms"),
    7: Row(
        "plugged in again under another name",
        "found by its USB identity, HELLO, new ARM; RUNNING only after a new ARM",
        "IDLE in 8 s; 20 of 20",
    ),
    8: Row(
        "board reset in mid-run",
        "host detects the new boot id, stops sending, sends no stale set-point",
        "noticed in 1.2 s, outputs 0 in 130 ms, back in 6 s; 50 of 50",
    ),
    9: Row("host could send to the bootloader", "silent until HELLO", "0 bytes in 100 opens"),
    10: Row("host SIGKILLed", "board vents", "all 0 in 670 ms from 0.35 bar"),
    11: Row(
        "host SIGSTOPped; control thread stuck while the I/O thread runs",
        "vent by link timer; by control timer",
        "670 ms; 1.4 s; on return the fault is latched",
    ),
    12: Row(
        "Ctrl-C, SIGTERM, SIGHUP, exception",
        "VENT, wait for the board's confirmation, exit code",
        '100 of 100 at random phases; "vented" is reported only after the board confirms it',
    ),
    13: Row(
        "tracker off, intermittent",
        "hold one tick, ramp-vent at three",
        "vent starts within 1.2 s + 50 ms of the last good frame",
    ),
    14: Row(
        "tracker frozen (same frame again)", "detected", "within 3 ticks; no false alarm in 1 h of simulated noise"
    ),
    15: Row("stale, delayed frames", "never used", "0 older than one period used"),
    16: Row("NaN (a missing tool is NaN in NDI's client)", "rejected, never passed to the model", "0 in 10^4"),
    17: Row(
        "outlier jump", "gated on the fastest possible motion", "command unchanged on that tick; back within 3 ticks"
    ),
    18: Row("marker hidden, wrong number, swapped", "no partial state is used", "as row 13"),
    19: Row("frame numbers or stamps going backwards", "dropped, counted", "0 used"),
    20: Row(
        "damaged model file",
        "refused before the port is opened",
        "200 of 200 damaged files, within 2 s, no byte on the wire",
    ),
    21: Row(
        "model of another state or action size, history, opset", "refused, message names expected and found", "all"
    ),
    22: Row("model gives NaN or out of range", "fault, vent", "0 NaN sent"),
    23: Row("channels do not match the robot file; protocol hash differs", "ARM refused", "all"),
    24: Row("port busy, no permission, not our board", "clear error, own exit code", "within 3 s, no repeated retries"),
    25: Row("disk full while logging", "control continues, the log reports it", "no late tick"),
    26: Row(
        "starved processor, late ticks",
        "skip, never burst; log the lateness",
        "two SETs never less than half a period apart; more than two missed: vent",
    ),
    27: Row("wall clock steps", "no effect", "commands identical"),
    28: Row("firmware hangs", "watchdog", "outputs 0 in 130 ms"),
    29: Row("pressure sensor stuck, over-pressure, leak", "fault, vent", "dump in 110 ms; leak in 2.1 s"),
    30: Row("host does not read", "board keeps controlling", "loop jitter below 2 ms"),
    31: Row(
        "bit 7 set in the tracker's replies, which are not text then",
        "runtime lives; client continues or starts again",
        "serial port: no frame lost; network: frames again in 10 s",
    ),
    32: Row("wrong checksums in the tracker's replies", "as the limits of the robot file allow", "0 used; no restart"),
    33: Row("lost carriage return of the tracker's reply", "client does not block", "frames again in 0.8 s"),
    34: Row("tracker's client killed, crashed, halted", "client starts again", "frames again in 10 s"),
    35: Row("trackers of other frame rates", "rate learned; delays detected", "no false alarm; 0 delayed frames used"),
    36: Row("tool out of the volume, with an error status or a large RMS error", "invalid", "0 used; vent as row 13"),
    37: Row("jump that stays", "invalid until 3 more frames agree", "shipped limits: vent as row 13"),
    38: Row("tool of five degrees of freedom", "refused at the start", "all places"),
    39: Row(
        "random damage to bytes of the tracker's replies",
        "no crash, no wrong configuration",
        "10^4 replies in tests, 10^5 on demand: 0 and 0; a run that the limits allow continues",
    ),
    40: Row(
        "pins float after opening the port (reset, bootloader)", "pull-downs vent", "down in 250 ms with pull-downs"
    ),
    41: Row("pins float after a watchdog reset", "pull-downs vent", "down in 250 ms with pull-downs"),
    42: Row("board without power", "pull-downs vent; vented when power returns", "down in 250 ms with pull-downs"),
    43: Row(
        "PC without power",
        "a board with its own supply vents at the slew limit; one powered by USB needs pull-downs",
        "all 0 in 700 ms; down in 250 ms with pull-downs",
    ),
    44: Row("scale or offset of the sensors differs from the robot file", "not armed", "one line; A0 to A11 measured"),
    45: Row("sensor wire broken (0.5-4.5 V)", "fault, ramp vent", "vent begins in 130 ms"),
    46: Row("supply of the board below 4.5 V", "fault, ramp vent", "all 0 in 400 ms"),
    47: Row("chamber under pressure before arming", "ARM refused", "one line with channel and pressure"),
    48: Row("a check is skipped", "watchdog", "each check"),
    49: Row(
        "bootloader resets repeatedly after a watchdog reset",
        "pull-downs vent; the host names the cause",
        "down in 250 ms with pull-downs; back after power off",
    ),
    50: Row(
        "calibration of another robot, or of fewer modules",
        "refused before any device is opened",
        "all; one line that names the command to run",
    ),
    51: Row("calibration of other tools", "refused before any device is opened", "each tool"),
    52: Row("damaged calibration file", "refused, or the values that it states", "200 of 200 damaged files, one line"),
    53: Row(
        "tool moved since the calibration",
        "refused at rest, before arming",
        "8 degrees and more, about any axis; no false alarm with 0.5 degree of noise",
    ),
    54: Row(
        "robot moves, or is bent, during modsoft-calibrate rest",
        "refused, the calibration stays",
        "swings of 1 degree a module, drifts of 2 degrees a second, one module bent by 40 degrees, all by 15",
    ),
    55: Row("tool hidden during modsoft-calibrate rest", "refused, the calibration stays", "named within 6 s"),
    56: Row(
        "hoses in any order (modsoft-calibrate channels)",
        "channel of every chamber recognised",
        "100 of 100, each in 60 s, never above the safe pressure",
    ),
    57: Row("valve dead, leaking or open, hose blocked, no air", "named", "all; nothing written, leaks excepted"),
    58: Row("two hoses in one chamber, one in two, hose at another valve", "named", "all; nothing written"),
    59: Row(
        "sensor missing, at another input, with an offset; wrong full scale",
        "named",
        "all; never above the safe pressure",
    ),
    60: Row("tools swapped, hidden during a pulse", "named; no valve opens unobserved", "all; vented"),
    61: Row("end of a calibration: signal, key, error, lost device", "vent as row 12", "all 0 at any phase"),
    62: Row("collection of data: killed (SIGKILL)", "the same command continues", "no recorded sample lost"),
    63: Row("collection: tracker lost", "vent; the same command continues", "no recorded sample lost"),
    64: Row("collection: board lost or restarted", "vent; the same command continues", "no recorded sample lost"),
    65: Row("collection: disk full", "vent; the same command continues", "no sample lost that was written before"),
    66: Row("collection: paused", "vent; the key continues", "no recorded sample lost; all 0 in the pause"),
}

CLOCKS = {"emulated": "board's cycles", "virtual": "injected", "host": "wall", "none": ""}

HEAD = """# The failure matrix

Each fault is injected by its own test in `tests/reliability/`. Made by `{command}`{commit} from the lines that the
tests print, on {date}, {system}, {cores} cores. {score}

- A row: the fault, the required reaction, and the limit. It has several lines where it was tested twice (the firmware's
  logic compiled for the PC; the compiled firmware on the emulated board) or has several faults.
- Tries: how often the fault was injected. `tools/reliability.py --full` and `make soak` use more.
- Worst: over all tries. Clock: the clock of that figure. "board's cycles" is the counter of the emulated processor and
  does not depend on the load of the PC; "wall" does; "injected" is a clock that the test sets.
"""

TAIL = """
## What is not tested

The board is emulated (ATmega2560 on simavr, behind the MEGA's bootloader), the tracker is a fake on a pseudo-terminal,
and the robot is simulated. Not tested: electrical noise, brown-out, real USB latency and drivers, the dynamics of air
in hoses, leaks and chambers, your valves without power, the bootloader binary of your board, markers and lenses.
Pressures (row 29) are voltages on the board's analogue inputs; the cable (rows 6, 7) is a pseudo-terminal that is
removed and created again. Before relying on the results, test the stop keys, the pulled cable and the killed PC once on
the real robot at low pressure.
"""


def read(path: Path) -> list[Line]:
    """The lines of a file. `ModelError` for an invalid line."""
    lines = []
    for number, text in enumerate(read_text(path).splitlines(), start=1):
        try:
            line = json.loads(text)
            missing = [name for name in FIELDS if name not in line]
        except (ValueError, TypeError):
            missing = list(FIELDS)
        if missing:
            raise ModelError(f"{path}: line {number} has no {', '.join(missing)}; write it with pytest --matrix")
        lines.append(line)
    return lines


def by_row(lines: Iterable[Line]) -> dict[int, list[Line]]:
    """The lines of each row, in the order of their tests. A repeated line replaces the first, so that a file may be
    extended."""
    rows: dict[int, dict[tuple[str, str], Line]] = defaultdict(dict)
    for line in lines:
        rows[line["row"]][(line["test"], line["fault"])] = line
    return {row: sorted(each.values(), key=lambda line: line["test"]) for row, each in sorted(rows.items())}


def met(lines: Iterable[Line]) -> bool:
    """Whether a row is met: it has lines, and each is met."""
    values = [line["met"] for line in lines]
    return bool(values) and all(values)


def table(rows: dict[int, list[Line]]) -> str:
    """Markdown table of every row with its lines, or with "missing"."""
    out = ["| # | fault | required | accepted when | injected | tries | limit | worst | clock | met |"]
    out += ["| ---: | --- | --- | --- | --- | ---: | --- | --- | --- | --- |"]
    for number, row in ROWS.items():
        head = [str(number), *row]
        for line in rows.get(number, []) or [None]:
            if line is None:
                cells = ["", "", "", "", "", "**missing**"]
            else:
                met_text = "yes" if line["met"] else f"**no**{': ' + line['why'] if line['why'] else ''}"
                clock = CLOCKS.get(line["clock"], line["clock"])
                cells = [line["fault"], f"{line['tries']:,}", line["limit"], line["worst"], clock, met_text]
            escaped = (cell.replace("|", "\\|").replace("\n", " ") for cell in head + cells)
            out.append(f"| {' | '.join(escaped)} |")
            head = ["", "", "", ""]
    return "\n".join(out)


def score(rows: dict[int, list[Line]]) -> str:
    """The number of rows met, and the rows that are not met or missing."""
    missing = [row for row in ROWS if not rows.get(row)]
    unmet = [row for row in ROWS if rows.get(row) and not met(rows[row])]
    text = f"{len(ROWS) - len(missing) - len(unmet)} of {len(ROWS)} rows are met."
    for label, numbers in (("Not met", unmet), ("Missing", missing)):
        if numbers:
            text += f" {label}: {', '.join(map(str, numbers))}."
    return text


def page(rows: dict[int, list[Line]], command: str, commit: str = "") -> str:
    """docs/reliability.md. commit: that was tested; empty if it is not known."""
    host, date = log.host(), f"{datetime.now(UTC):%Y-%m-%d}"
    at_commit = f" at commit {commit}" if commit else ""
    facts = {"date": date, "system": host["system"], "cores": host["cores"], "score": score(rows)}
    head = HEAD.format(command=command, commit=at_commit, **facts)
    return f"{head}\n{table(rows)}\n{TAIL}"


def run_tests(lines: Path) -> int:
    """Runs all tests of the matrix, those against the wall clock last and alone; returns the first exit code not 0."""
    common = [sys.executable, "-m", "pytest", "-q", "tests/reliability", "--matrix", str(lines)]
    codes = [
        subprocess.run([*common, *options], cwd=ROOT, check=False).returncode
        for options in (["-n", str(min(2, os.cpu_count() or 1)), "-m", "not realtime"], ["-m", "realtime"])
    ]
    return next((code for code in codes if code), 0)


def full_matrix(work: Path | None, rows: str | None, out: Path) -> int:
    """Runs the tests of these rows (None: all) with their full numbers; writes the page if no test is left."""
    chosen = reliability_full.parse_rows(rows) if rows else set(ROWS)
    if unknown := chosen - set(ROWS):
        raise UsageError(f"--rows {rows}: found row {min(unknown)}, expected 1 to {max(ROWS)}")
    results, left, commit = reliability_full.run(ROOT, work, chosen, click.echo)
    lines = by_row(line for result in results for line in result.lines)
    code = int(any(result.exit_code for result in results))
    if left:
        have = {row for result in results for row in result.test.rows} & chosen
        click.echo(f"{left} tests have no result, and the page is not written: run it again without --rows")
        return int(code or have != chosen or not all(met(lines.get(row, [])) for row in chosen))
    with written(out) as new:
        new.write_text(page(lines, "tools/reliability.py --full", commit), encoding="utf-8")
    click.echo(f"{score(lines)} {out}")
    return int(code or not all(met(lines.get(row, [])) for row in ROWS))


@click.command("reliability", help=__doc__, context_settings={"show_default": True})
@click.option(
    "--full",
    is_flag=True,
    help="The numbers of tries of the matrix: an estimated two to three hours on two cores. It can be interrupted.",
)
@click.option("--rows", help="With --full: only the tests of these rows, such as 31-39,45.  [default: all]")
@click.option(
    "--work",
    type=click.Path(file_okay=False, path_type=Path),
    help="With --full: folder of the results, of one commit.  [default: build/reliability-COMMIT]",
)
@click.option(
    "--lines",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="Run nothing; make the page from the lines of pytest --matrix FILE.",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    default=ROOT / "docs" / "reliability.md",
    show_default="docs/reliability.md",
    help="The page.",
)
def cli(full: bool, rows: str | None, work: Path | None, lines: Path | None, out: Path) -> int:
    check_not_input(out, *([] if lines is None else [lines]))
    if full and lines is not None:
        raise UsageError("found --full and --lines, expected one of them: --full runs tests, --lines runs none")
    if full:
        return full_matrix(work, rows, out)
    if rows or work:
        raise UsageError(f"{'--rows' if rows else '--work'} is an option of --full; add --full")
    code = 0
    with tempfile.TemporaryDirectory() as folder:
        if lines is None:
            lines = Path(folder) / "lines.jsonl"
            lines.touch()
            code = run_tests(lines)
        by_number = by_row(read(lines))
    with written(out) as new:
        new.write_text(page(by_number, "make reliability"), encoding="utf-8")
    click.echo(f"{score(by_number)} {out}")
    return 0 if not code and all(met(by_number.get(row, [])) for row in ROWS) else 1


main = entry(cli, resumable="--full" in sys.argv)

if __name__ == "__main__":
    main()
