"""The thread that owns the serial port of the board, and the lock of the `Connection` that it serves.

The thread sends the heartbeats with the tick of the control loop, so that the board also detects a control loop that
is stuck while the thread runs.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TypeVar

from modsoft.runtime.board.connection import Connection, Phase
from modsoft.runtime.board.ports import READ_WAIT_S, Port

WRITE_TIMEOUT_S = 0.002  # ten times the usual duration
T = TypeVar("T")


class IoThread:
    """Passes bytes between the port and the connection, until `close` or an error.

    Hold `changed` to use the connection; it is notified when bytes arrive. clock: monotonic seconds. threaded: False
    serves the port in the calls that wait, instead of in a thread, for tests on virtual time.
    """

    def __init__(self, port: Port, connection: Connection, clock: Callable[[], float], threaded: bool) -> None:
        self.changed = threading.Condition()
        self._port = port
        self._connection = connection
        self._clock = clock
        self._dtr = True
        self._closed_for_reset = False
        self._stop = threading.Event()
        self._written = threading.Event()
        self._thread: threading.Thread | None = None
        if threaded:
            self._thread = threading.Thread(target=self._serve, name="board", daemon=True)
            self._thread.start()

    @property
    def closed(self) -> bool:
        """Whether the port is no longer served."""
        return self._stop.is_set() or (self._thread is not None and not self._thread.is_alive())

    def wake(self) -> None:
        """Interrupt a read of the thread, so that it writes immediately."""
        if self._thread is not None and not self.closed:
            self._port.cancel_read()

    def send_and_wait(self, request: Callable[[], T]) -> T:
        """Call `request`, which queues a message, and return its result after the message is written or after 2 ms.

        The wait lets the thread run; its limit keeps a blocked port from stopping the caller.
        """
        self._written.clear()
        with self.changed:
            result = request()
        self.wake()
        if self._thread is not None:
            self._written.wait(WRITE_TIMEOUT_S)
        return result

    def wait(self, condition: Callable[[], bool], deadline: float) -> None:
        """Wait for `condition`, the loss of the board or the deadline."""
        with self.changed:
            was_lost = self._connection.phase is Phase.LOST
            while not condition() and self._clock() < deadline and not self.closed:
                if not was_lost and self._connection.phase is Phase.LOST:
                    return
                if self._thread is None:
                    self.pump()
                else:
                    self.changed.wait(0.05)

    def pump(self) -> bool:
        """Read and write once. False if the port failed."""
        try:
            data = b""
            if self._closed_for_reset:
                self._stop.wait(READ_WAIT_S)
            else:
                data = self._port.read(max(1, self._port.in_waiting))
            with self.changed:
                now = self._clock()
                if data:
                    self._connection.feed(data, now)
                out = self._connection.poll(now)
                if data or self._connection.phase is Phase.LOST:
                    self.changed.notify_all()
            if out:
                self._port.write(out)
                self._written.set()
            if self._connection.discovery.dtr != self._dtr:
                self._set_dtr(self._connection.discovery.dtr)
        except OSError as error:  # including pyserial's own errors
            with self.changed:
                self._connection.close(f"the port failed ({error})", self._clock())
            self._stop.set()
            return False
        return True

    def close(self) -> None:
        """End the thread and close the port, without venting."""
        self._stop.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(timeout=1.0)
        self._port.close()

    def _serve(self) -> None:
        try:
            while not self._stop.is_set() and self.pump():
                pass
        finally:
            with self.changed:
                if not self._stop.is_set():  # a bug in the thread, which the control loop must detect
                    self._connection.close("the thread of the port ended by an error", self._clock())
                self.changed.notify_all()

    def _set_dtr(self, level: bool) -> None:
        """Set DTR; low, then high resets the board."""
        self._dtr = level
        try:
            if not self._closed_for_reset:
                self._port.dtr = level
                return
        except OSError:
            pass
        # A pseudo-terminal has no DTR: the emulated board resets when its port is closed and opened.
        self._closed_for_reset = not level
        if level:
            self._port.open()
        else:
            self._port.close()
