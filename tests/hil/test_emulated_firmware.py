"""The emulated boards under a bare host: outputs, what stops those of the native one, noise."""

from __future__ import annotations

import time
from typing import Any

import pytest

from modsoft.hil.board.emulator import EmulatedBoard, is_event
from modsoft.hil.outputs import read_outputs

pytestmark = pytest.mark.realtime


PRESSURES_BAR = (0.08, 0.35, 0.1, 0.2, 0.3, 0.25, 0.08, 0.35, 0.12, 0.17, 0.33)


def test_duties_equal_the_commands(board_name: str, drive: Any) -> None:
    with EmulatedBoard(board_name) as board:
        board.send("sensors 20")
        host = drive(board, *map(str, PRESSURES_BAR))
        applied = [round(10_000 * pressure) for pressure in PRESSURES_BAR] + [0]
        status = host.until(state=3, applied=applied)
        board.send("stats")
        board.wait_for(is_event("stats"), 2)
        counts = [round(4096 * duty) for duty in board.duties()]
        assert counts == [round(4096 * pressure / board.ready["p_full_bar"]) for pressure in PRESSURES_BAR]
        measured = [host.next("status")["status"]["measured"] for _ in range(4)][-1]
        assert measured[:6] == pytest.approx(applied[:6], abs=25), "the sensors follow the valves"
        assert status["faults"] == 0


def test_native_board_vents_when_its_host_is_killed(drive: Any) -> None:
    """The compiled firmware: tests/reliability, row 10."""
    with EmulatedBoard("native") as board:
        host = drive(board, *["0.35"] * 11)
        host.until(state=3, applied=[3500] * 11 + [0])
        since = len(board.trace)
        host.kill()
        closed = board.wait_for(is_event("uart-close"), 2, since)
        time.sleep(0.9)
        assert 200 < read_outputs(board.trace).vented_after_ms(closed["t_us"]) <= 670


def test_native_board_that_hangs_restarts(drive: Any) -> None:
    """The compiled firmware: tests/reliability, row 28."""
    with EmulatedBoard("native") as board:
        host = drive(board, *["0.35"] * 11)
        boot_id = host.until(state=3, applied=[3500] * 11 + [0])["boot_id"]
        since = len(board.trace)
        board.send("hang")
        hung = board.wait_for(is_event("hang"), 2, since)
        board.wait_for(is_event("reset", cause="watchdog"), 2, since)
        host.kill()
        time.sleep(0.2)
        assert read_outputs(board.trace).vented_after_ms(hung["t_us"]) <= 130
        assert drive(board).next("hello")["hello"]["boot_id"] > boot_id, "and it runs again"


def test_noise_on_the_line_is_counted_by_both_ends(board_name: str, drive: Any) -> None:
    with EmulatedBoard(board_name) as board:
        board.send("corrupt-rx 0.01 7")
        host = drive(board, "--heartbeats", "400")
        host.next("hello")
        while (status := host.next("status")["status"])["rx_good"] + status["rx_bad"] < 380:
            pass
        assert status["rx_bad"] > 20
    assert 40 < board.summary["rx_corrupted"] < 120
