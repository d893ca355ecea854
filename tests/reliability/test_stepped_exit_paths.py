"""Failure matrix, row 12: every way out of a run at a hundred phases, host and board on the board's own clock."""

import json
import signal

import numpy as np
import pytest
from output_rises import rises
from stepped_run import SteppedRun

from modsoft.hil.board.emulator import EmulatedBoard
from modsoft.hil.board.toolchain import missing_packages
from modsoft.hil.outputs import read_outputs
from modsoft.runtime.errors import INTERNAL_EXIT_CODE

missing = missing_packages("simavr")
pytestmark = pytest.mark.skipif(bool(missing), reason=f"simavr needs {' '.join(missing)}")

LONGEST_S = 5.0  # arming takes 1.2 of it, then comes a control step every 0.4


class UnexpectedError(Exception):
    """A bug."""


def raise_unexpected(run):
    raise UnexpectedError("a bug, injected")


def lose_tracker(run):
    run.frames.error = OSError("unplugged")


CAUSES = {
    "SIGINT": (lambda run: signal.raise_signal(signal.SIGINT), 130, True),
    "SIGTERM": (lambda run: signal.raise_signal(signal.SIGTERM), 143, True),
    "SIGHUP": (lambda run: signal.raise_signal(signal.SIGHUP), 129, True),
    "exception": (raise_unexpected, INTERNAL_EXIT_CODE, True),
    "tracker lost": (lose_tracker, 74, True),
    "board lost": (lambda run: run.emulated.send("unplug"), 74, False),
    "board restarts": (lambda run: run.emulated.send("reset"), 74, True),
}


@pytest.mark.parametrize("name", CAUSES)
def test_row_12_every_exit_path_vents_at_any_phase(name, matrix_row, full, tmp_path):
    cause, code, can_confirm = CAUSES[name]
    tries = 100 if full else 3
    phases_s = (np.arange(tries) + np.random.default_rng(12).uniform(size=tries)) * LONGEST_S / tries
    worst_s, pressed = 0.0, 0
    for number, phase_s in enumerate(phases_s):
        with EmulatedBoard("simavr", stepped=True) as emulated:
            emulated.send("sensors 20")
            run = SteppedRun(emulated, tmp_path / str(number), cause, phase_s).go()
            if not can_confirm:
                emulated.run(1_000_000, 0)
            assert getattr(run.error, "exit_code", INTERNAL_EXIT_CODE) == code, run.error
            assert max(emulated.duties()) == 0.0
            assert not run.forced_exits, "no forced exit"
            reports = [(highest, line) for _, highest, line in run.messages if line.startswith("valves vented")]
            word = "yes, confirmed by the board" if can_confirm else "NOT KNOWN"
            assert len(reports) == 1
            assert word in reports[0][1]
            assert reports[0][0] == 0.0 or not can_confirm, "reported while a valve was open"
            [end] = [
                json.loads(line)
                for line in (run.log.folder / "run.jsonl").read_text().splitlines()
                if '"event":"end"' in line
            ]
            assert (end["exit_code"], end["vented"]) == (code, can_confirm)
            opened = rises(emulated.trace) > 0
            pressed += opened
            if opened:
                worst_s = max(worst_s, 1e-3 * read_outputs(emulated.trace).vented_after_ms(1e6 * run.caused_s))
    matrix_row(
        12,
        fault=f"{name}, at any phase",
        tries=tries,
        clock="emulated",
        limit=f'at 0, "vented" {"after the board confirms it" if can_confirm else "never reported"}, exit {code}',
        worst=f"all; {pressed} under pressure: at 0 after {worst_s:.3f} s",
    )
    assert pressed >= tries / 2
