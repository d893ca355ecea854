"""The emulated ATmega2560 under a program of our own (probe.c), which does what firmware must not do."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import pytest
import serial

from modsoft.hil.board.emulator import EmulatedBoard, is_event
from modsoft.hil.board.stepped_port import SteppedPort

BAUD = 250_000  # of the echo; and of the firmware
pytestmark = pytest.mark.realtime


class Probe:
    """probe.c on the board: one byte in, its answer and then the same byte back."""

    def __init__(self, board: EmulatedBoard) -> None:
        self.board = board
        self.port = serial.Serial(board.port, 115_200, timeout=2)
        assert self.port.read(1) == b"R"

    def __call__(self, command: bytes, answer: int = 0) -> bytes:
        self.port.write(command)
        reply = self.port.read(answer + 1)
        assert reply[answer:] == command
        return reply[:answer]

    def duty(self, command: bytes) -> tuple[float, list[int]]:
        """Duty and raw registers of channel 0 after a command."""
        self(command)
        self.board.send("stats")
        self.board.wait_for(is_event("stats"), 2, len(self.board.trace))
        pwm = [event for event in self.board.trace if event["event"] == "pwm" and event["channel"] == 0]
        return (pwm[-1]["duty"], pwm[-1]["raw"]) if pwm else (0.0, [0, 0])


@pytest.mark.usefixtures("simavr")
def test_duty_is_that_of_the_pin(probe: Path) -> None:
    with EmulatedBoard("simavr", firmware=probe, bootloader=False) as board:
        chip = Probe(board)
        assert chip.duty(b"c") == (0.0, [0, 0]), "an input drives nothing"
        assert chip.duty(b"o") == (0.25, [249, 999])
        assert chip.duty(b"h") == (0.5, [499, 999])
        assert chip.duty(b"t") == (0.25, [499, 1999])
        assert chip.duty(b"i")[0] == 1.0, "a mode that is not modelled counts as open"
        assert chip.duty(b"x") == (0.0, [0, 0])
        assert chip.duty(b"p")[0] == 1.0, "a pin set high by hand is an open valve"
        chip.port.close()


@pytest.mark.usefixtures("simavr")
def test_uart_loses_the_bytes_that_the_chip_loses(probe: Path) -> None:
    with EmulatedBoard("simavr", firmware=probe, bootloader=False) as board:
        chip = Probe(board)
        chip.port.write(b"d0123456789")
        # Two in the buffer, the newest in the shift register; then the answer to the command itself.
        assert chip.port.read(4) == b"019d"
        assert chip.port.read(1) == b""
        chip.port.close()
    assert board.summary["rx_overrun"] == 7


@pytest.mark.usefixtures("simavr")
def test_uart_counts_a_byte_that_is_lost_after_a_gap(probe: Path) -> None:
    with EmulatedBoard("simavr", firmware=probe, bootloader=False, stepped=True) as board:
        port = SteppedPort(board, baud=115_200)
        port.idle(0.2)
        for data in (b"d0123", b"456"):
            port.write(data)
            port.idle(0.001)
        port.idle(0.02)
        assert port.read(port.in_waiting).endswith(b"016d")
        port.close()
    assert board.summary["rx_overrun"] == 4


@pytest.mark.usefixtures("simavr")
@pytest.mark.parametrize("millivolt", [0, 1234, 5000])
def test_analogue_input_returns_the_set_value(probe: Path, millivolt: int) -> None:
    with EmulatedBoard("simavr", firmware=probe, bootloader=False) as board:
        chip = Probe(board)
        board.send(f"adc 3 {millivolt}")
        board.send("stats")
        board.wait_for(is_event("stats"), 2)
        counts = int.from_bytes(chip(b"a", answer=2), "big")
        assert abs(counts - millivolt * 1023 / 5000) <= 1
        chip.port.close()


@pytest.mark.usefixtures("simavr")
def test_time_continues_while_the_chip_sleeps(probe: Path) -> None:
    with EmulatedBoard("simavr", firmware=probe, bootloader=False) as board:
        chip = Probe(board)
        chip.port.write(b"s")
        halted = board.wait_for(is_event("halted"), 2)
        board.send("reset")
        reset = board.wait_for(is_event("reset"), 2, board.trace.index(halted))
        assert reset["t_us"] >= halted["t_us"]
        assert chip.port.read(1) == b"R", "a reset brings it back"
        chip.port.close()


@pytest.mark.usefixtures("simavr")
def test_full_rate_loses_no_byte_either_way(probe: Path) -> None:
    sent = bytes(range(256)) * 40
    with EmulatedBoard("simavr", firmware=probe, bootloader=False) as board:
        chip = Probe(board)
        chip(b"e")  # from here on it echoes, at the firmware's rate
        chip.port.baudrate = BAUD
        threading.Thread(target=chip.port.write, args=(sent,)).start()
        start = time.monotonic()
        assert chip.port.read(len(sent)) == sent
        took_s = time.monotonic() - start
        chip.port.close()
    print(f"{len(sent)} bytes there and back in {took_s:.3f} s, {len(sent) * 10 / BAUD:.3f} s on the wire")
    assert 0.95 * len(sent) * 10 / BAUD < took_s < 1.2 * len(sent) * 10 / BAUD + 0.05
    assert (board.summary["rx_overrun"], board.summary["tx_unread"]) == (0, 0)
