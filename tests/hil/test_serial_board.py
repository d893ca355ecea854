"""modsoft-hil with a real board: the native board behind its pseudo-terminal takes the place of the MEGA."""

import os
import re
import select
import subprocess
import sys
import threading
import time
import tty
from pathlib import Path

import click
import pytest
import serial

from modsoft.hil import cli, record
from modsoft.hil.board import emulator, serial_board, toolchain
from modsoft.hil.board.emulator import EmulatedBoard
from modsoft.hil.board.serial_board import SerialBoard
from modsoft.runtime import robot as robot_file
from modsoft.runtime.board import discovery, ports
from modsoft.runtime.board.codec import encode
from modsoft.runtime.board.protocol import PROTOCOL_HASH, Hello, State, Status
from modsoft.runtime.errors import DeviceAbsent, PortBusy, ProtocolMismatch, UsageError

ROBOT = robot_file.load("pneumatic-3")
TIMEOUT_S = 5.0
NOT_SEEN = ["largest difference from the settled", "largest duty before", "resets in the run", "watchdog resets"]


def hello(**values):
    fixed = {"protocol_hash": PROTOCOL_HASH, "firmware_version": 1, "boot_id": 7, "reset_cause": 2, "channels": 11}
    limits = {"p_min": 800, "p_max": 3500, "p_down": 500, "p_full": 30_000, "slew": 20_000}
    times = {"link_timeout_ms": 300, "control_timeout_ms": 1000}
    known = {**fixed, "sensors": 0, **limits, **times, **values}
    return Hello(**{name: known.get(name, 0) for name in Hello._fields})


def status(applied):
    values = {name: 0 for name in Status._fields}
    padded = tuple(applied) + (0,) * (12 - len(applied))
    return Status(**{**values, "state": State.RUNNING, "applied": padded, "measured": (0,) * 12})


def wait_until(true):
    deadline = time.monotonic() + TIMEOUT_S
    while not true():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.002)


def wait_until_open(forwarding):
    """Not `Device.is_open`: pyserial discards what arrives before the end of its opening."""
    wait_until(lambda: any(event["event"] == "host-open" for event in forwarding.trace))


class Device:
    """A serial port with a script instead of a board; the test holds the other end."""

    def __init__(self):
        self.master, slave = os.openpty()
        tty.setraw(slave)
        self.name = os.ttyname(slave)
        os.close(slave)

    def is_open(self):
        poller = select.poll()
        poller.register(self.master, select.POLLIN)
        return not any(events & select.POLLHUP for _, events in poller.poll(0))

    def read(self, count):
        data = b""
        while len(data) < count:
            assert select.select([self.master], [], [], TIMEOUT_S)[0], f"{len(data)} of {count} bytes"
            data += os.read(self.master, 4096)
        return data

    def close(self):
        if self.master >= 0:
            os.close(self.master)
        self.master = -1


@pytest.fixture
def device():
    device = Device()
    yield device
    device.close()


@pytest.fixture
def forwarding(device):
    """A started board at `device`, as after its check."""
    board = SerialBoard(device.name, ROBOT)
    board._hello = hello()
    board.start()
    yield board
    board.stop()


@pytest.fixture(scope="module")
def sensorless_program(tmp_path_factory):
    program = tmp_path_factory.mktemp("board") / "sensorless_board"
    sources = map(str, toolchain._BOARD_SOURCES["native"])
    subprocess.run(
        [*toolchain._COMPILE, "-DSENSORS=0", *sources, "-o", program, *toolchain._LINK["native"]], check=True
    )
    return program


@pytest.fixture
def sensorless(sensorless_program, monkeypatch):
    """The native board, compiled with SENSORS=0."""
    monkeypatch.setattr(emulator, "build", lambda board, firmware: sensorless_program)
    with EmulatedBoard("native") as board:
        yield board


@pytest.mark.realtime
def test_run_on_a_board_at_a_serial_port(sensorless, strong_model, tmp_path):
    script, report = Path(sys.executable).parent / "modsoft-hil", tmp_path / "out"
    command = [script, "--robot", "pneumatic-3", "--model", strong_model, "--task", "down", "--steps", "8", "--yes"]
    done = subprocess.run(
        [*command, "--board", sensorless.port, "--report", report],
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
        timeout=90,
    )
    assert done.returncode in (1, 3), done.stderr  # a random controller may miss the limits of tracking
    assert "turn off the air, or disconnect the robot" in done.stderr
    missed = [line for line in done.stdout.splitlines() if line.startswith("  NO") and "tracking error" not in line]
    assert "too slow" in done.stdout or not missed, done.stdout
    text = (report / "report.md").read_text()
    for name in NOT_SEEN:
        assert re.search(rf"{name}.* not seen \|$", text, re.M), name
    assert "Not seen in this run, because the board is a real one: timer registers" in text
    events = record.lines(report / "board.jsonl")
    applied_bar = max(max(event["applied"]) for event in events if event["event"] == "status") / 10_000
    plant_bar = max(max(map(max, state["pressure_bar"])) for state in record.lines(report / "plant.jsonl"))
    assert plant_bar == pytest.approx(applied_bar, abs=0.01)
    assert plant_bar > 0.3, "the simulated robot follows the board"
    duties = [event["duty"] for event in sensorless.trace if event["event"] == "pwm"]
    assert max(duties) * ROBOT.valve.full_scale_bar == pytest.approx(applied_bar, abs=0.001)
    assert not any(sensorless.duties())


def test_board_with_sensors_is_refused():
    with EmulatedBoard("native") as board:
        with pytest.raises(ProtocolMismatch, match=r"pressure sensors on channels 0, .*expected none.*SENSORS=0"):
            SerialBoard(board.port, ROBOT).check()


def test_sensorless_board_is_accepted(sensorless):
    assert SerialBoard(sensorless.port, ROBOT).check().sensors == 0


def test_missing_port_is_refused(tmp_path):
    with pytest.raises(DeviceAbsent, match="no such port"):
        SerialBoard(str(tmp_path / "ttyACM0"), ROBOT)


def test_busy_port_is_refused(device):
    with serial.Serial(device.name, exclusive=True), pytest.raises(PortBusy, match="in use by another program"):
        SerialBoard(device.name, ROBOT).check()


def test_other_device_is_refused(device, monkeypatch):
    for name in ("RUNNING_AFTER_S", "FOREIGN_BYTES_S", "FOREIGN_AFTER_S"):
        monkeypatch.setattr(discovery, name, 0.02)
    ended = threading.Event()

    def chatter():
        while not ended.wait(0.01):
            os.write(device.master, b"ok\r\n")

    writer = threading.Thread(target=chatter)
    writer.start()
    try:
        with pytest.raises(DeviceAbsent, match=r"no board found .* bytes of another protocol"):
            SerialBoard(device.name, ROBOT).check()
    finally:
        ended.set()
        writer.join()


def test_bytes_pass_unmodified_in_both_directions(device, forwarding):
    every_byte = bytes(range(256)) * 3
    with serial.Serial(forwarding.port, 250_000, timeout=TIMEOUT_S) as host:
        wait_until_open(forwarding)
        host.write(every_byte)
        assert device.read(len(every_byte)) == every_byte
        os.write(device.master, every_byte)
        assert host.read(len(every_byte)) == every_byte
        host.write(b"last")
    assert device.read(4) == b"last"


def test_status_moves_the_simulated_robot(device, forwarding):
    reported = []
    forwarding.on_event = reported.append
    with serial.Serial(forwarding.port, 250_000):
        wait_until_open(forwarding)
        os.write(device.master, encode(hello(boot_id=8)) + encode(status([3000, 0, 1500])))
        wait_until(lambda: any(event["event"] == "status" for event in reported))
    assert forwarding.duties() == [0.1, 0, 0.05] + [0] * 8
    assert [event["event"] for event in reported][:3] == ["host-open", "hello", "status"]


def test_each_opening_resets_the_board_and_venting_is_seen_after_the_close(device, forwarding, monkeypatch):
    was_closed = []  # DTR of a MEGA has fallen

    def open_port(*arguments):
        was_closed.append(not device.is_open())
        return ports.open_port(*arguments)

    monkeypatch.setattr(serial_board, "open_port", open_port)
    with serial.Serial(forwarding.port, 250_000):
        wait_until_open(forwarding)
    wait_until(lambda: forwarding.trace[-1]["event"] == "host-close")
    os.write(device.master, encode(status([0])))
    wait_until(lambda: forwarding.trace[-1]["event"] == "status")
    assert device.is_open()
    with serial.Serial(forwarding.port, 250_000):
        wait_until(lambda: forwarding.trace[-1]["event"] == "host-open")
    assert was_closed == [True, True]


def test_pulled_cable_reaches_the_runtime(device, forwarding):
    host = serial.Serial(forwarding.port, 250_000, timeout=TIMEOUT_S)
    wait_until_open(forwarding)
    device.close()
    with pytest.raises(serial.SerialException):
        host.read(1)
    host.close()
    assert forwarding.trace[-1]["event"] == "port-failed"
    assert not os.path.exists(forwarding.port)


@pytest.mark.parametrize("has_terminal", [False, True])
def test_port_is_not_opened_without_a_confirmation(has_terminal, device, model_file, tmp_path, monkeypatch):
    class Stream:
        def isatty(self):
            return has_terminal

    def refuse(*question, abort, err):
        raise click.Abort

    monkeypatch.setattr(sys, "stdin", Stream())
    monkeypatch.setattr(click, "confirm", refuse)
    monkeypatch.setattr(SerialBoard, "check", lambda board: pytest.fail("it was opened"))
    options = [
        "--robot",
        "pneumatic-3",
        "--model",
        str(model_file),
        "--task",
        "down",
        "--report",
        str(tmp_path / "out"),
    ]
    with pytest.raises(click.Abort if has_terminal else UsageError) as caught:
        cli.cli.main([*options, "--board", device.name], standalone_mode=False)
    assert has_terminal or "give --yes" in str(caught.value)
    assert not (tmp_path / "out").exists()
