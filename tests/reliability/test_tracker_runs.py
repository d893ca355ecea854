"""Failure matrix, rows 31 to 37 and 39, in whole runs: modsoft-runtime on the emulated board, a tracker or client in
trouble. The limits of the robot file decide whether a run continues."""

import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from mega_in_run import side_by_side
from runtime_in_run import Run, Stand, retry_until_begun

from modsoft.runtime import robot as robot_file

pytestmark = pytest.mark.realtime

LIMIT_S = 3 * 0.4 + 0.05  # from the fault to the venting, as row 13
TICKS = 12  # of a run that continues
RANDOM = ["flip", "bit 7", "drop", "insert", "delay", "no return"]
# The fault, its row, the exit code, and a part of the message.
ENDING = {
    "no carriage returns": ({"damage": {"seed": 33, "kinds": ["no return"]}}, 33, 74, "no new frame"),
    "RMS error of 5 mm": ({"rms_mm": {"2": 5.0}}, 36, 79, "RMS error (module 2 5.00 mm"),
    "a tool out of the volume": ({"port_status": {"1": 0x71}}, 36, 79, "out of volume (module 1)"),
    "a jump of 90 degrees that stays": ({"jump": {"tool": 3, "deg": 90.0}}, 37, 79, "jump (module 3 by 90 degrees"),
}
CONTINUING = {
    "bit 7 set in each reply": ({"damage": {"seed": 31, "kinds": ["bit 7"]}}, 31),
    "a twentieth of the carriage returns lost": ({"damage": {"seed": 33, "rate": 0.05, "kinds": ["no return"]}}, 33),
    "a fifth of the replies damaged at random": ({"damage": {"seed": 39, "rate": 0.2, "kinds": RANDOM}}, 39),
}


def frame_statuses(log):
    return [record.frame_status for record in log.ticks]


def test_row_36_run_ends_within_its_limits(matrix_row, full, model_file, tmp_path):
    tries = 20 if full else 1
    attempts = [name for name in ENDING for _ in range(tries)]
    phases_s = np.random.default_rng(36).uniform(0.0, 0.4, len(attempts))

    @retry_until_begun
    def attempt(number):
        fault, _, code, text = ENDING[attempts[number]]
        with Stand() as stand, Run(stand, model_file, tmp_path / str(number)) as run:
            run.wait_for(lambda: run.ticks() >= 3)
            time.sleep(phases_s[number])
            began_ns = time.monotonic_ns()
            stand.tracker.send(fault)
            assert run.wait_exit()[0] == code, run.output
            assert text in run.output
            log = run.log()
            assert log.meta["vented"]
            assert stand.highest_bar() == 0.0
            return (log.events[-1].mono_ns - began_ns) * 1e-9

    took_s = side_by_side(len(attempts), attempt, 5)
    for name, (_, row, _, _) in ENDING.items():
        worst_s = max(took for each, took in zip(attempts, took_s, strict=True) if each == name)
        matrix_row(
            row,
            fault=f"{name}, in a run",
            tries=tries,
            limit=f"vent begins within {LIMIT_S:.2f} s",
            worst=f"{worst_s:.2f} s",
            clock="host",
            met=worst_s <= LIMIT_S,
        )
    assert max(took_s) <= LIMIT_S


def continues(run, ticks=TICKS):
    """The log of a run after `ticks` more control steps, ended by Ctrl-C."""
    until = run.ticks() + ticks
    run.wait_for(lambda: run.ticks() >= until)
    run.process.send_signal(signal.SIGINT)
    assert run.wait_exit()[0] == 130, run.output
    log = run.log()
    assert log.meta["vented"]
    return log


def test_row_39_run_continues_within_its_limits(matrix_row, full, model_file, tmp_path):
    tries = 20 if full else 1
    attempts = [name for name in CONTINUING for _ in range(tries)]

    @retry_until_begun
    def attempt(number):
        with Stand() as stand, Run(stand, model_file, tmp_path / str(number)) as run:
            run.wait_for(lambda: run.ticks() >= 2)
            stand.tracker.send(CONTINUING[attempts[number]][0])
            log = continues(run)
            used = [record.configuration for record in log.ticks if record.configuration is not None]
            assert np.ptp(np.array(used), axis=0).max() < 0.005, "a wrong configuration"
            return len(log.ticks) - frame_statuses(log).count("good")

    held = side_by_side(len(attempts), attempt, 5)
    for name, (_, row) in CONTINUING.items():
        worst = max(count for each, count in zip(attempts, held, strict=True) if each == name)
        matrix_row(
            row,
            fault=f"{name}, in a run",
            tries=tries * TICKS,
            limit="run continues, 0 wrong configurations",
            worst=f"{worst} ticks held",
            clock="host",
        )


def test_row_32_wrong_checksums_within_the_limits(matrix_row, model_file, tmp_path):
    with Stand() as stand, Run(stand, model_file, tmp_path) as run:
        run.wait_for(lambda: run.ticks() >= 2)
        for _ in range(3):
            stand.tracker.send({"corrupt": True})
            time.sleep(0.6)
            stand.tracker.send({"corrupt": False})
            before = run.ticks()
            run.wait_for(lambda before=before: run.ticks() >= before + 2)
        log = continues(run, 2)
    held = len(log.ticks) - frame_statuses(log).count("good")
    assert log.meta["tracker"]["unreadable"] > 3 * 3, "more than three in a row"
    matrix_row(
        32,
        fault="wrong checksums for 0.6 s, in a run",
        tries=3,
        limit="run continues",
        worst=f"{held} ticks held",
        clock="host",
    )


def client_of(process):
    """The process of the tracker's client."""
    for task in Path(f"/proc/{process.pid}/task").iterdir():
        for pid in (task / "children").read_text().split():
            if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes():
                return int(pid)
    raise AssertionError("no client")


def patient_robot(folder):
    """The shipped robot with a file that allows 8 s without a valid frame."""
    path = folder / "robot.toml"
    path.write_text(robot_file.text_of("pneumatic-3").replace("invalid_frames = 3 ", "invalid_frames = 20 "))
    return path


@pytest.mark.skipif(not Path("/proc").exists(), reason="finds the client in /proc")
def test_row_34_client_lost_in_a_run(matrix_row, full, model_file, tmp_path):
    tries = 20 if full else 1
    attempts = [number for number in (signal.SIGKILL, signal.SIGSEGV, signal.SIGSTOP) for _ in range(tries)]

    @retry_until_begun
    def attempt(number):
        folder = tmp_path / str(number)
        folder.mkdir()
        with Stand() as stand, Run(stand, model_file, folder, "--robot", str(patient_robot(folder))) as run:
            run.wait_for(lambda: run.ticks() >= 2)
            os.kill(client_of(run.process), attempts[number])
            log = continues(run)
            assert frame_statuses(log)[-1] == "good"
            return len(log.ticks) - frame_statuses(log).count("good")

    held = side_by_side(len(attempts), attempt, 3)
    matrix_row(
        34,
        fault="the client killed, crashed, halted in a run that allows 20 invalid frames",
        tries=len(attempts),
        limit="run continues",
        worst=f"{max(held)} ticks held",
        clock="host",
    )


def test_row_35_other_rates_in_a_run(matrix_row, model_file, tmp_path):
    rates_hz = (20, 30, 100)

    @retry_until_begun
    def attempt(number):
        folder = tmp_path / str(number)
        options = ("--frame-hz", str(rates_hz[number]))
        with Stand(tracker_options=options) as stand, Run(stand, model_file, folder) as run:
            run.wait_for(lambda: run.ticks() >= TICKS)
            stand.tracker.send({"delay_s": 1.0})
            assert run.wait_exit()[0] == 74, run.output
            return frame_statuses(run.log())[: TICKS - 1]

    statuses = side_by_side(len(rates_hz), attempt, 3)
    matrix_row(
        35,
        fault=f"trackers of {', '.join(map(str, rates_hz))} Hz in a run, then frames 1 s old",
        tries=len(rates_hz),
        limit="no tick held before the fault, ended by it",
        worst=f"{max(len(each) - each.count('good') for each in statuses)} ticks held",
        clock="host",
    )
    assert all(set(each) == {"good"} for each in statuses)
