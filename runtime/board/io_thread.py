"""The serial line to the board: a thread that owns the port, and the lock that guards the `Connection` which it serves.

The thread sends the heartbeats, but with the control loop's own counter in them, so that the board also notices a loop
that is stuck while this thread lives.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TypeVar

from modsoft.runtime.board.connection import Connection, Phase
from modsoft.runtime.board.ports import READ_WAIT_S, Port

HAND_OVER_S = 0.002  # ten times what it takes
T = TypeVar("T")


class IoThread:
    """What comes from the port goes to the link, what the link has to say goes out, until `close` or an error.

    `changed` is held by whoever asks something of the link, and notified when something came. clock: monotonic seconds.
    threaded: False serves the port from the calls that wait instead of a thread of its own, for tests on virtual time.
    """

    def __init__(self, port: Port, link: Connection, clock: Callable[[], float], threaded: bool) -> None:
        self.changed = threading.Condition()
        self._port = port
        self._link = link
        self._clock = clock
        self._dtr = True
        self._away = False  # closed for the time of a reset
        self._stop = threading.Event()
        self._written = threading.Event()
        self._thread: threading.Thread | None = None
        if threaded:
            self._thread = threading.Thread(target=self._serve, name="board", daemon=True)
            self._thread.start()

    @property
    def closed(self) -> bool:
        """Whether nothing is served any more."""
        return self._stop.is_set() or (self._thread is not None and not self._thread.is_alive())

    def wake(self) -> None:
        """The thread of the port may sleep in a read; what was asked for is to go out now."""
        if self._thread is not None and not self.closed:
            self._port.cancel_read()

    def send_and_wait(self, ask: Callable[[], T]) -> T:
        """Returns what `ask`, which wants something of the link, returned: when that is written, or 2 ms later.

        The thread of the port needs the interpreter, so the caller steps aside for it, but a port that takes nothing
        holds nobody up.
        """
        self._written.clear()
        with self.changed:
            result = ask()
        self.wake()
        if self._thread is not None:
            self._written.wait(HAND_OVER_S)
        return result

    def wait(self, condition: Callable[[], bool], deadline: float) -> None:
        """Until `condition`, the loss of the board, or the deadline."""
        with self.changed:
            lost = self._link.phase is Phase.LOST
            while not condition() and self._clock() < deadline and not self.closed:
                if not lost and self._link.phase is Phase.LOST:
                    return
                if self._thread is None:
                    self.pump()
                else:
                    self.changed.wait(0.05)

    def pump(self) -> bool:
        """One turn: what came, what has to go. False when the port failed."""
        try:
            data = b""
            if self._away:
                self._stop.wait(READ_WAIT_S)
            else:
                data = self._port.read(max(1, self._port.in_waiting))
            with self.changed:
                now = self._clock()
                if data:
                    self._link.feed(data, now)
                out = self._link.poll(now)
                if data or self._link.phase is Phase.LOST:
                    self.changed.notify_all()
            if out:
                self._port.write(out)
                self._written.set()
            if self._link.dtr != self._dtr:
                self._set_dtr(self._link.dtr)
        except OSError as error:  # pyserial's own errors are OSErrors too
            with self.changed:
                self._link.close(f"the port failed ({error})", self._clock())
            self._stop.set()
            return False
        return True

    def close(self) -> None:
        """End the thread and close the port; nothing is vented."""
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
                if not self._stop.is_set():  # a bug: nothing is sent any more, and the loop has to know
                    self._link.close("the thread of the port ended by an error", self._clock())
                self.changed.notify_all()

    def _set_dtr(self, level: bool) -> None:
        """Reset the board: DTR down, then up."""
        self._dtr = level
        try:
            if not self._away:
                self._port.dtr = level
                return
        except OSError:
            pass
        # A pseudo-terminal has no such line; what stands behind it takes closing and opening for it.
        self._away = not level
        if level:
            self._port.open()
        else:
            self._port.close()
