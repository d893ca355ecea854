"""Failure matrix, rows 11 and 12: every way out of a running modsoft-runtime, on the emulated board."""

import signal
import time

import numpy as np
import pytest
from mega_in_run import side_by_side
from runtime_in_run import FAULTY, SCRIPT, Run, Stand

pytestmark = pytest.mark.realtime

BOARD_ALONE_S = 0.8  # after that it has vented by its own timer
VENTED = "valves vented: yes, said by the board"
UNKNOWN = "valves vented: NOT KNOWN"


def by_signal(number):
    return lambda run: run.process.send_signal(number)


def tracker(**fault):
    return lambda run: run.stand.tracker.send(fault)


def board(command):
    return lambda run: run.stand.board.send(command)


# What ends the run, its exit code, and whether the board can still say that it is vented.
CAUSES = {
    "SIGINT": (by_signal(signal.SIGINT), 130, True),
    "SIGTERM": (by_signal(signal.SIGTERM), 143, True),
    "SIGHUP": (by_signal(signal.SIGHUP), 129, True),
    "exception": (by_signal(signal.SIGUSR1), 70, True),
    "tracker lost": (tracker(unplug=True), 74, True),
    "board lost": (board("unplug"), 74, False),
}


@pytest.mark.parametrize("name", CAUSES)
def test_row_12_every_way_out_vents(name, matrix_row, full, model_file, tmp_path):
    cause, code, can_say = CAUSES[name]
    phases_s = np.random.default_rng(12).uniform(0.0, 4.0, 100 if full else 4)  # arming takes 1.2 of it

    def attempt(number):
        folder = tmp_path / str(number)
        program = FAULTY if name == "exception" else (str(SCRIPT),)
        with Stand() as stand, Run(stand, model_file, folder, program=program) as run:
            run.wait_for(run.armed)
            time.sleep(phases_s[number])
            began_ns = time.monotonic_ns()
            cause(run)
            found, left_ns = run.left()
            assert found == code, run.said
            if not can_say:
                time.sleep(BOARD_ALONE_S)
            assert max(stand.board.duties(), default=0.0) == 0.0, run.said
            closed_ns, log = run.closed_ns(), run.log()
            end = log.events[-1]
            assert (end["event"], log.meta["exit_code"], end["exit_code"]) == ("end", code, code)
            assert end["vented"] == log.meta["vented"] == can_say, run.said
            [said_ns] = [at_ns for at_ns, line in run.words if line.endswith(VENTED if can_say else UNKNOWN) or
                         UNKNOWN in line]  # fmt: skip
            assert (VENTED in run.said) == can_say
            if can_say:
                assert closed_ns < end["vented_ns"] < said_ns < left_ns
            return (closed_ns - began_ns) * 1e-9, (left_ns - began_ns) * 1e-9

    vented_s, left_s = map(max, zip(*side_by_side(len(phases_s), attempt, 4), strict=True))
    word = '"vented" said after the board said so' if can_say else '"vented" never said'
    matrix_row(12, fault=f"{name}, at a random phase", tries=len(phases_s), limit=f"valves at 0, {word}, exit {code}",
               worst=f"all; at 0 after {vented_s:.2f} s, left after {left_s:.2f} s", clock="host")  # fmt: skip
