"""Failure matrix, ports: rows 7, 9 and 24, on the compiled firmware behind the MEGA's bootloader."""

import contextlib
import os
import random
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest
from mega_in_run import Host, in_stepped_run, inject, side_by_side, stepped_host
from output_rises import rises
from runtime_in_run import Run, Stand

from modsoft.hil.board.emulator import EmulatedBoard, is_event
from modsoft.hil.board.stepped_port import SteppedPort
from modsoft.hil.board.toolchain import missing_packages
from modsoft.runtime.board import connection, ports
from modsoft.runtime.board.board import Board
from modsoft.runtime.board.protocol import PROTOCOL_HASH, State
from modsoft.runtime.errors import DeviceAbsent, LostInRun, PortBusy, ProtocolMismatch

missing = missing_packages("simavr")
pytestmark = pytest.mark.skipif(bool(missing), reason=f"simavr needs {' '.join(missing)}")


def test_row_07_plugged_in_again_under_another_name(matrix_row, tmp_path, monkeypatch):
    devices = {}  # by serial number, as the operating system lists them
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [mega(*item) for item in devices.items()])

    def attempt(number):
        serial_number = f"7523733353635180{number:04}"
        with in_stepped_run() as (host, emulated):
            inject(emulated, "unplug")
            with pytest.raises(LostInRun):
                host.run_for(1.0)
            host.board.close()
            emulated.run(round(random.uniform(1.0, 1e6)), 0)
            devices[serial_number] = new_name = str(tmp_path / f"ttyACM{number}")
            plugged, since = inject(emulated, f"plug {new_name}")
            with pytest.raises(DeviceAbsent, match="no such port"):
                ports.find_port(emulated.port)
            second = stepped_host(emulated, ports.find_port(serial_number))
            assert second.board.hello.boot_id != host.board.hello.boot_id
            await_state(second.board, State.IDLE)
            idle_s = second.clock() - plugged["t_us"] * 1e-6
            idle_until_s = second.clock() + 0.5
            while second.clock() < idle_until_s:
                second.board._io_thread.pump()
            assert second.board.status.state == State.IDLE, "never by itself"
            second.board.arm(Host.ROBOT)
            assert second.board.status.state == State.ARMED
            assert rises(emulated.trace, since) == 0
            second.run_for(0.1)
            assert second.board.status.state == State.RUNNING
            second.board.close()
            return idle_s

    tries = 20
    idle_s = max(side_by_side(tries, attempt, 2))
    matrix_row(
        7,
        fault="plugged in again under another name",
        tries=tries,
        limit="IDLE in 8 s, 20 of 20",
        worst=f"{idle_s:.2f} s",
        clock="emulated",
    )
    assert idle_s <= 8


def await_state(board, state, limit_s=5.0):
    board._io_thread.wait(lambda: board.status is not None and board.status.state == state, board._clock() + limit_s)
    assert board.status.state == state


# modsoft-runtime on a machine with one MEGA: its serial number, its device, then the command line.
WITH_ONE_MEGA = """
import sys, types
from serial.tools import list_ports
number, device = sys.argv[1:3]
mega = types.SimpleNamespace(device=device, description="Arduino", vid=0x2341, pid=0x0042, serial_number=number)
list_ports.comports = lambda: [mega]
del sys.argv[1:3]
from modsoft.runtime.cli import main
main()
"""


@pytest.mark.realtime
def test_row_07_the_next_run_finds_the_board_by_its_serial_number(matrix_row, model_file, tmp_path):
    new_name, number = str(tmp_path / "ttyACM1"), "75237333536351801234"
    program = (sys.executable, "-c", WITH_ONE_MEGA, number, new_name)
    with Stand() as stand:
        with Run(stand, model_file, tmp_path / "first") as run:
            run.wait_for(lambda: run.ticks() >= 2)
            inject(stand.board, "unplug")
            assert run.wait_exit()[0] == 74, run.output
        _, since = inject(stand.board, f"plug {new_name}")
        with Run(stand, model_file, tmp_path / "second", program=program) as run:
            assert run.process.wait(30) == 69
        assert f"found an Arduino MEGA at {new_name}; give its serial number, --port {number}" in run.output
        assert not [event for event in stand.board.trace[since:] if event["event"] == "uart-open"], "nothing opened"
        with Run(stand, model_file, tmp_path / "third", "--port", number, "--steps", "3", program=program) as run:
            assert run.wait_exit()[0] == 0, run.output
        assert run.log().meta["port"] == new_name
    matrix_row(
        7,
        fault="plugged in again under another name: the next run",
        tries=1,
        limit="74; 69 and where the board is; then found by --port SERIAL",
        worst="as required",
    )


def mega(serial_number, device):
    return SimpleNamespace(device=device, description="Arduino", vid=0x2341, pid=0x0042, serial_number=serial_number)


def test_row_09_no_byte_to_the_bootloader(matrix_row):
    opens = 20

    def attempt(_):
        with EmulatedBoard("simavr", stepped=True) as emulated:
            for _ in range(opens - 1):
                stepped_host(emulated).board.close()
                emulated.run(round(random.uniform(1.0, 3e5)), 0)  # the last bytes may still be in transit
            inject(emulated, "drop-tx 1")  # HELLO is lost, so the host requests it
            port = SteppedPort(emulated)
            call_in_read(port, 1.2, lambda: inject(emulated, "drop-tx 0"))
            Board(port, "the emulated MEGA", port.clock, threaded=False).close()
            emulated.run(1000, 0)
        opened = sum(event["event"] == "uart-open" for event in emulated.trace)
        assert opened == opens, "one reset each"
        assert emulated.summary["rx"] > 0, "and bytes are counted"
        return emulated.summary["rx_bootloader"]

    count = sum(side_by_side(5, attempt, 2))
    matrix_row(
        9,
        fault="host could send to the bootloader",
        tries=5 * opens,
        limit="0 bytes in 100 opens",
        worst=f"{count} bytes",
        clock="none",
    )
    assert count == 0


def call_in_read(port, seconds, call):
    """Calls `call` in the first read of the port after this time."""
    read, due_s = port.read, port.clock() + seconds

    def reading(size=1):
        if port.clock() >= due_s:
            port.read = read
            call()
        return read(size)

    port.read = reading


# ---- Ports that are refused


@contextlib.contextmanager
def without_permission(device):
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
def other_device(text):
    """The port of another device, which sends `text` ten times a second."""
    master, slave = os.openpty()
    code = "import os, sys, time\nwhile True:\n os.write(1, sys.argv[1].encode()); time.sleep(0.1)"
    sender = subprocess.Popen([sys.executable, "-c", code, text], stdout=master)
    try:
        yield os.ttyname(slave)
    finally:
        sender.kill()
        sender.wait()
        os.close(slave)
        os.close(master)


def wait_closed(emulated, times):
    """Waits until the board has seen its port closed `times` times; it does not see one that is reopened at once."""
    emulated.wait_for(lambda _: sum(event["event"] == "uart-close" for event in emulated.trace) >= times, 5.0)


@pytest.mark.realtime
def test_row_24_port_busy_message_of_modsoft_runtime(matrix_row, model_file, tmp_path):
    with Stand() as stand, contextlib.closing(ports.open_port(stand.board.port, 250000)):
        with Run(stand, model_file, tmp_path) as run:
            assert run.process.wait(30) == 75
        assert run.output.splitlines()[-1].startswith(
            f"modsoft-runtime: {stand.board.port} is in use by another program"
        )
        assert not run.armed()
        assert stand.highest_bar() == 0.0
    matrix_row(24, fault="port busy, modsoft-runtime", tries=1, limit="exit 75, one line", worst="as required")


@pytest.mark.realtime
def test_row_24_port_busy_not_permitted_or_of_another_device(matrix_row, tmp_path, monkeypatch):
    took_s = {}

    def refused(what, name, kind, exit_code, baud=250000):
        began_s = time.monotonic()
        with pytest.raises(kind) as caught:
            Board.open(name, baud).close()
        took_s[what] = time.monotonic() - began_s
        assert caught.value.exit_code == exit_code
        assert name in str(caught.value)
        assert "\n" not in str(caught.value)

    (tmp_path / "file").touch()
    refused("a file", str(tmp_path / "file"), DeviceAbsent, 69)
    refused("not there", str(tmp_path / "none"), DeviceAbsent, 69)
    with EmulatedBoard("simavr") as emulated:
        with without_permission(emulated.ready["port"]):
            refused("not permitted", emulated.ready["port"], PortBusy, 75)
        with contextlib.closing(ports.open_port(emulated.port, 250000)):
            emulated.wait_for(is_event("uart-open"), 5.0)
            refused("busy", emulated.port, PortBusy, 75)
        wait_closed(emulated, 1)
        refused("at the wrong rate", emulated.port, DeviceAbsent, 69, baud=115200)
        wait_closed(emulated, 2)
        with monkeypatch.context() as another:
            another.setattr(connection, "PROTOCOL_HASH", PROTOCOL_HASH ^ 1)
            refused("of another version", emulated.port, ProtocolMismatch, 76)
    opened = sum(event["event"] == "uart-open" for event in emulated.trace)
    assert opened == 3, "busy, at the wrong rate, of another version: each once"
    with other_device("temperature 23.5 humidity 40\r\n") as name:
        refused("of another device", name, DeviceAbsent, 69)
    with other_device("") as name:
        mute = SimpleNamespace(device=name, description="Scale", vid=0x0B95, pid=1, serial_number=None)
        monkeypatch.setattr("serial.tools.list_ports.comports", lambda: [mute])
        refused("of a mute device of another maker", name, DeviceAbsent, 69)
    worst = max(took_s, key=took_s.get)
    matrix_row(
        24,
        fault=f"port {', '.join(took_s)}",
        tries=len(took_s),
        limit="own exit code in 3 s, no repeated retries",
        worst=f"{took_s[worst]:.2f} s ({worst}), opened once each",
        clock="host",
    )
    mute_s, resets = time_to_give_up()
    matrix_row(
        24,
        fault="port of a mute device that may be our board",
        tries=1,
        limit="three resets first, 3 s for each",
        worst=f"{mute_s:.1f} s, {resets} resets",
        clock="virtual",
    )
    assert took_s[worst] <= 3.0
    assert (mute_s, resets) == (pytest.approx(12.3, abs=0.2), 3)


def time_to_give_up():
    """Seconds until a port without a byte is given up, and the number of resets before."""
    silent, hundredths = connection.Connection(0.0), 0
    while silent.discovery.failure is None:
        hundredths += 1
        assert silent.poll(hundredths / 100) == b""
    return hundredths / 100, silent.discovery.resets
