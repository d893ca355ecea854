"""The emulated board on a clock that its host winds: nothing depends on how fast this machine is."""

from __future__ import annotations

import subprocess
import threading
import time
from typing import Any

import pytest

from modsoft.hil.board import emulator
from modsoft.hil.board.emulator import EmulatedBoard, is_event
from modsoft.hil.board.stepped_port import SteppedPort
from modsoft.runtime.board.board import Board
from modsoft.runtime.board.codec import Parser, encode
from modsoft.runtime.board.protocol import Arm, Status


def hello_at_s(port: SteppedPort) -> float:
    board = Board(port, "the board", port.clock, threaded=False)
    try:
        return port.clock()
    finally:
        board.close()


def test_time_does_not_advance_between_steps(board_name: str) -> None:
    with EmulatedBoard(board_name, stepped=True) as board:
        board.run(1500, 0)
        before_us = board.last_run["t_us"]
        time.sleep(0.05)
        board.send("stats")
        assert board.wait_for(is_event("stats"), 5)["t_us"] == before_us == pytest.approx(1500, abs=1)
        assert board.clock == "emulated, step by step"


def test_every_opening_takes_the_same_time(board_name: str) -> None:
    took_s = []
    with EmulatedBoard(board_name, stepped=True) as board:
        for _ in range(3):
            opened_s = board.last_run["t_us"] * 1e-6
            took_s.append(hello_at_s(SteppedPort(board)) - opened_s)
            board.run(1000, 0)
    assert len([event for event in board.trace if event["event"] == "uart-open"]) == 3
    assert max(took_s) - min(took_s) < 0.0051  # one step


def test_written_bytes_arrive_in_the_next_step(board_name: str) -> None:
    with EmulatedBoard(board_name, stepped=True) as board:
        port = SteppedPort(board)
        port.idle(1.0)
        for number in range(1, 6):
            port.write(bytes(40))
            port.idle(0.01)  # 40 bytes take 1.6 ms
            assert board.last_run["from_host"] == 40 * number
        assert port.in_waiting > 0
        port.close()
    assert board.summary["rx"] == 200


def test_bytes_have_the_baud_rate_that_was_set_before_them() -> None:
    with EmulatedBoard("native", stepped=True) as board:
        port = SteppedPort(board)
        port.idle(1.0)
        for _ in range(4):
            for baud in (115_200, 250_000):
                port._port.baudrate = baud
                port.write(b"\x01")
                port.idle(0.0005)
        port.close()
    assert board.summary["wrong_baud"] == 4


def test_port_is_not_closed_while_another_thread_starts_a_board(monkeypatch: pytest.MonkeyPatch) -> None:
    class Popen(subprocess.Popen[bytes]):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            closing.start()
            time.sleep(0.05)
            assert port._port.is_open
            super().__init__(*arguments, **options)

    with EmulatedBoard("native", stepped=True) as board:
        port = SteppedPort(board)
        closing = threading.Thread(target=port.close)
        monkeypatch.setattr(emulator.subprocess, "Popen", Popen)
        with EmulatedBoard("native", stepped=True):
            closing.join()
        assert not port._port.is_open


@pytest.mark.usefixtures("simavr")
def test_no_byte_is_lost_at_the_rate_of_the_line() -> None:
    """Each frame is answered, so the firmware receives and sends at once. 63 bytes have room in its receive buffer."""
    frames, blocks = 16, 16
    with EmulatedBoard("simavr", bootloader=False, stepped=True) as board:
        port = SteppedPort(board)
        port.idle(0.2)
        for _ in range(blocks):
            port.write(frames * encode(Arm(0, 0, 1, 0, 0)))  # refused
            port.idle(frames * len(encode(Arm(0, 0, 1, 0, 0))) * 40e-6)
            port.read(port.in_waiting)
        port.idle(0.1)
        replies = Parser().feed(port.read(port.in_waiting))
        counts = [reply.message for reply in replies if isinstance(reply.message, Status)][-1]
        port.close()
    assert (counts.rx_good, counts.rx_bad, counts.rx_refused) == (frames * blocks, 0, frames * blocks)
