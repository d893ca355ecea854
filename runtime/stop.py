"""Requests to end a run: signals and the stop keys. The first request counts and the loop obeys it; a second Ctrl-C or
SIGTERM ends the process at once, and then the board's own timer vents."""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Any

from modsoft.runtime.errors import ModsoftError, Tripped
from modsoft.runtime.locks import system_module
from modsoft.runtime.terminal import TerminalThread

STOP_KEYS = (" ", "q", "\x1b")  # space, q, Esc
PAUSE_KEY = "p"
# SIGHUP does not exist on Windows.
SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))


class Interrupted(ModsoftError):
    """A signal ended the run; the exit code is the shell's for that signal."""

    def __init__(self, number: int):
        super().__init__(f"stopped by {signal.Signals(number).name}")
        self.exit_code = 128 + number


class StopKey(Tripped):
    """The operator pressed a stop key."""


class Paused(ModsoftError):
    """The operator pressed the pause key, to go on later. Any other request replaces this one."""

    exit_code = 0


class Stop:
    """The stop request of a run. The loop sleeps in `wait`, which a request ends."""

    def __init__(self) -> None:
        self._event = threading.Event()
        self.error: ModsoftError | None = None

    def request(self, error: ModsoftError) -> None:
        """Requests the end of the run; only the first reason is kept."""
        if self.error is None or isinstance(self.error, Paused):
            self.error = error
        self._event.set()

    def wait(self, seconds: float) -> None:
        self._event.wait(seconds)

    def check(self) -> None:
        """Raises the reason of a request."""
        if self.error is not None:
            raise self.error


class Signals:
    """While entered, signals become requests.

    Before `hold` a signal raises at once: nothing is under pressure yet, and connecting to a device can take seconds.
    After `hold` it only makes the request, so that no signal interrupts the venting.
    """

    def __init__(self, stop: Stop, leave: Callable[[int], Any] = os._exit):
        self.stop = stop
        self._leave = leave
        self._holding = False
        self._requested = False
        self._before: dict[int, Any] = {}

    def hold(self) -> None:
        self._holding = True

    def __enter__(self) -> Signals:
        for number in SIGNALS:
            self._before[number] = signal.signal(number, self._on_signal)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        error = Interrupted(number)
        if self._requested:
            # When a terminal closes, it sends SIGHUP and its shell a second one, which no person requested.
            if number in (signal.SIGINT, signal.SIGTERM):
                self._leave(error.exit_code)
            return
        self._requested = True
        self.stop.request(error)
        if not self._holding:
            raise error


class Keys(TerminalThread):
    """While entered, the stop keys of a terminal become requests, and with `pausable` the pause key too. Does nothing
    if stdin is not a terminal, or one that this process may not read."""

    def __init__(self, stop: Stop, pausable: bool = False):
        super().__init__("keys", end_wait_s=1.0)
        self._stop = stop
        self._pausable = pausable
        self._restore: Callable[[], None] | None = None

    def _target(self) -> Callable[[], None] | None:
        termios, tty, msvcrt = map(system_module, ("termios", "tty", "msvcrt"))
        read = self._posix(termios, tty) if termios else self._windows(msvcrt) if msvcrt else None
        return None if read is None else lambda: self._run(read)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        super().__exit__(kind, error, trace)
        self.restore()

    def restore(self) -> None:
        """Restores the settings of the terminal."""
        if self._restore is not None:
            self._restore()

    def _run(self, read: Callable[[], str]) -> None:
        while not self._done.is_set():
            key = read()
            if key in STOP_KEYS:
                self._stop.request(StopKey("stop key pressed"))
                return
            if self._pausable and key == PAUSE_KEY:
                self._stop.request(Paused("paused"))  # a stop key may follow

    def _posix(self, termios: Any, tty: Any) -> Callable[[], str] | None:
        if sys.stdin is None:  # closed by the parent process
            return None
        try:
            terminal = sys.stdin.fileno()
            if os.tcgetpgrp(terminal) != os.getpgrp():  # raises OSError if it is no terminal of this process
                return None  # the system stops a background job that uses its terminal
            before = termios.tcgetattr(terminal)
            tty.setcbreak(terminal)  # Ctrl-C stays a signal
        except (OSError, ValueError, termios.error):
            return None

        def restore() -> None:
            try:
                termios.tcsetattr(terminal, termios.TCSANOW, before)
            except termios.error:
                pass  # the terminal was closed

        self._restore = restore

        def read() -> str:
            if not select.select([terminal], [], [], 0.05)[0]:
                return ""
            try:
                key = os.read(terminal, 1)
            except OSError:
                key = b""
            if not key:  # the terminal is closed; SIGHUP comes too
                self._done.wait(0.05)
            return key.decode("latin-1")

        return read

    def _windows(self, msvcrt: Any) -> Callable[[], str] | None:
        if sys.stdin is None or not sys.stdin.isatty():
            return None

        def read() -> str:
            if msvcrt.kbhit():
                return str(msvcrt.getwch())
            self._done.wait(0.05)
            return ""

        return read
