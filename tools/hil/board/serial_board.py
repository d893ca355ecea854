"""A real board with the project's firmware at a serial port, in place of the emulated one.

    modsoft-runtime <-> pseudo-terminal <-> this process <-> serial port <-> board

All bytes pass unmodified; the STATUS and HELLO of the board are read on their way. The runtime opens the
pseudo-terminal; each time, the serial port is closed and opened, which resets a MEGA through DTR as without the rig.
After the runtime has closed it, the serial port remains open until `stop`, so that the venting is seen.
"""

from __future__ import annotations

import contextlib
import os
import select
import tempfile
import threading
import time
import tty
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from modsoft.runtime.board.board import Board
from modsoft.runtime.board.codec import ForeignHello, Parser
from modsoft.runtime.board.configuration_check import check_board
from modsoft.runtime.board.ports import find_port, open_port
from modsoft.runtime.board.protocol import Hello, State, Status
from modsoft.runtime.errors import ModsoftError, ProtocolMismatch
from modsoft.runtime.robot import Robot

if TYPE_CHECKING:
    from serial import Serial

Event = dict[str, Any]

DTR_LOW_S = 0.05  # between closing and opening the port
POLL_S = 0.005  # for the runtime, which opens and closes the pseudo-terminal
READ_SIZE = 4096


class SerialBoard:
    """A board at a serial port. `check` first, then `start`; then `port` is the port for the runtime.

    Every event is kept in `trace` and given to `on_event` by the forwarding thread: `serial` (once: port and HELLO),
    `hello`, `status` (applied pressures in 10 Pa), `host-open`, `host-close`, `port-failed`; all with `mono_ns`,
    CLOCK_MONOTONIC of the host at the arrival, and `t_us`, the same in microseconds.
    """

    clock = "its own; all times are of the host at the arrival"

    def __init__(self, name: str, robot: Robot) -> None:
        """name: port or USB serial number. `DeviceAbsent` without such a port. Opens nothing."""
        self.board = name
        self.on_event: Callable[[Event], None] = lambda event: None
        self.trace: list[Event] = []
        self._device = find_port(name)
        self._robot = robot
        self._hello: Hello | None = None
        self._serial: Serial | None = None
        self._duties: list[float] = []
        self._parser = Parser()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="serial board", daemon=True)
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._master = -1

    # ---- The board

    def check(self) -> Hello:
        """Opens the port, which resets the board, compares its HELLO with the robot file, and closes the port.

        Raises `DeviceAbsent`, `PortBusy`, and `ProtocolMismatch`: also for a board with pressure sensors, whose inputs
        are open here.
        """
        with Board.open(self._device, self._robot.serial.baud) as board:
            hello = board.hello
        check_board(hello, self._robot, self.board)
        if hello.sensors:
            channels = ", ".join(str(channel) for channel in range(16) if hello.sensors >> channel & 1)
            raise ProtocolMismatch(
                f"the board at {self.board} has pressure sensors on channels {channels}, expected none: without the "
                "robot its inputs are open and give random readings; flash it with SENSORS=0 (firmware/README.md)"
            )
        self._hello = hello
        return hello

    @property
    def hello(self) -> Hello:
        """The HELLO of `check`."""
        assert self._hello is not None, "check() comes first"
        return self._hello

    def duties(self) -> list[float]:
        """Applied pressure of each channel by the last STATUS, as a fraction of the full scale, 0 to 1."""
        return list(self._duties)

    def driven_duties(self) -> list[float | None]:
        """`duties`: a STATUS does not report floating pins."""
        return list(self._duties)

    # ---- The pseudo-terminal

    @property
    def port(self) -> str:
        """The port for the runtime; missing after the serial port failed."""
        assert self._folder is not None, "start() comes first"
        return str(Path(self._folder.name) / "ttyMEGA")

    def start(self) -> None:
        """Makes the pseudo-terminal and starts the thread; the serial port is opened with it."""
        self._folder = tempfile.TemporaryDirectory(prefix="modsoft-serial-")
        self._master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        Path(self.port).symlink_to(os.ttyname(slave))
        os.close(slave)  # from now on the master reports whether the runtime has it open
        self._emit("serial", port=self.board, **self.hello._asdict())
        self._thread.start()

    def stop(self) -> None:
        """Ends the thread and closes both ports."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()
        self._unplug()
        if self._folder is not None:
            self._folder.cleanup()
        if self._serial is not None:
            self._serial.close()

    def _unplug(self) -> None:
        if self._master >= 0:
            Path(self.port).unlink(missing_ok=True)
            os.close(self._master)
            self._master = -1

    # ---- Forwarding

    def _serve(self) -> None:
        try:
            while (serial := self._await_host()) is not None:
                self._forward(serial)
        except (OSError, ModsoftError) as error:  # of the serial port, including pyserial's own errors
            self._fail(error)

    def _fail(self, error: Exception) -> None:
        """The runtime sees a lost port, as with a pulled cable."""
        self._emit("port-failed", reason=str(error))
        self._unplug()

    def _host_events(self) -> int:
        poller = select.poll()
        poller.register(self._master, select.POLLIN)
        events = poller.poll(0)
        return events[0][1] if events else 0

    def _await_host(self) -> Serial | None:
        """Waits until the runtime opens the pseudo-terminal; returns the port, newly opened, or None at the end.
        Meanwhile reads what the board sends, if its port is open."""
        while not self._stop.is_set() and self._host_events() & select.POLLHUP:
            if self._serial is None:
                time.sleep(POLL_S)
            else:
                self._watch(self._serial.read(READ_SIZE))  # returns after READ_WAIT_S
        if self._stop.is_set():
            return None
        if self._serial is not None:
            self._serial.close()
            time.sleep(DTR_LOW_S)
        self._parser = Parser()
        self._serial = open_port(self._device, self._robot.serial.baud)
        self._emit("host-open")
        return self._serial

    def _forward(self, serial: Serial) -> None:
        """Both directions, until the runtime closes the pseudo-terminal."""
        poller = select.poll()
        poller.register(self._master, select.POLLIN)
        poller.register(serial.fileno(), select.POLLIN)
        while not self._stop.is_set():
            events = dict(poller.poll(1e3 * POLL_S))
            if events.get(serial.fileno()):
                data = serial.read(max(1, serial.in_waiting))
                with contextlib.suppress(BlockingIOError):  # the runtime does not read: lost, as on a full line
                    os.write(self._master, data)
                self._watch(data)
            host = events.get(self._master, 0)
            if host & select.POLLIN:  # before the end: bytes that were written before the close
                serial.write(os.read(self._master, READ_SIZE))
            elif host & select.POLLHUP:
                self._emit("host-close")
                return

    def _watch(self, data: bytes) -> None:
        """Reads the frames in bytes of the board."""
        for frame in self._parser.feed(data):
            if isinstance(frame, ForeignHello):
                self._emit("hello", protocol_hash=frame.protocol_hash)
            elif isinstance(frame.message, Hello):
                self._emit("hello", **frame.message._asdict())
            elif isinstance(frame.message, Status):
                status = frame.message
                self._duties = [units / self.hello.p_full for units in status.applied[: self.hello.channels]]
                state = State(status.state).name if status.state in set(State) else str(status.state)
                self._emit("status", **{**status._asdict(), "state": state})

    def _emit(self, name: str, **values: Any) -> None:
        mono_ns = time.monotonic_ns()
        event = {"event": name, "mono_ns": mono_ns, "t_us": mono_ns / 1000, **values}
        self.trace.append(event)
        self.on_event(event)
