"""A tracker's client in a process of its own: if it crashes or hangs, the runtime loses frames only.

The process reads the client and sends typed messages (`modsoft.runtime.tracking.messages`) through a pipe. It ignores
Ctrl-C and ends with the runtime. If it dies, is silent or sends anything else, it is started again, and the limits of
the robot file decide whether the run continues.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from multiprocessing.connection import Connection, wait
from typing import Any

from modsoft.runtime.errors import DeviceAbsent, ModsoftError, UsageError
from modsoft.runtime.tracking import messages
from modsoft.runtime.tracking.frame import FrameError, Source, TrackerFrame

WAIT_S = 0.05  # for a message, in one `read`
SILENCE_S = (
    1.0  # of a connected client, which ends a blocked read after 0.3 s where the system can; a busy host delays it
)
IDLE_S = 0.1  # between two messages of a client without frames
CONNECT_S = 20.0  # for a client that opens its tracker: a mute serial port takes 5 s at each of several commands
RETRY_S = 0.2  # between two attempts to open a lost tracker
END_S = 0.3  # for the client to stop its tracker
SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGHUP") if hasattr(signal, name))  # of a terminal

Opener = Callable[[], Source]


class ClientProcess:
    """The source that `open_source` opens in another process, with the errors of opening it: `UsageError` and
    `DeviceAbsent`. `open_source` must be a function of a module, or a `functools.partial` of one."""

    def __init__(self, open_source: Opener, name: str, now: Callable[[], float] = time.monotonic):
        """`name`: of the tracker, for messages."""
        self._open_source, self._name, self._now = open_source, name, now
        self.device = ""
        self._process: Any = None
        self._last: TrackerFrame | None = None
        self._shift = 0  # added to the device's frame numbers
        self._device_hz: float | None = None
        self._connections = self._numbered_connections = 0
        try:
            self._start()
            while not self._connections:
                self._await_ready()
        except BaseException:
            self.close()
            raise

    def read(self) -> TrackerFrame | None:
        if self._process is None:
            self._start()
        message = self._receive()
        match message:
            case messages.Frame():
                return self._numbered(messages.to_frame(message, self._now()))
            case messages.Problem() | messages.Failed():
                raise FrameError(message.text)
        return None

    def close(self) -> None:
        """Ends the process; the client stops its tracker if it can within `END_S`."""
        self._end(END_S)

    # ---- The process

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=serve, args=(theirs, self._open_source), name=self._name, daemon=True)
        self._allowed_s, self._heard_s = CONNECT_S, self._now()
        with _blocked_signals():
            self._process.start()
        theirs.close()

    def _end(self, patience_s: float) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        self._pipe.close()
        process.join(patience_s)
        if process.is_alive():
            process.kill()
            process.join()

    # ---- Its messages

    def _receive(self) -> messages.AnyMessage | None:
        """The next message, None if there is none yet. `FrameError` ends a process that is dead, silent or sends what
        is not a message; the next `read` starts another one."""
        if not self._pipe.poll(WAIT_S):
            silent_s = self._now() - self._heard_s
            if silent_s > self._allowed_s:
                self._end(0.0)
                raise FrameError(f"the tracker's client sent nothing for {silent_s:.1f} s")
            return None
        try:
            message = messages.decode(self._pipe.recv_bytes(messages.LARGEST_MESSAGE))
        except FrameError:
            self._end(0.0)
            raise
        except (EOFError, OSError) as error:
            self._process.join(END_S)
            code = self._process.exitcode
            self._end(0.0)
            raise FrameError(f"the tracker's client ended ({_cause(code)})") from error
        self._heard_s = self._now()
        if isinstance(message, messages.Connecting):
            self._allowed_s = CONNECT_S
        elif isinstance(message, messages.Ready):
            self._allowed_s = SILENCE_S
            self._connections += 1
            self.device = message.device
        return message

    def _await_ready(self) -> None:
        try:
            message = self._receive()
        except FrameError as error:
            raise DeviceAbsent(f"{self._name}: {error}; start again") from error
        if isinstance(message, messages.Failed):
            raise (UsageError if message.kind == "usage" else DeviceAbsent)(message.text)

    def _numbered(self, frame: TrackerFrame) -> TrackerFrame:
        """The frame with the last known frame rate, and with a number above those before it where the device was
        connected again and may count from 0."""
        self._device_hz = frame.device_hz or self._device_hz
        number, last = frame.device_frame + self._shift, self._last
        if self._connections > self._numbered_connections:
            self._numbered_connections = self._connections
            if last is not None and number <= last.device_frame:
                passed_s = frame.monotonic_s - last.monotonic_s
                number = last.device_frame + max(1, round(passed_s * (self._device_hz or 0.0)))
                self._shift = number - frame.device_frame
        self._last = replace(frame, device_frame=number, device_hz=self._device_hz)
        return self._last


def _cause(code: int | None) -> str:
    """How a process ended."""
    if code is not None and code < 0:
        with contextlib.suppress(ValueError):
            return signal.Signals(-code).name
    return f"exit code {code}"


@contextlib.contextmanager
def _blocked_signals() -> Iterator[None]:
    """A process started meanwhile ignores the signals of its terminal from its first instant on."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


# ---- In the process


class _Closed(Exception):
    """The runtime has closed its end of the pipe."""


def serve(pipe: Connection, open_source: Opener) -> None:
    """Opens the source and sends its frames until the runtime closes the pipe. A source that is lost is opened again;
    one that could not be opened at all ends the process."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    with contextlib.suppress(OSError):  # programs that the client starts print
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    threading.Thread(target=_end_with_runtime, daemon=True).start()
    with contextlib.suppress(_Closed):
        _serve(lambda message: _send(pipe, message), open_source)


def _serve(send: Callable[[messages.AnyMessage], None], open_source: Opener) -> None:
    is_first = True
    while True:
        send(messages.Connecting())
        try:
            source = open_source()
        except Exception as error:  # noqa: BLE001 - any error of a driver
            text = str(error) if isinstance(error, ModsoftError) else f"{type(error).__name__}: {error}"
            if is_first:
                send(messages.Failed("usage" if isinstance(error, UsageError) else "absent", text[:1000]))
                return
            send(messages.Problem(text[:1000]))
            time.sleep(RETRY_S)
            continue
        is_first = False
        try:
            send(messages.Ready(source.device[:1000]))
            _send_frames(send, source)
        finally:
            source.close()


def _send_frames(send: Callable[[messages.AnyMessage], None], source: Source) -> None:
    """Until the source is lost."""
    sent_s = time.monotonic()
    while True:
        message: messages.AnyMessage = messages.Idle()
        try:
            frame = source.read()
            if frame is not None:
                message = messages.from_frame(frame)
        except FrameError as error:
            message = messages.Problem(str(error)[:1000])
        except Exception as error:  # noqa: BLE001 - any error of a driver
            send(messages.Problem(f"{error or type(error).__name__}"[:1000]))
            return
        if not isinstance(message, messages.Idle) or time.monotonic() - sent_s > IDLE_S:
            send(message)
            sent_s = time.monotonic()


def _send(pipe: Connection, message: messages.AnyMessage) -> None:
    try:
        pipe.send_bytes(messages.encode(message))
    except OSError as error:
        raise _Closed from error


def _end_with_runtime() -> None:
    runtime = multiprocessing.parent_process()
    if runtime is not None:
        wait([runtime.sentinel])
        os._exit(0)
