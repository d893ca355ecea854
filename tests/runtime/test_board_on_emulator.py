"""`Board` through a real serial port driver, in real time, on the emulated MEGA (without simavr the native board)."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from modsoft.hil.emulator import EmulatedBoard, choose, is_event, missing_packages
from modsoft.runtime import robot
from modsoft.runtime.board import Board
from modsoft.runtime.errors import DeviceAbsent, LostInRun, PortBusy
from modsoft.runtime.protocol import ResetCause, VentMode

pytestmark = pytest.mark.realtime

ROBOT = robot.load("pneumatic-3")
PERIOD_S = 0.4


@pytest.fixture
def emulated():
    if missing := missing_packages(choose()):
        pytest.skip(f"no emulated board without Debian packages: {' '.join(missing)}")
    with EmulatedBoard() as board:
        board.send("sensors 50")
        yield board


@pytest.fixture
def running(emulated):
    """A board in mid-run at 0.2 bar, and its `EmulatedBoard`."""
    board = Board.open(emulated.port)
    board.arm(ROBOT)
    ticks(board, 1, 2)
    yield board, emulated
    board._shut()


def ticks(board, first, count):
    latencies = []
    for tick in range(first, first + count):
        board.set_pressures(tick, np.full(6, 0.2))
        time.sleep(PERIOD_S)
        latencies.append(board.ack_latency_s)
    return latencies


def until_lost(board, limit_s):
    start = time.monotonic()
    while board.lost is None and time.monotonic() - start < limit_s:
        time.sleep(0.001)
    assert board.lost is not None
    return time.monotonic() - start


def test_whole_run(emulated):
    opened = time.monotonic()
    with Board.open(emulated.port) as board:
        open_s = time.monotonic() - opened
        board.arm(ROBOT)
        latencies = ticks(board, 1, 6)
        print(f"open {open_s:.2f} s, ack median {1e3 * np.median(latencies):.1f} worst {1e3 * max(latencies):.1f} ms")
        np.testing.assert_allclose(board.applied_bar[:6], 0.2)
        np.testing.assert_allclose(board.measured_bar[:6], 0.2, atol=0.005)
        np.testing.assert_allclose(emulated.duties()[:6], round(2000 * 4096 / 30000) / 4096, atol=1e-5)
        assert board.statistics["missed_acks"] == board.statistics["refused"] == board.statistics["bad_frames"] == 0
        assert board.vent()
        assert not any(emulated.duties())
        assert max(latencies) < 0.1
    assert emulated.wait_for(is_event("uart-close"), 2.0)


def test_cable_pulled(running):
    board, emulated = running
    emulated.send("unplug")
    emulated.wait_for(is_event("command", line="unplug"), 2.0)
    assert until_lost(board, 2.0) <= 0.15
    with pytest.raises(LostInRun):
        board.set_pressures(9, np.full(6, 0.2))
    started = time.monotonic()
    assert board.vent() is False
    assert time.monotonic() - started < 0.1
    time.sleep(0.7)
    assert not any(emulated.duties())


def test_reset_in_mid_run_is_lost_then_silent_then_vented_by_the_boards_own_word(running):
    board, emulated = running
    before = board.hello.boot_id
    emulated.send("reset")
    emulated.wait_for(is_event("command", line="reset"), 2.0)
    assert until_lost(board, 2.0) <= 1.2
    assert board.vent()
    assert board.close()
    emulated.wait_for(is_event("uart-close"), 2.0)
    with Board.open(emulated.port) as again:
        assert again.hello.boot_id != before


def test_hang_is_told_as_the_watchdogs_work(running):
    board, emulated = running
    emulated.send("hang")
    until_lost(board, 2.0)
    assert board.vent()
    if emulated.board == "simavr":
        assert board.status.boot_id == board.hello.boot_id + 1


def test_reset_causes(emulated):
    with Board.open(emulated.port) as board:
        assert board.hello.reset_cause in (ResetCause.POWER_ON, ResetCause.EXTERNAL)
    emulated.wait_for(is_event("uart-close"), 2.0)
    with Board.open(emulated.port) as board:
        assert board.hello.reset_cause == ResetCause.EXTERNAL


def test_first_announcement_lost_then_reset_through_the_line(emulated):
    """A pseudo-terminal has no DTR: closing and opening stand for it."""

    def speak_again():
        emulated.wait_for(is_event("uart-close"), 6.0)
        emulated.send("drop-tx 0")

    emulated.send("drop-tx 1")
    emulated.wait_for(is_event("command", line="drop-tx 1"), 2.0)
    opened = time.monotonic()
    helper = threading.Thread(target=speak_again)
    helper.start()
    with Board.open(emulated.port) as board:
        took = time.monotonic() - opened
        helper.join()
        board.arm(ROBOT)
    assert 3.1 < took < 5.5
    assert len([event for event in emulated.trace if event["event"] == "uart-open"]) == 2


def test_port_in_use(running):
    _, emulated = running
    started = time.monotonic()
    with pytest.raises(PortBusy, match="in use by another program"):
        Board.open(emulated.port)
    assert time.monotonic() - started < 3.0


def test_dump(running):
    board, emulated = running
    assert board.vent(VentMode.DUMP)
    assert not any(emulated.duties())


def test_port_that_is_no_board(tmp_path):
    plain = tmp_path / "plain"
    plain.write_text("")
    with pytest.raises(DeviceAbsent, match="no serial port"):
        Board.open(str(plain))
