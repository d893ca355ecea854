"""Failure matrix, rows 11 and 12: every way out of a running modsoft-runtime, on the emulated board."""

import os
import signal
import time

import numpy as np
import pytest
from mega_in_run import in_stepped_run, inject, side_by_side
from output_rises import rises
from runtime_in_run import FAULTY, SCRIPT, Run, Stand, if_begun

from modsoft.hil.outputs import read_outputs
from modsoft.runtime.board.protocol import Fault, State
from modsoft.runtime.errors import LostInRun, Tripped

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
    "board restarts": (board("reset"), 74, True),
}


AT_ONCE = 6  # mostly idle, all of them


def program_for(name):
    return FAULTY if name == "exception" else (str(SCRIPT),)


def test_row_12_every_way_out_vents(matrix_row, full, model_file, tmp_path):
    tries = 100 if full else 4
    phases_s = (np.arange(tries) + np.random.default_rng(12).uniform(size=tries)) * 5.0 / tries  # 1.2 s of it arming
    attempts = [(name, phase_s) for name in CAUSES for phase_s in phases_s]

    @if_begun
    def attempt(number):
        name, phase_s = attempts[number]
        cause, code, can_say = CAUSES[name]
        folder = tmp_path / str(number)
        with Stand() as stand, Run(stand, model_file, folder, program=program_for(name)) as run:
            run.wait_for(run.armed)
            time.sleep(phase_s)
            began_ns = time.monotonic_ns()
            cause(run)
            found, left_ns = run.left()
            assert found == code, run.said
            if not can_say:
                time.sleep(BOARD_ALONE_S)
            assert stand.highest_bar() == 0.0, run.said
            closed_ns, log = run.closed_ns(), run.log()
            end = log.events[-1]
            assert (end["event"], log.meta["exit_code"], end["exit_code"]) == ("end", code, code)
            assert end["vented"] == log.meta["vented"] == can_say, run.said
            [said_ns] = [at_ns for at_ns, line in run.words if line.startswith("valves vented")]
            assert (VENTED in run.said, UNKNOWN in run.said) == (can_say, not can_say)
            assert log.meta["reason"] in run.said
            assert run.words[-1][1].startswith("modsoft-runtime: ")
            if can_say:
                assert closed_ns < end["vented_ns"] < said_ns < left_ns
            return name, (closed_ns - began_ns) * 1e-9 if closed_ns else None, (left_ns - began_ns) * 1e-9

    results = side_by_side(len(attempts), attempt, AT_ONCE)
    for name, (_, code, can_say) in CAUSES.items():
        vented_s = [vented for told, vented, _ in results if told == name and vented is not None]
        left_s = max(left for told, _, left in results if told == name)
        word = "said after the board said so" if can_say else "never said"
        matrix_row(
            12,
            fault=f"{name}, at a random phase",
            tries=tries,
            limit=f'at 0, "vented" {word}, exit {code}',
            worst=f"all; {len(vented_s)} under pressure: at 0 after {max(vented_s):.2f} s, left after {left_s:.2f} s",
            clock="host",
        )
        assert len(vented_s) >= tries / 2


def test_row_12_nobody_says_vented_for_a_board_that_is_not_heard(matrix_row, model_file, tmp_path):
    """The line from the board is cut just before: it vents as it should, but its word never comes."""
    names = ["SIGINT", "SIGTERM", "SIGHUP", "exception", "tracker lost", "board restarts"]

    @if_begun
    def attempt(number):
        cause, code, _ = CAUSES[names[number]]
        program, folder = program_for(names[number]), tmp_path / str(number)
        with Stand() as stand, Run(stand, model_file, folder, program=program) as run:
            run.wait_for(lambda: run.ticks() >= 2)
            inject(stand.board, "drop-tx 1")
            cause(run)
            assert run.left()[0] == code, run.said
            assert stand.highest_bar() == 0.0
            assert (VENTED in run.said, UNKNOWN in run.said) == (False, True)
            end = run.log().events[-1]
            assert (end["vented"], end["vented_ns"]) == (False, None)

    side_by_side(len(names), attempt, AT_ONCE)
    matrix_row(
        12,
        fault="each of these, and the board is not heard any more",
        tries=len(names),
        limit='"vented" never said, same exit code',
        worst="never said",
    )


def test_row_12_a_signal_before_arming_opens_no_valve(matrix_row, full, model_file, tmp_path):
    """From the tracker's first frame on: while the board is looked for, and between that and arming."""
    phases_s = np.linspace(0.0, 1.0, 20 if full else 3)
    attempts = [(name, phase_s) for name in ("SIGINT", "SIGTERM", "SIGHUP") for phase_s in phases_s]

    @if_begun
    def attempt(number):
        name, phase_s = attempts[number]
        cause, code, _ = CAUSES[name]
        with Stand() as stand, Run(stand, model_file, tmp_path / str(number)) as run:
            run.wait_for(lambda: "hangs at" in run.said)
            time.sleep(phase_s)
            began_ns = time.monotonic_ns()
            cause(run)
            assert run.process.wait(10) == code, run.said
            took_s = (time.monotonic_ns() - began_ns) * 1e-9
            assert not any(event["event"] == "pwm" and event["duty"] > 0 for event in stand.board.trace)
            return took_s

    worst_s = max(side_by_side(len(attempts), attempt, AT_ONCE))
    matrix_row(
        12,
        fault="a signal before arming",
        tries=len(attempts),
        limit="no valve opens, exit code of the signal",
        worst=f"none; left after {worst_s:.2f} s",
        clock="host",
    )


# ---- Row 11: the host stands still


STAND_STILL = {
    "process stopped": (by_signal(signal.SIGSTOP), 670, {74, 79}),
    "control thread stuck, the port's thread lives": (by_signal(signal.SIGUSR2), 1400, {79}),
}


@pytest.mark.parametrize("name", STAND_STILL)
def test_row_11_host_stands_still(name, matrix_row, full, strong_model, tmp_path):
    cause, limit_ms, codes = STAND_STILL[name]
    phases_s = np.random.default_rng(11).uniform(0.0, 0.4, 100 if full else 4)

    @if_begun
    def attempt(number):
        with Stand() as stand, Run(stand, strong_model, tmp_path / str(number), program=FAULTY) as run:
            run.wait_for(lambda: run.ticks() >= 6)
            time.sleep(phases_s[number])
            assert stand.highest_bar() > 0.34, "less to vent than there can be"
            now, since = inject(stand.board, "stats", "stats")
            cause(run)
            time.sleep(3.0)
            took_ms = read_outputs(list(stand.board.trace)).vented_after_ms(now["t_us"])
            run.process.send_signal(signal.SIGCONT)
            code, _ = run.left()
            assert code in codes, run.said
            assert ("CONTROL_TIMEOUT" in run.said) == (79 in codes and 74 not in codes), run.said
            assert rises(stand.board.trace, since) == 0
            return took_ms

    worst_ms = max(side_by_side(len(phases_s), attempt, 4))
    matrix_row(
        11,
        fault=name,
        tries=len(phases_s),
        limit=f"all 0 in {limit_ms} ms, never opened again",
        worst=f"{worst_ms:.0f} ms",
        clock="emulated",
    )
    assert worst_ms <= limit_ms


@pytest.mark.parametrize(
    ("fault", "error"), [(Fault.LINK_TIMEOUT, LostInRun), (Fault.CONTROL_TIMEOUT, Tripped)], ids=["all", "loop"]
)
def test_row_11_the_fault_stays_latched_for_a_host_that_comes_back(fault, error, matrix_row, full):
    """The host's own classes, halted: all of it, or only the control loop."""

    def beat_for(host, seconds):
        until_s = host.clock() + seconds
        while host.clock() < until_s:
            host.board._io_thread.pump()

    tries = 50 if full else 3
    for _ in range(tries):
        with in_stepped_run() as (host, emulated):
            if fault == Fault.LINK_TIMEOUT:
                host.port.idle(2.0)
            else:
                beat_for(host, 2.0)
            since = len(emulated.trace)
            with pytest.raises(error):
                host.run_for(1.0)
            host.board.publish_tick(host.tick + 100)
            beat_for(host, 1.0)
            assert (host.board.status.state, host.board.status.faults) == (State.FAULT, fault)
            assert rises(emulated.trace, since) == 0
    matrix_row(
        11,
        fault=f"host comes back after {fault.name}",
        tries=tries,
        limit="fault latched, nothing opens",
        worst="all latched",
        clock="emulated",
    )


# ---- Row 12, by hand


@pytest.fixture
def terminal():
    master, slave = os.openpty()
    ends = {"master": master, "slave": slave}
    yield ends
    for end in ends.values():
        os.close(end)


def test_row_12_the_stop_key(model_file, tmp_path, terminal):
    with Stand() as stand, Run(stand, model_file, tmp_path, terminal=terminal["slave"]) as run:
        run.wait_for(lambda: run.ticks() >= 2)
        os.write(terminal["master"], b"q")
        code, left_ns = run.left()
        said = os.read(terminal["master"], 65536).decode(errors="replace")
        assert (code, VENTED in said, "stop key" in said) == (79, True, True), said
        assert stand.highest_bar() == 0.0
        assert run.closed_ns() < run.log().events[-1]["vented_ns"] < left_ns


def test_row_12_the_terminal_is_closed(model_file, tmp_path, terminal):
    """Nobody can be told any more; the valves are vented and the log is closed all the same."""
    with Stand() as stand, Run(stand, model_file, tmp_path, terminal=terminal["slave"]) as run:
        run.wait_for(lambda: run.ticks() >= 2)
        os.close(terminal.pop("slave"))
        os.close(terminal.pop("master"))
        assert run.left()[0] == 129
        assert stand.highest_bar() == 0.0
        assert (run.log().meta["exit_code"], run.log().meta["vented"]) == (129, True)
        assert run.closed_ns() < run.log().events[-1]["vented_ns"]
