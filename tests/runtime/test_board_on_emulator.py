"""`Board` on a pseudo-terminal, in real time, with the emulated MEGA (without simavr the native board).

Faults are tested in tests/reliability.
"""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from modsoft.runtime import robot as robot_file
from modsoft.runtime.board.board import Board
from modsoft.runtime.board.protocol import ResetCause, VentMode

pytest.importorskip("fcntl", reason="the rig needs Linux")
from modsoft.hil.board.emulator import EmulatedBoard, is_event
from modsoft.hil.board.toolchain import choose, missing_packages

pytestmark = pytest.mark.realtime

ROBOT = robot_file.load("pneumatic-3")
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
    """A running board at 0.2 bar, and its `EmulatedBoard`."""
    board = Board.open(emulated.port)
    board.arm(ROBOT)
    ticks(board, 1, 2)
    yield board, emulated
    board._io_thread.close()


def ticks(board, first, count):
    latencies = []
    for tick in range(first, first + count):
        board.set_pressures(tick, np.full(6, 0.2))
        time.sleep(PERIOD_S)
        latencies.append(board.ack_latency_s)
    return latencies


def test_run(emulated):
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


def test_reset_causes(emulated):
    with Board.open(emulated.port) as board:
        assert board.hello.reset_cause in (ResetCause.POWER_ON, ResetCause.EXTERNAL)
    emulated.wait_for(is_event("uart-close"), 2.0)
    with Board.open(emulated.port) as board:
        assert board.hello.reset_cause == ResetCause.EXTERNAL


def test_board_is_reset_when_its_first_hello_is_lost(emulated):
    """A pseudo-terminal has no DTR: closing and opening it resets the board."""

    def stop_dropping():
        emulated.wait_for(is_event("uart-close"), 6.0)
        emulated.send("drop-tx 0")

    emulated.send("drop-tx 1")
    emulated.wait_for(is_event("command", line="drop-tx 1"), 2.0)
    opened = time.monotonic()
    helper = threading.Thread(target=stop_dropping)
    helper.start()
    with Board.open(emulated.port) as board:
        took_s = time.monotonic() - opened
        helper.join()
        board.arm(ROBOT)
    assert 3.1 < took_s < 5.5
    assert len([event for event in emulated.trace if event["event"] == "uart-open"]) == 2


def test_venting_by_dump(running):
    board, emulated = running
    assert board.vent(VentMode.DUMP)
    assert not any(emulated.duties())
