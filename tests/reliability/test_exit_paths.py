"""Failure matrix, rows 11 and 12: every exit path of a running modsoft-runtime, on the emulated board."""

import os
import signal
import time

import numpy as np
import pytest
from mega_in_run import in_stepped_run, inject, side_by_side
from output_rises import rises
from runtime_in_run import FAULTY, SCRIPT, Run, Stand, retry_until_begun

from modsoft.hil.outputs import read_outputs
from modsoft.runtime.board.protocol import Fault, State
from modsoft.runtime.errors import LostInRun, Tripped

pytestmark = pytest.mark.realtime

BOARD_ALONE_S = 0.8  # after that it has vented by its own timer
VENTED = "valves vented: yes, confirmed by the board"
UNKNOWN = "valves vented: NOT KNOWN"


def by_signal(number):
    return lambda run: run.process.send_signal(number)


def tracker(**fault):
    return lambda run: run.stand.tracker.send(fault)


def board(command):
    return lambda run: run.stand.board.send(command)


# The cause of the exit, the exit code, and whether the board can still confirm the vent.
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


def test_row_12_every_exit_path_vents(matrix_row, full, model_file, tmp_path):
    tries = 100 if full else 4
    phases_s = (np.arange(tries) + np.random.default_rng(12).uniform(size=tries)) * 5.0 / tries  # 1.2 s of it arming
    attempts = [(name, phase_s) for name in CAUSES for phase_s in phases_s]

    @retry_until_begun
    def attempt(number):
        name, phase_s = attempts[number]
        cause, code, can_confirm = CAUSES[name]
        folder = tmp_path / str(number)
        with Stand() as stand, Run(stand, model_file, folder, program=program_for(name)) as run:
            run.wait_for(run.armed)
            time.sleep(phase_s)
            began_ns = time.monotonic_ns()
            cause(run)
            exit_code, exited_ns = run.wait_exit()
            assert exit_code == code, run.output
            if not can_confirm:
                time.sleep(BOARD_ALONE_S)
            assert stand.highest_bar() == 0.0, run.output
            closed_ns, log = run.closed_ns(), run.log()
            end = log.end
            assert (log.meta["exit_code"], end.exit_code) == (code, code)
            assert end.vented == log.meta["vented"] == can_confirm, run.output
            [reported_ns] = [at_ns for at_ns, line in run.lines if line.startswith("valves vented")]
            assert (VENTED in run.output, UNKNOWN in run.output) == (can_confirm, not can_confirm)
            assert log.meta["reason"] in run.output
            assert run.lines[-1][1].startswith("modsoft-runtime: ")
            if can_confirm:
                assert closed_ns < end.vented_ns < reported_ns < exited_ns
            return name, (closed_ns - began_ns) * 1e-9 if closed_ns else None, (exited_ns - began_ns) * 1e-9

    results = side_by_side(len(attempts), attempt, AT_ONCE)
    for name, (_, code, can_confirm) in CAUSES.items():
        vented_s = [vented for cause, vented, _ in results if cause == name and vented is not None]
        left_s = max(left for cause, _, left in results if cause == name)
        word = "reported after the board confirms it" if can_confirm else "never reported"
        matrix_row(
            12,
            fault=f"{name}, at a random phase",
            tries=tries,
            limit=f'at 0, "vented" {word}, exit {code}',
            worst=f"all; {len(vented_s)} under pressure: at 0 after {max(vented_s):.2f} s, left after {left_s:.2f} s",
            clock="host",
        )
        assert len(vented_s) >= tries / 2


def test_row_12_vented_is_not_reported_without_the_board(matrix_row, model_file, tmp_path):
    """The line from the board is cut just before: the board vents, but its confirmation is lost."""
    names = ["SIGINT", "SIGTERM", "SIGHUP", "exception", "tracker lost", "board restarts"]

    @retry_until_begun
    def attempt(number):
        cause, code, _ = CAUSES[names[number]]
        program, folder = program_for(names[number]), tmp_path / str(number)
        with Stand() as stand, Run(stand, model_file, folder, program=program) as run:
            run.wait_for(lambda: run.ticks() >= 2)
            inject(stand.board, "drop-tx 1")
            cause(run)
            assert run.wait_exit()[0] == code, run.output
            assert stand.highest_bar() == 0.0
            assert (VENTED in run.output, UNKNOWN in run.output) == (False, True)
            end = run.log().end
            assert (end.vented, end.vented_ns) == (False, None)

    side_by_side(len(names), attempt, AT_ONCE)
    matrix_row(
        12,
        fault="each of these, with the line from the board cut",
        tries=len(names),
        limit='"vented" never reported, same exit code',
        worst="never reported",
    )


def test_row_12_signal_before_arming_opens_no_valve(matrix_row, full, model_file, tmp_path):
    """From the tracker's first frame on: while the board is looked for, and between that and arming."""
    phases_s = np.linspace(0.0, 1.0, 20 if full else 3)
    attempts = [(name, phase_s) for name in ("SIGINT", "SIGTERM", "SIGHUP") for phase_s in phases_s]

    @retry_until_begun
    def attempt(number):
        name, phase_s = attempts[number]
        cause, code, _ = CAUSES[name]
        with Stand() as stand, Run(stand, model_file, tmp_path / str(number)) as run:
            run.wait_for(lambda: "hangs at" in run.output)
            time.sleep(phase_s)
            began_ns = time.monotonic_ns()
            cause(run)
            assert run.process.wait(10) == code, run.output
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

    @retry_until_begun
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
            code, _ = run.wait_exit()
            assert code in codes, run.output
            assert ("CONTROL_TIMEOUT" in run.output) == (79 in codes and 74 not in codes), run.output
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
def test_row_11_fault_stays_latched_when_the_host_returns(fault, error, matrix_row, full):
    """The host's own classes, halted: all of it, or only the control loop."""

    def send_heartbeats(host, seconds):
        until_s = host.clock() + seconds
        while host.clock() < until_s:
            host.board._io_thread.pump()

    tries = 50 if full else 3
    for _ in range(tries):
        with in_stepped_run() as (host, emulated):
            if fault == Fault.LINK_TIMEOUT:
                host.port.idle(2.0)
            else:
                send_heartbeats(host, 2.0)
            since = len(emulated.trace)
            with pytest.raises(error):
                host.run_for(1.0)
            host.board.publish_tick(host.tick + 100)
            send_heartbeats(host, 1.0)
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
        code, exited_ns = run.wait_exit()
        output = os.read(terminal["master"], 65536).decode(errors="replace")
        assert (code, VENTED in output, "stop key" in output) == (79, True, True), output
        assert stand.highest_bar() == 0.0
        assert run.closed_ns() < run.log().end.vented_ns < exited_ns


def test_row_12_the_terminal_is_closed(model_file, tmp_path, terminal):
    """No terminal is left for messages; the valves are vented and the log is closed."""
    with Stand() as stand, Run(stand, model_file, tmp_path, terminal=terminal["slave"]) as run:
        run.wait_for(lambda: run.ticks() >= 2)
        os.close(terminal.pop("slave"))
        os.close(terminal.pop("master"))
        assert run.wait_exit()[0] == 129
        assert stand.highest_bar() == 0.0
        assert (run.log().meta["exit_code"], run.log().meta["vented"]) == (129, True)
        assert run.closed_ns() < run.log().end.vented_ns
