"""The firmware on the emulated board, driven by a bare host: outputs, and what stops them."""

from __future__ import annotations

import time
from typing import Any

import pytest

from modsoft.hil.emulator import EmulatedBoard, Event, is_event

pytestmark = pytest.mark.realtime


def zero_at_us(trace: list[Event], since: int, channels: int) -> float:
    """Emulated time at which the last of the open channels went to 0; none may open again after it."""
    before, duties, zero_us = trace[:since], [0.0] * channels, None
    for event in before:
        if event["event"] == "pwm":
            duties[event["channel"]] = event["duty"]
    for event in trace[since:]:
        if event["event"] == "pwm":
            duties[event["channel"]] = event["duty"]
            zero_us = event["t_us"] if not any(duties) else None
    assert zero_us is not None, f"still open: {duties}"
    return zero_us


PRESSURES_BAR = (0.08, 0.35, 0.1, 0.2, 0.3, 0.25, 0.08, 0.35, 0.12, 0.17, 0.33)


def test_duties_are_what_was_commanded(board_name: str, drive: Any) -> None:
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


def test_host_killed_vents_all_valves(board_name: str, drive: Any) -> None:
    with EmulatedBoard(board_name) as board:
        board.send("sensors 20")
        host = drive(board, *["0.35"] * 11)
        host.until(state=3, applied=[3500] * 11 + [0])
        since = len(board.trace)
        host.kill()
        closed = board.wait_for(is_event("uart-close"), 2, since)
        time.sleep(0.9)
        took_ms = (zero_at_us(board.trace, since, 11) - closed["t_us"]) / 1000
        print(f"{board_name}: all valves 0 {took_ms:.0f} ms after the host was killed at 0.35 bar, emulated time")
        assert 200 < took_ms <= 670


@pytest.mark.parametrize("command", ["hang", "hang cli"])
def test_firmware_that_hangs_is_stopped_by_the_watchdog(board_name: str, command: str, drive: Any) -> None:
    with EmulatedBoard(board_name) as board:
        board.send("sensors 20")
        host = drive(board, *["0.35"] * 11)
        boot_id = host.until(state=3, applied=[3500] * 11 + [0])["boot_id"]
        since = len(board.trace)
        board.send(command)
        hung = board.wait_for(is_event("hang"), 2, since)
        board.wait_for(is_event("reset", cause="watchdog"), 2, since)
        host.kill()
        time.sleep(0.2)
        took_ms = (zero_at_us(board.trace, since, 11) - hung["t_us"]) / 1000
        print(f"{board_name}: all valves 0 {took_ms:.1f} ms after the firmware hung ({command}), emulated time")
        assert took_ms <= 130
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
