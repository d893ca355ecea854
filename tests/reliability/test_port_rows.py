"""Failure matrix, opening and arming: rows 7, 9, 23 and 24, on the compiled firmware behind the MEGA's bootloader."""

import contextlib
import os
import random
import subprocess
import sys
import time
from threading import Timer
from types import SimpleNamespace

import pytest
from mega_in_run import Host, in_run, inject, side_by_side

from modsoft.hil.emulator import EmulatedBoard, is_event, missing_packages
from modsoft.hil.trace import rises
from modsoft.runtime import link, ports
from modsoft.runtime import robot as robots
from modsoft.runtime.board import Board
from modsoft.runtime.errors import DeviceAbsent, LostInRun, PortBusy, ProtocolMismatch
from modsoft.runtime.protocol import (
    PROTOCOL_HASH,
    Arm,
    Heartbeat,
    Hello,
    HelloReq,
    Nack,
    NackReason,
    Parser,
    State,
    Status,
    encode,
)

missing = missing_packages("simavr")
pytestmark = [pytest.mark.realtime, pytest.mark.skipif(bool(missing), reason=f"simavr needs {' '.join(missing)}")]


def test_row_07_plugged_in_again_under_another_name(matrix_row, tmp_path, monkeypatch):
    where = {}  # serial number: device, as the operating system would list them
    monkeypatch.setattr(ports.serial_list_ports, "comports", lambda: [mega(*item) for item in where.items()])

    def attempt(number):
        serial_number = f"7523733353635180{number:04}"
        with in_run() as (host, emulated):
            inject(emulated, "unplug")
            with pytest.raises(LostInRun):
                host.go_on(1.0)
            host.board.close()
            time.sleep(random.uniform(0.0, 1.0))
            elsewhere = str(tmp_path / f"ttyACM{number}")
            where[serial_number] = elsewhere
            plugged, since = inject(emulated, f"plug {elsewhere}")
            with pytest.raises(DeviceAbsent, match="no such port"):
                ports.find_port(emulated.port)
            with Board.open(ports.find_port(serial_number)) as board:
                assert board.hello.boot_id != host.board.hello.boot_id
                await_status(board, State.IDLE)
                idle_s = time.monotonic() - plugged["mono_ns"] * 1e-9
                time.sleep(0.5)
                assert board.status.state == State.IDLE, "never by itself"
                board.arm(Host.ROBOT)
                assert board.status.state == State.ARMED
                assert rises(emulated.trace, since) == 0
                board.set_pressures(1, [Host.BAR] * 6)
                await_status(board, State.RUNNING)
            return idle_s

    tries = 20
    idle_s = max(side_by_side(tries, attempt, 10))
    matrix_row(7, fault="plugged in again under another name", tries=tries, limit="IDLE in 8 s, 20 of 20",
               worst=f"{idle_s:.2f} s", clock="host")  # fmt: skip
    assert idle_s <= 8


def mega(serial_number, device):
    return SimpleNamespace(device=device, description="Arduino", vid=0x2341, pid=0x0042, serial_number=serial_number)


def await_status(board, state, limit_s=5.0):
    until_s = time.monotonic() + limit_s
    while board.status is None or board.status.state != state:
        assert time.monotonic() < until_s, board.status
        time.sleep(0.005)


def test_row_09_host_would_talk_to_the_bootloader(matrix_row):
    opens = 10

    def attempt(_):
        with EmulatedBoard("simavr") as emulated:
            for number in range(opens):
                if number == opens - 1:  # its announcement is lost, and the host has to ask
                    inject(emulated, "drop-tx 1")
                    Timer(1.2, emulated.send, ["drop-tx 0"]).start()
                Board.open(emulated.port).close()
                time.sleep(random.uniform(0.0, 0.3))  # what was written last may still be on its way when it is reset
        opened = sum(event["event"] == "uart-open" for event in emulated.trace)
        assert opened == opens, "one reset each"
        assert emulated.summary["rx"] > 0, "and bytes are counted"
        return emulated.summary["rx_bootloader"]

    found = sum(side_by_side(10, attempt, 10))
    matrix_row(9, fault="host would talk to the bootloader", tries=10 * opens, limit="0 bytes in 100 opens",
               worst=f"{found} bytes", clock="none")  # fmt: skip
    assert found == 0


# ---- Arming


def refusals(port):
    """Ask a board behind `port`, heard for its second of heartbeats, for everything that it must not accept.

    Yields (what was wrong, the NACK's reason or None, the board's state after it).
    """
    parser, heard, beat_s, tick = Parser(), [], 0.0, 0

    def turn():
        nonlocal beat_s, tick
        if time.monotonic() >= beat_s:
            beat_s, tick = time.monotonic() + 0.1, tick + 1
            port.write(encode(Heartbeat(tick), 0, 0))
        heard.extend(frame.message for frame in parser.feed(port.read(256)))

    def wait(kind, limit_s=1.0):
        until_s = time.monotonic() + limit_s
        while not any(isinstance(message, kind) for message in heard) and time.monotonic() < until_s:
            turn()
        return next((message for message in heard if isinstance(message, kind)), None)

    beat_s = float("inf")
    hello = wait(Hello, 5.0)
    beat_s = 0.0
    armed_from_s = time.monotonic() + 1.3
    while time.monotonic() < armed_from_s:
        turn()
    right = Arm(PROTOCOL_HASH, hello.boot_id, 1, 0x3F, hello.p_full)
    wrong = [("protocol hash", right._replace(protocol_hash=PROTOCOL_HASH ^ 1 << bit)) for bit in range(32)]
    wrong += [("channels", right._replace(channels=0x3F | 1 << bit)) for bit in range(hello.channels, 16)]
    wrong += [("full scale", right._replace(p_full=hello.p_full ^ 1 << bit)) for bit in range(15)]
    wrong += [("boot id", right._replace(boot_id=hello.boot_id ^ 1 << bit)) for bit in range(32)]
    wrong += [("session", right._replace(new_session=session)) for session in (0, 2, 3, 128, 255)]
    for what, arm in wrong:
        heard.clear()
        port.write(encode(arm, 0, 0))
        nack = wait(Nack)
        heard.clear()
        yield what, nack and nack.reason, wait(Status).state
    heard.clear()
    port.write(encode(HelloReq(PROTOCOL_HASH ^ 1), 0, 0))
    nack = wait(Nack)
    yield "protocol hash of HELLO_REQ", nack and nack.reason, wait(Status).state
    heard.clear()
    port.write(encode(right, 0, 0))  # only that was wrong
    wait(Status)
    heard.clear()
    yield "nothing", None, wait(Status).state


REASONS = {
    "protocol hash": NackReason.HASH,
    "protocol hash of HELLO_REQ": NackReason.HASH,
    "channels": NackReason.RANGE,
    "full scale": NackReason.RANGE,
    "boot id": NackReason.SESSION,
    "session": NackReason.SESSION,
}
MISFITS = [
    ("full_scale_bar = 3.0", "full_scale_bar = 10.0"),
    ("p_min_bar = 0.08", "p_min_bar = 0.1"),
    ("p_max_bar = 0.35", "p_max_bar = 0.3"),
    ("slew_bar_per_s = 2.0", "slew_bar_per_s = 1.0"),
    ("channel = 5", "channel = 11"),
]


def test_row_23_channels_or_protocol_hash_differ(matrix_row, monkeypatch):
    with EmulatedBoard("simavr") as emulated, contextlib.closing(ports.open_port(emulated.port, 250000)) as port:
        *refused, accepted = refusals(port)
        for what, reason, state in refused:
            assert (reason, state) == (REASONS[what], State.IDLE), what
        assert accepted == ("nothing", None, State.ARMED)
    with EmulatedBoard("simavr") as emulated:
        host = Host(emulated.port)
        for old, new in MISFITS:
            text = robots.text_of("pneumatic-3")
            assert old in text
            with pytest.raises(ProtocolMismatch):
                host.board.arm(robots.parse(text.replace(old, new, 1)))
        host.board.close()
        sent = Parser().feed(b"".join(data for _, data in host.written))
        assert not [frame for frame in sent if isinstance(frame.message, Arm)]
        foreign = range(0, 32, 8)
        for bit in foreign:
            monkeypatch.setattr(link, "PROTOCOL_HASH", PROTOCOL_HASH ^ 1 << bit)
            with pytest.raises(ProtocolMismatch, match="flash the firmware of this version"):
                Board.open(emulated.port)
        assert rises(emulated.trace) == 0
    tries = len(refused) + len(MISFITS) + len(foreign)
    matrix_row(23, fault="channels, limits, session or protocol hash differ", tries=tries, limit="ARM refused, all",
               worst=f"{tries} of {tries} refused", clock="none")  # fmt: skip


# ---- Not a port for us


@contextlib.contextmanager
def permitted_to_nobody(device):
    """A port that this process may not open."""
    if os.geteuid() == 0:  # root may open anything
        os.seteuid(65534)
        try:
            yield
        finally:
            os.seteuid(0)
    else:
        mode = os.stat(device).st_mode
        os.chmod(device, 0)
        try:
            yield
        finally:
            os.chmod(device, mode)


@contextlib.contextmanager
def stranger(text):
    """The port of a device that says `text` ten times a second, whatever is done to it: not our board."""
    master, slave = os.openpty()
    code = "import os, sys, time\nwhile True:\n os.write(1, sys.argv[1].encode()); time.sleep(0.1)"
    talker = subprocess.Popen([sys.executable, "-c", code, text], stdout=master)
    try:
        yield os.ttyname(slave)
    finally:
        talker.kill()
        talker.wait()
        os.close(slave)
        os.close(master)


def closed(emulated, times):
    """Wait until the board has seen its port closed so often: one closed and opened at once stays open for it."""
    emulated.wait_for(lambda _: sum(event["event"] == "uart-close" for event in emulated.trace) >= times, 5.0)


def test_row_24_port_busy_not_permitted_not_ours(matrix_row, tmp_path, monkeypatch):
    took_s = {}

    def refused(what, name, kind, exit_code, baud=250000):
        began_s = time.monotonic()
        with pytest.raises(kind) as caught:
            Board.open(name, baud)
        took_s[what] = time.monotonic() - began_s
        assert caught.value.exit_code == exit_code
        assert name in str(caught.value)
        assert "\n" not in str(caught.value)

    (tmp_path / "file").touch()
    refused("a file", str(tmp_path / "file"), DeviceAbsent, 69)
    refused("not there", str(tmp_path / "none"), DeviceAbsent, 69)
    with EmulatedBoard("simavr") as emulated:
        with permitted_to_nobody(emulated.ready["port"]):
            refused("not permitted", emulated.ready["port"], PortBusy, 75)
        with contextlib.closing(ports.open_port(emulated.port, 250000)):
            emulated.wait_for(is_event("uart-open"), 5.0)
            refused("busy", emulated.port, PortBusy, 75)
        closed(emulated, 1)
        refused("at the wrong rate", emulated.port, DeviceAbsent, 69, baud=115200)
        closed(emulated, 2)
        with monkeypatch.context() as another:
            another.setattr(link, "PROTOCOL_HASH", PROTOCOL_HASH ^ 1)
            refused("of another version", emulated.port, ProtocolMismatch, 76)
    opened = sum(event["event"] == "uart-open" for event in emulated.trace)
    assert opened == 3, "busy, at the wrong rate, of another version: each once"
    with stranger("temperature 23.5 humidity 40\r\n") as name:
        refused("of another device", name, DeviceAbsent, 69)
    worst = max(took_s, key=took_s.get)
    matrix_row(24, fault=f"port {', '.join(took_s)}", tries=len(took_s), limit="own exit code in 3 s, no retry storm",
               worst=f"{took_s[worst]:.2f} s ({worst}), opened once each", clock="host")  # fmt: skip
    mute_s, resets = given_up_when_mute()
    matrix_row(24, fault="port of a device that says nothing", tries=1, limit="own exit code in 3 s",
               worst=f"{mute_s:.1f} s, {resets} resets", clock="virtual", met=mute_s <= 3,
               why="so is our board when its announcement is lost, and it is reset up to three times to find out"
               )  # fmt: skip
    assert took_s[worst] <= 3.0
    assert (mute_s, resets) == (pytest.approx(12.3, abs=0.2), 3)


def given_up_when_mute():
    """Seconds after which a port without a byte is given up, and how many resets were tried before."""
    silent, hundredths = link.Link(0.0), 0
    while not silent.gave_up:
        hundredths += 1
        assert silent.poll(hundredths / 100) == b""
    return hundredths / 100, silent.resets
