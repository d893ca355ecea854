"""The emulated board itself: line, clock, outputs, resets, and the firmware's own safety on it."""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import serial

from modsoft.hil import emulator
from modsoft.hil.emulator import EmulatedBoard, Event
from modsoft.runtime.errors import DeviceAbsent
from modsoft.runtime.protocol import PROTOCOL_HASH, Hello, HelloReq, Parser, encode

BAUD = 250_000
HERE = Path(__file__).parent
DRIVER = HERE / "drive_board.py"
HELLO_TIMEOUT_S = 5.0

no_simavr = pytest.mark.skipif(
    bool(emulator.missing_packages("simavr")), reason=f"simavr needs {emulator.missing_packages('simavr')}"
)
each_board = pytest.mark.parametrize("name", [pytest.param("simavr", marks=no_simavr), "native"])


class Driver:
    """`drive_board.py` as a process; `next` returns what it says."""

    def __init__(self, board: EmulatedBoard, *arguments: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, str(DRIVER), board.port, *arguments], stdout=subprocess.PIPE, text=True
        )
        self._lines: queue.Queue[dict[str, Any]] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._lines.put(json.loads(line))

    def next(self, kind: str, timeout_s: float = HELLO_TIMEOUT_S) -> dict[str, Any]:
        """The next line of a kind, older lines of other kinds dropped."""
        deadline = time.monotonic() + timeout_s
        while True:
            line = self._lines.get(timeout=max(0.01, deadline - time.monotonic()))
            if kind in line:
                return line

    def until(self, timeout_s: float = HELLO_TIMEOUT_S, **expected: Any) -> dict[str, Any]:
        """The next STATUS with these values."""
        deadline = time.monotonic() + timeout_s
        while True:
            status = self.next("status", deadline - time.monotonic())["status"]
            if all(status[key] == value for key, value in expected.items()):
                return status

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()


@pytest.fixture
def drive() -> Iterator[Any]:
    drivers = []

    def start(board: EmulatedBoard, *arguments: str) -> Driver:
        drivers.append(Driver(board, *arguments))
        return drivers[-1]

    yield start
    for driver in drivers:
        driver.kill()


@pytest.fixture(scope="session")
def probe(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The compiled test program probe.c."""
    program = tmp_path_factory.mktemp("probe") / "probe.elf"
    subprocess.run(
        [
            "avr-gcc",
            "-Os",
            "-Wall",
            "-mmcu=atmega2560",
            "-DF_CPU=16000000UL",
            "-o",
            str(program),
            str(HERE / "probe.c"),
        ],
        check=True,
    )
    return program


def is_event(name: str, **values: Any) -> Any:
    return lambda event: event["event"] == name and all(event.get(key) == value for key, value in values.items())


def wait_for_hello(port: serial.Serial, timeout_s: float = HELLO_TIMEOUT_S) -> tuple[Hello, float]:
    """HELLO, and how long it took in host time."""
    parser, start = Parser(), time.monotonic()
    while time.monotonic() - start < timeout_s:
        for frame in parser.feed(port.read(128)):
            if isinstance(frame.message, Hello):
                return frame.message, time.monotonic() - start
    raise TimeoutError


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


# ---- What a machine without the tools is told -------------------------------------------------------------------


def test_missing_packages_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(emulator.shutil, "which", lambda name: None if name == "avr-gcc" else f"/usr/bin/{name}")
    monkeypatch.setattr(Path, "exists", lambda self: "simavr" not in self.parts)
    with pytest.raises(DeviceAbsent, match=r"sudo apt install gcc-avr libsimavr-dev$"):
        emulator.build("simavr")
    assert emulator.choose("auto") == "native"


def test_unknown_board_is_refused() -> None:
    with pytest.raises(DeviceAbsent, match="simavr, native and auto"):
        EmulatedBoard("mega")


@each_board
def test_sources_compile_without_a_warning(name: emulator.BoardName, tmp_path: Path) -> None:
    emulator.build(name, firmware=False)
    for source in emulator._BOARD_SOURCES[name]:
        flags = [flag for flag in emulator._LINK[name] if flag.startswith("-i")]
        command = [*emulator._COMPILE, "-Werror", *flags, "-c", str(source), "-o", str(tmp_path / "x.o")]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        assert result.returncode == 0, result.stderr


@pytest.mark.realtime
@no_simavr
def test_firmware_that_cannot_be_read_ends_in_one_line(tmp_path: Path) -> None:
    broken = tmp_path / "broken.hex"
    broken.write_text("no hex\n")
    with pytest.raises(DeviceAbsent, match=r"did not start: board: .*broken\.hex is not an Intel hex file"):
        EmulatedBoard("simavr", firmware=broken).start()


# ---- Process and clock ------------------------------------------------------------------------------------------


@pytest.mark.realtime
@each_board
def test_board_ends_with_its_starter(name: str) -> None:
    script = (
        "from modsoft.hil.emulator import EmulatedBoard; import sys, time\n"
        f"board = EmulatedBoard({name!r}).start(); print(board.pid, board.port, flush=True); time.sleep(60)"
    )
    starter = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert starter.stdout is not None
    pid, link = starter.stdout.readline().split()
    starter.kill()
    starter.wait()
    deadline = time.monotonic() + 5
    while Path(f"/proc/{pid}").exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not Path(f"/proc/{pid}").exists()
    assert not os.path.lexists(link)


@pytest.mark.realtime
@each_board
def test_emulated_time_keeps_up_with_real_time(name: str, record_property: Any) -> None:
    with EmulatedBoard(name) as board:
        time.sleep(2)
    summary = board.summary
    figures = ("percent_of_real_time", "percent_of_core", "max_late_us", "late_slices", "slices")
    for figure in figures:
        record_property(figure, summary[figure])
    print(f"{name}:", {figure: summary[figure] for figure in figures})
    assert summary["percent_of_real_time"] + 100 * summary["slipped_us"] * 1e-6 / summary["wall_s"] > 99
    assert summary["percent_of_core"] < 50
    assert board.clock == "emulated, held to real time"


@pytest.mark.realtime
@no_simavr
def test_fast_outruns_real_time() -> None:
    with EmulatedBoard("simavr", fast=True, bootloader=False) as board:
        time.sleep(0.5)
    assert board.summary["percent_of_real_time"] > 200
    assert board.clock == "emulated, not held to real time"


@pytest.mark.realtime
@no_simavr
def test_a_command_that_makes_no_sense_is_refused() -> None:
    with EmulatedBoard("simavr") as board:
        for command in ("adc 8 100", "adc 0 6000", "drop-rx 2", "hum", "hang"):  # hang: still in the bootloader
            board.send(command)
        board.send("adc 0 100")
        board.send("quit")
        board.wait_for(is_event("summary"), 5)
    refused = [event["line"] for event in board.trace if event["event"] == "command" and not event["done"]]
    assert refused == ["adc 8 100", "adc 0 6000", "drop-rx 2", "hum", "hang"]


# ---- The chip ---------------------------------------------------------------------------------------------------


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


@pytest.mark.realtime
@no_simavr
def test_duty_is_what_the_pin_does(probe: Path) -> None:
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


@pytest.mark.realtime
@no_simavr
def test_uart_loses_what_the_chip_would_lose(probe: Path) -> None:
    with EmulatedBoard("simavr", firmware=probe, bootloader=False) as board:
        chip = Probe(board)
        chip.port.write(b"d0123456789")
        # Two in the buffer, the newest in the shift register; then the answer to the command itself.
        assert chip.port.read(4) == b"019d"
        assert chip.port.read(1) == b""
        chip.port.close()
    assert board.summary["rx_overrun"] == 7


@pytest.mark.realtime
@no_simavr
@pytest.mark.parametrize("millivolt", [0, 1234, 5000])
def test_analogue_input_reads_what_was_set(probe: Path, millivolt: int) -> None:
    with EmulatedBoard("simavr", firmware=probe, bootloader=False) as board:
        chip = Probe(board)
        board.send(f"adc 3 {millivolt}")
        board.send("stats")
        board.wait_for(is_event("stats"), 2)
        counts = int.from_bytes(chip(b"a", answer=2), "big")
        assert abs(counts - millivolt * 1023 / 5000) <= 1
        chip.port.close()


@pytest.mark.realtime
@no_simavr
def test_time_goes_on_over_a_chip_asleep_for_ever(probe: Path) -> None:
    with EmulatedBoard("simavr", firmware=probe, bootloader=False) as board:
        chip = Probe(board)
        chip.port.write(b"s")
        halted = board.wait_for(is_event("halted"), 2)
        board.send("reset")
        reset = board.wait_for(is_event("reset"), 2, board.trace.index(halted))
        assert reset["t_us"] >= halted["t_us"]
        assert chip.port.read(1) == b"R", "a reset brings it back"
        chip.port.close()


# ---- Line and bootloader ----------------------------------------------------------------------------------------


@pytest.mark.realtime
@no_simavr
def test_quiet_open_gets_a_hello_through_the_bootloader() -> None:
    with EmulatedBoard("simavr") as board, serial.Serial(board.port, BAUD, timeout=0.01, exclusive=True) as port:
        hello, after_s = wait_for_hello(port)
        print(f"HELLO after {after_s:.3f} s")
        assert hello.protocol_hash == PROTOCOL_HASH
        assert 0.75 < after_s < 1.1
    with EmulatedBoard("simavr", bootloader=False) as board, serial.Serial(board.port, BAUD, timeout=0.01) as port:
        assert wait_for_hello(port)[1] < 0.2


@pytest.mark.realtime
@no_simavr
def test_a_host_that_talks_at_once_stays_in_the_bootloader() -> None:
    with EmulatedBoard("simavr") as board, serial.Serial(board.port, BAUD, timeout=0.3, exclusive=True) as port:
        parser, heard = Parser(), []
        for _ in range(7):  # 2.1 s: more than twice the time a quiet host has to wait
            port.write(encode(HelloReq(PROTOCOL_HASH)))
            heard += parser.feed(port.read(64))
        assert heard == []
        port.timeout = 0.01
        silent_s = wait_for_hello(port, 8)[1]
        print(f"out of the bootloader after {silent_s:.2f} s of silence")
        assert 4 < silent_s < 5.5


@pytest.mark.realtime
@each_board
def test_every_open_resets_and_is_told_apart(name: str) -> None:
    with EmulatedBoard(name) as board:
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


@pytest.mark.realtime
@each_board
def test_rate_zero_pulses_dtr(name: str) -> None:
    with EmulatedBoard(name) as board, serial.Serial(board.port, BAUD, timeout=0.01) as port:
        first = wait_for_hello(port)[0]
        port.baudrate = 0
        time.sleep(0.05)
        port.baudrate = BAUD
        assert wait_for_hello(port)[0].boot_id == first.boot_id + 1


@pytest.mark.realtime
@each_board
def test_wrong_rate_gives_noise(name: str) -> None:
    with EmulatedBoard(name) as board, serial.Serial(board.port, 115_200, timeout=0.05) as port:
        board.wait_for(is_event("wrong-baud", host=115_200, board=BAUD), 3)
        port.timeout = 0.5
        received = port.read(200)
        assert len(received) == 200
        assert Parser().feed(received) == []


@pytest.mark.realtime
@each_board
def test_cable_pulled_and_plugged_in_elsewhere(name: str, tmp_path: Path) -> None:
    with EmulatedBoard(name) as board:
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


@pytest.mark.realtime
@no_simavr
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


@pytest.mark.realtime
@each_board
def test_noise_on_the_line_is_counted_by_both_ends(name: str, drive: Any) -> None:
    with EmulatedBoard(name) as board:
        board.send("corrupt-rx 0.01 7")
        host = drive(board, "--heartbeats", "400")
        host.next("hello")
        while (status := host.next("status")["status"])["rx_good"] + status["rx_bad"] < 380:
            pass
        assert status["rx_bad"] > 20
    assert 40 < board.summary["rx_corrupted"] < 120


# ---- The firmware on it -----------------------------------------------------------------------------------------

PRESSURES_BAR = (0.08, 0.35, 0.1, 0.2, 0.3, 0.25, 0.08, 0.35, 0.12, 0.17, 0.33)


@pytest.mark.realtime
@each_board
def test_duties_are_what_was_commanded(name: str, drive: Any) -> None:
    with EmulatedBoard(name) as board:
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


@pytest.mark.realtime
@each_board
def test_host_killed_vents_all_valves(name: str, drive: Any) -> None:
    with EmulatedBoard(name) as board:
        board.send("sensors 20")
        host = drive(board, *["0.35"] * 11)
        host.until(state=3, applied=[3500] * 11 + [0])
        since = len(board.trace)
        host.kill()
        closed = board.wait_for(is_event("uart-close"), 2, since)
        time.sleep(0.9)
        took_ms = (zero_at_us(board.trace, since, 11) - closed["t_us"]) / 1000
        print(f"{name}: all valves 0 {took_ms:.0f} ms after the host was killed at 0.35 bar, emulated time")
        assert 200 < took_ms <= 670


@pytest.mark.realtime
@each_board
def test_firmware_that_hangs_is_stopped_by_the_watchdog(name: str, drive: Any) -> None:
    with EmulatedBoard(name) as board:
        board.send("sensors 20")
        host = drive(board, *["0.35"] * 11)
        boot_id = host.until(state=3, applied=[3500] * 11 + [0])["boot_id"]
        since = len(board.trace)
        board.send("hang")
        hung = board.wait_for(is_event("hang"), 2, since)
        board.wait_for(is_event("reset", cause="watchdog"), 2, since)
        host.kill()
        time.sleep(0.2)
        took_ms = (zero_at_us(board.trace, since, 11) - hung["t_us"]) / 1000
        print(f"{name}: all valves 0 {took_ms:.1f} ms after the firmware hung, emulated time")
        assert took_ms <= 130
        assert drive(board).next("hello")["hello"]["boot_id"] > boot_id, "and it runs again"
