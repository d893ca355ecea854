"""The I/O thread and the ports, under errors of the operating system."""

from __future__ import annotations

import errno
import threading

import pytest
import serial

from modsoft.runtime import robot as robot_file
from modsoft.runtime.board import codec, ports, protocol
from modsoft.runtime.board.board import Board
from modsoft.runtime.board.protocol import CHANNELS, PROTOCOL_HASH, Hello, State, Status
from modsoft.runtime.errors import DeviceAbsent, LostInRun, PortBusy, Tripped, UsageError

HELLO = Hello(PROTOCOL_HASH, 1, 7, 1, 11, 0, 800, 3500, 500, 30000, 0, 5000, 10000, 4500, 20000, 300, 1000)
STATUS = Status(0, State.IDLE, 0, 7, 1, 0, (0,) * CHANNELS, (0,) * CHANNELS, 0, 0, 0, 5000)


class ScriptedPort:
    """Sends HELLO, then a STATUS in every read, until `failure` is set."""

    def __init__(self):
        self.dtr = True
        self.failure = None
        self.hello_sent = self.closed = False
        self.written = 0
        self.reader = None

    @property
    def in_waiting(self):
        return 0

    def read(self, size=1):
        self.reader = threading.current_thread()
        if self.failure is not None:
            raise self.failure
        assert not self.closed, "read after close"
        if not self.hello_sent:
            self.hello_sent = True
            return codec.encode(HELLO)
        return codec.encode(STATUS)

    def write(self, data):
        if self.failure is not None:
            raise self.failure
        self.written += len(data)
        return len(data)

    def cancel_read(self):
        pass

    def open(self):
        raise AssertionError("opened twice")

    def close(self):
        self.closed = True


def test_thread_serves_the_port_and_ends():
    port = ScriptedPort()
    with Board(port) as board:
        assert board.hello == HELLO
        assert port.reader.name == "board"
    assert port.closed
    assert not port.reader.is_alive()
    assert port.written > 0


@pytest.mark.parametrize("failure", [OSError(5, "Input/output error"), serial.SerialTimeoutException("Write timeout")])
def test_failing_port_loses_the_board_and_ends_waits(failure):
    port = ScriptedPort()
    board = Board(port)
    port.failure = failure
    port.reader.join(1.0)
    assert not port.reader.is_alive()
    with pytest.raises(LostInRun, match="the port failed"):
        board.check()
    assert board.vent() is False
    assert board.close() is False
    assert port.closed


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_unexpected_error_in_the_thread_loses_the_board():
    port = ScriptedPort()
    board = Board(port)
    port.failure = TypeError("an integer is required")
    port.reader.join(1.0)
    assert not port.reader.is_alive()
    with pytest.raises(LostInRun, match="ended by an error"):
        board.check()
    assert board.close() is False


def test_port_that_fails_before_hello_is_an_absent_device():
    port = ScriptedPort()
    port.failure = OSError(5, "Input/output error")
    with pytest.raises(DeviceAbsent, match="the port failed"):
        Board(port)
    assert port.closed


class BlockingPort(ScriptedPort):
    """Sends two frames; further reads block until they are cancelled."""

    LONG_S = 30.0

    def __init__(self):
        super().__init__()
        self.reads = 0
        self.blocked, self.cancelled, self.sent = threading.Event(), threading.Event(), threading.Event()

    def read(self, size=1):
        self.reads += 1
        if self.reads <= 2:
            return super().read(size)
        self.blocked.set()
        self.cancelled.wait(self.LONG_S)
        self.cancelled.clear()
        return b""

    def cancel_read(self):
        self.cancelled.set()

    def write(self, data):
        if len(data) >= len(codec.encode(protocol.Set(0, (0,) * CHANNELS))):
            self.sent.set()
        return super().write(data)


def test_set_points_interrupt_a_read():
    port = BlockingPort()
    board = Board(port)
    try:
        assert port.blocked.wait(5.0)
        board.set_pressures(1, [0.0])
        assert port.sent.wait(5.0), "the read was not cancelled"
    finally:
        board._io_thread.close()


class ArmedPort(ScriptedPort):
    """A board that another host has armed, on virtual time; it does not reply to ARM."""

    def __init__(self):
        super().__init__()
        self.now_s = 0.0

    def read(self, size=1):
        self.now_s += 0.02
        if not self.hello_sent:
            self.hello_sent = True
            return codec.encode(HELLO)
        return codec.encode(STATUS._replace(state=State.ARMED), session=9)


def test_arming_requires_the_requested_session():
    port = ArmedPort()
    board = Board(port, clock=lambda: port.now_s, threaded=False)
    with pytest.raises(Tripped, match="did not arm within 4 s, its state is ARMED"):
        board.arm(robot_file.load("pneumatic-3"))


# ---- ports


def serial_error(number, text=""):
    error = serial.SerialException(number, text)
    error.errno = number
    return error


@pytest.mark.parametrize(
    ("error", "kind", "message"),
    [
        (serial_error(errno.ENOENT), DeviceAbsent, "no such port"),
        (serial_error(errno.EACCES), PortBusy, "adduser"),
        (serial_error(errno.EAGAIN), PortBusy, "in use by another program"),
        (serial_error(errno.EBUSY), PortBusy, "in use by another program"),
        (serial.SerialException("could not open port 'COM3': FileNotFoundError(2, ...)"), DeviceAbsent, "no such port"),
        (serial.SerialException("could not open port 'COM3': PermissionError(13, ...)"), PortBusy, "in use"),
        (serial_error(errno.ENOTTY, "not a tty"), DeviceAbsent, "not a serial port"),
        (ValueError("Invalid baud rate"), DeviceAbsent, "Invalid baud rate"),
    ],
)
def test_open_errors_are_one_line(monkeypatch, error, kind, message):
    def refuse(*arguments, **options):
        raise error

    monkeypatch.setattr(serial, "Serial", refuse)
    with pytest.raises(kind, match=message) as caught:
        ports.open_port("/dev/ttyACM9", 250000)
    assert "/dev/ttyACM9" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_port_lists_the_existing_ones(monkeypatch):
    monkeypatch.setattr(ports, "list_ports", lambda: [MEGA])
    with pytest.raises(DeviceAbsent, match=r"ports here: /dev/serial/by-id/usb-mega 2341:0042 .*MEGA"):
        ports.open_port("/dev/does-not-exist", 250000)


MEGA = ports.PortInfo("/dev/serial/by-id/usb-mega", "/dev/ttyACM0", "Arduino", 0x2341, 0x0042, "75")


class FakePort:
    def __init__(self, device, vid=None, pid=None):
        self.device, self.description, self.vid, self.pid, self.serial_number = device, "some port", vid, pid, "1"


def test_ports_are_listed_megas_first_by_their_stable_name(monkeypatch, tmp_path):
    devices = [tmp_path / name for name in ("ttyS0", "ttyUSB0", "ttyACM0")]
    for device in devices:
        device.touch()
    by_id = tmp_path / "by-id"
    by_id.mkdir()
    (by_id / "usb-Arduino_MEGA").symlink_to(devices[2])
    identities = ((None, None), (0x0403, 0x6001), (0x2A03, 0x42))
    comports = [FakePort(str(device), *identity) for device, identity in zip(devices, identities, strict=True)]
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: comports)
    monkeypatch.setattr(ports, "BY_ID", by_id)
    mega, adapter, plain = ports.list_ports()
    assert (mega.name, mega.device, mega.is_mega) == (str(by_id / "usb-Arduino_MEGA"), str(devices[2]), True)
    assert (adapter.name, adapter.is_mega) == (str(devices[1]), False)
    assert plain.name == str(devices[0])
    assert "0403:6001" in str(adapter)


def mega(device, serial_number):
    return ports.PortInfo(device, device, "Arduino", 0x2341, 0x0042, serial_number)


def test_port_is_found_by_name_or_serial_number(monkeypatch, tmp_path):
    path = tmp_path / "ttyACM1"
    path.touch()
    monkeypatch.setattr(ports, "list_ports", lambda: [mega(str(path), "75A"), mega("/dev/ttyACM7", "75B")])
    assert ports.find_port(str(path)) == str(path)
    assert ports.find_port("75A") == str(path)
    assert ports.find_port("75B") == "/dev/ttyACM7"
    with pytest.raises(DeviceAbsent, match=r"no board at 75: no such port; ports here: .*75A.*75B"):
        ports.find_port("75")


def test_missing_port_names_a_mega_at_another_port(monkeypatch):
    monkeypatch.setattr(ports, "list_ports", lambda: [mega("/dev/ttyACM1", "75A")])
    with pytest.raises(DeviceAbsent, match=r"no board at /dev/ttyACM0: .* MEGA at /dev/ttyACM1; .*--port 75A"):
        ports.find_port("/dev/ttyACM0")
    monkeypatch.setattr(ports, "list_ports", lambda: [mega("/dev/ttyACM1", None)])  # some have no serial number
    with pytest.raises(DeviceAbsent, match=r"ports here: /dev/ttyACM1 2341:0042"):
        ports.find_port("/dev/ttyACM0")


@pytest.mark.parametrize(
    ("vid", "may"), [(0x2341, True), (0x1A86, True), (0x0403, True), (0x0B95, False), (None, False)]
)
def test_only_a_possible_mega_may_be_reset(monkeypatch, tmp_path, vid, may):
    (tmp_path / "ttyACM0").touch()
    (tmp_path / "by-name").symlink_to(tmp_path / "ttyACM0")
    port = mega(str(tmp_path / "ttyACM0"), "75A")._replace(vid=vid)
    monkeypatch.setattr(ports, "list_ports", lambda: [port])
    assert ports.may_be_mega(str(tmp_path / "by-name")) is may
    assert ports.may_be_mega(str(tmp_path / "ttyACM1")), "unknown"


def test_serial_number_of_two_boards_is_refused(monkeypatch):
    monkeypatch.setattr(ports, "list_ports", lambda: [mega("/dev/ttyACM0", "0001"), mega("/dev/ttyACM1", "0001")])
    with pytest.raises(UsageError, match="give one of /dev/ttyACM0, /dev/ttyACM1"):
        ports.find_port("0001")


def test_machine_without_ports(monkeypatch):
    monkeypatch.setattr(ports, "list_ports", list)
    assert "is it plugged in?" in ports.describe_ports()
