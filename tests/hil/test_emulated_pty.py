"""The serial port of the emulated board: opening, bootloader, DTR, baud rates, noise, unplugging."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest
import serial

from modsoft.hil.board.emulator import EmulatedBoard, is_event
from modsoft.runtime.board.codec import Parser, encode
from modsoft.runtime.board.protocol import PROTOCOL_HASH, Hello, HelloReq, ResetCause

BAUD = 250_000
HELLO_TIMEOUT_S = 5.0
pytestmark = pytest.mark.realtime


def wait_for_hello(port: serial.Serial, timeout_s: float = HELLO_TIMEOUT_S) -> tuple[Hello, float]:
    """Returns HELLO and the host time until it arrived."""
    parser, start = Parser(), time.monotonic()
    while time.monotonic() - start < timeout_s:
        for frame in parser.feed(port.read(128)):
            if isinstance(frame.message, Hello):
                return frame.message, time.monotonic() - start
    raise TimeoutError


@pytest.mark.usefixtures("simavr")
def test_quiet_open_gets_a_hello_through_the_bootloader() -> None:
    with EmulatedBoard("simavr") as board, serial.Serial(board.port, BAUD, timeout=0.01, exclusive=True) as port:
        hello, after_s = wait_for_hello(port)
        print(f"HELLO after {after_s:.3f} s")
        assert hello.protocol_hash == PROTOCOL_HASH
        assert 0.75 < after_s < 1.1
    with EmulatedBoard("simavr", bootloader=False) as board, serial.Serial(board.port, BAUD, timeout=0.01) as port:
        assert wait_for_hello(port)[1] < 0.2


@pytest.mark.usefixtures("simavr")
def test_bytes_after_opening_keep_the_board_in_the_bootloader() -> None:
    with EmulatedBoard("simavr") as board, serial.Serial(board.port, BAUD, timeout=0.3, exclusive=True) as port:
        parser, received = Parser(), []
        for _ in range(7):  # 2.1 s: more than twice the time a quiet host has to wait
            port.write(encode(HelloReq(PROTOCOL_HASH)))
            received += parser.feed(port.read(64))
        assert received == []
        port.timeout = 0.01
        silent_s = wait_for_hello(port, 8)[1]
        print(f"out of the bootloader after {silent_s:.2f} s of silence")
        assert 4 < silent_s < 5.5
    assert board.summary["rx_bootloader"] == 7 * len(encode(HelloReq(PROTOCOL_HASH)))


def test_every_opening_resets_the_board_and_increments_the_boot_id(board_name: str) -> None:
    with EmulatedBoard(board_name) as board:
        ids = []
        for _ in range(2):
            with serial.Serial(board.port, BAUD, timeout=0.01) as port:
                ids.append(wait_for_hello(port)[0].boot_id)
            board.wait_for(is_event("uart-close"), 2, len(board.trace) - 3)
    assert ids[1] == ids[0] + 1
    assert [event["cause"] for event in board.trace if event["event"] == "reset"] == [
        "power-on",
        "external",
        "external",
    ]


def test_power_cycle_starts_with_a_new_boot_id(board_name: str) -> None:
    with EmulatedBoard(board_name) as board, serial.Serial(board.port, BAUD, timeout=0.01) as port:
        first = wait_for_hello(port)[0]
        board.send("power-cycle")
        second = wait_for_hello(port)[0]
    assert second.boot_id not in (first.boot_id, first.boot_id + 1)
    assert second.reset_cause == ResetCause.POWER_ON


def test_rate_zero_pulses_dtr(board_name: str) -> None:
    with EmulatedBoard(board_name) as board, serial.Serial(board.port, BAUD, timeout=0.01) as port:
        first = wait_for_hello(port)[0]
        port.baudrate = 0
        time.sleep(0.05)
        port.baudrate = BAUD
        assert wait_for_hello(port)[0].boot_id == first.boot_id + 1


def test_wrong_rate_gives_noise(board_name: str) -> None:
    with EmulatedBoard(board_name) as board, serial.Serial(board.port, 115_200, timeout=0.05) as port:
        board.wait_for(is_event("wrong-baud", host=115_200, board=BAUD), 3)
        port.timeout = 0.5
        received = port.read(200)
        assert len(received) == 200
        assert Parser().feed(received) == []


def test_board_can_be_unplugged_and_plugged_in_at_another_port(board_name: str, tmp_path: Path) -> None:
    with EmulatedBoard(board_name) as board:
        port = serial.Serial(board.port, BAUD, timeout=0.5)
        wait_for_hello(port)
        board.send("unplug")
        with pytest.raises((serial.SerialException, OSError)):  # noqa: PT012
            while True:
                port.read(64)
        port.close()
        assert not os.path.lexists(board.port)
        elsewhere = tmp_path / "ttyACM1"
        board.send(f"plug {elsewhere}")
        board.wait_for(is_event("command", line=f"plug {elsewhere}"), 2)
        with serial.Serial(str(elsewhere), BAUD, timeout=0.01) as port:
            wait_for_hello(port)


def test_flood_arrives_at_line_rate_and_the_firmware_replies_after_it(board_name: str) -> None:
    with EmulatedBoard(board_name) as board, serial.Serial(board.port, BAUD, timeout=0.01) as port:
        wait_for_hello(port)
        board.send("flood 1000")
        start = board.wait_for(is_event("command", line="flood 1000"), 2)
        time.sleep(1.2)
        port.write(b"\0" + encode(HelloReq(PROTOCOL_HASH)))
        assert wait_for_hello(port, 1)[0].protocol_hash == PROTOCOL_HASH
    assert 24_900 < board.summary["rx"] < 25_100
    assert not [event for event in board.trace if event["event"] == "reset" and event["t_us"] > start["t_us"]]
