"""The stop keys of a terminal become a request; a stdin that is no terminal is left as it is."""

import io
import os
import threading
from types import SimpleNamespace

import pytest

from modsoft.runtime.locks import system_module
from modsoft.runtime.stop import Keys, Paused, Stop, StopKey

termios, tty = system_module("termios"), system_module("tty")
posix = pytest.mark.skipif(termios is None, reason="no terminals of this kind on this system")
POLL_S = 0.05


class Pauses(threading.Event):
    """An event whose `wait` returns at once and records the seconds."""

    def __init__(self):
        super().__init__()
        self.seconds = []

    def wait(self, timeout=None):
        self.seconds.append(timeout)
        return self.is_set()


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def terminal(monkeypatch):
    """A pseudo-terminal as standard input, with this process in the foreground: master and slave."""
    if termios is None:
        pytest.skip("no pseudo-terminals on this system")
    master, slave = os.openpty()
    with open(slave) as stream, open(master, "rb+", buffering=0) as keyboard:
        monkeypatch.setattr("sys.stdin", stream)
        monkeypatch.setattr("os.tcgetpgrp", lambda file: os.getpgrp())
        yield keyboard, slave


@pytest.fixture
def console(monkeypatch):
    """Windows: no termios, and a console of which msvcrt reads the keys in the list."""
    keys = []
    msvcrt = SimpleNamespace(kbhit=lambda: bool(keys), getwch=lambda: keys.pop(0))
    monkeypatch.setattr("modsoft.runtime.stop.system_module", {"msvcrt": msvcrt}.get)
    monkeypatch.setattr("sys.stdin", Terminal())
    return keys


def no_key_is_read():
    """Whether `Keys` starts no thread, so that it reads nothing."""
    stop = Stop()
    with Keys(stop):
        return "keys" not in [thread.name for thread in threading.enumerate()] and stop.error is None


# ---- POSIX


@pytest.mark.parametrize("typed", [b" ", b"q", b"\x1b", b"xyq", b"aq"])
def test_stop_keys_request_the_end(terminal, typed):
    keyboard, slave = terminal
    before = termios.tcgetattr(slave)
    stop = Stop()
    with Keys(stop) as keys:
        keyboard.write(typed)
        stop.wait(10)
        assert isinstance(stop.error, StopKey)
        keys._thread.join(10)
        assert not keys._thread.is_alive()  # the next key is for the shell
    assert termios.tcgetattr(slave) == before


def test_other_keys_request_nothing(terminal):
    keyboard, _ = terminal
    stop = Stop()
    with Keys(stop) as keys:
        keyboard.write(b"xyz\n")
        stop.wait(0.2)
        assert stop.error is None
        assert keys._thread.is_alive()
        assert keys._thread.daemon  # a read that hangs does not keep the process
    assert not keys._thread.is_alive()


def test_terminal_is_read_twenty_times_a_second(terminal, monkeypatch):
    waits = []
    monkeypatch.setattr("select.select", lambda r, w, x, seconds: waits.append(seconds) or ([], [], []))
    keys = Keys(Stop())
    read = keys._posix(termios, tty)
    assert (read(), waits) == ("", [POLL_S])
    keys.restore()


def test_read_of_a_key_does_not_pause(terminal):
    keyboard, _ = terminal
    keys = Keys(Stop())
    keys._done = Pauses()
    read = keys._posix(termios, tty)
    keyboard.write(b"x")
    assert (read(), keys._done.seconds) == ("x", [])
    keys.restore()


@pytest.mark.parametrize("closed", [lambda *arguments: b"", lambda *arguments: os.read(-1, 1)], ids=["end", "error"])
def test_closed_terminal_is_read_without_a_busy_loop(terminal, monkeypatch, closed):
    keys = Keys(Stop())
    keys._done = Pauses()
    read = keys._posix(termios, tty)
    with monkeypatch.context() as patched:
        patched.setattr("select.select", lambda *arguments: ([0], [], []))
        patched.setattr("modsoft.runtime.stop.os", SimpleNamespace(read=closed))
        assert (read(), keys._done.seconds) == ("", [POLL_S])
    keys.restore()


def test_terminal_that_is_closed_in_the_run_is_no_error(terminal):
    keyboard, slave = terminal
    with Keys(Stop()):
        keyboard.close()
        with open(os.devnull) as null:
            os.dup2(null.fileno(), slave)  # it has no settings to restore


@posix
def test_background_job_leaves_the_terminal_alone(terminal, monkeypatch):
    _, slave = terminal
    monkeypatch.setattr("os.tcgetpgrp", lambda file: os.getpgrp() + 1)
    before = termios.tcgetattr(slave)
    stop = Stop()
    with Keys(stop):
        assert termios.tcgetattr(slave) == before
    assert no_key_is_read()


@posix
@pytest.mark.parametrize("foreground", [False, True], ids=["no group", "no settings"])
def test_pipe_is_not_read(monkeypatch, foreground):
    reading, writing = os.pipe()
    os.write(writing, b"q")
    if foreground:
        monkeypatch.setattr("os.tcgetpgrp", lambda file: os.getpgrp())
    with open(reading) as stream, open(writing, "wb"):
        monkeypatch.setattr("sys.stdin", stream)
        assert no_key_is_read()


def test_closed_stream_is_not_read(monkeypatch, tmp_path):
    with open(tmp_path / "empty", "w+") as stream:
        pass
    monkeypatch.setattr("sys.stdin", stream)
    assert no_key_is_read()


@pytest.mark.parametrize("stream", [io.StringIO("q"), None], ids=["text", "none"])
def test_missing_terminal_is_not_read(monkeypatch, stream):
    monkeypatch.setattr("sys.stdin", stream)
    assert no_key_is_read()


# ---- Windows


@pytest.mark.parametrize("typed", [" ", "q", "\x1b", "xyq", "\xe0Hq"])
def test_stop_keys_of_a_windows_console(console, typed):
    console += typed
    stop = Stop()
    with Keys(stop):
        stop.wait(10)
    assert isinstance(stop.error, StopKey)


@pytest.mark.parametrize("stream", [io.StringIO("q"), None], ids=["text", "none"])
def test_windows_without_a_console_reads_no_key(console, monkeypatch, stream):
    monkeypatch.setattr("sys.stdin", stream)
    console += "q"
    assert no_key_is_read()
    assert console == ["q"]


def test_windows_console_is_read_twenty_times_a_second(console):
    keys = Keys(Stop())
    keys._done = Pauses()
    read = keys._windows(SimpleNamespace(kbhit=lambda: False))
    assert (read(), keys._done.seconds) == ("", [POLL_S])


def test_system_without_terminal_modules_reads_no_key(monkeypatch):
    monkeypatch.setattr("modsoft.runtime.stop.system_module", {}.get)
    monkeypatch.setattr("sys.stdin", Terminal())
    assert no_key_is_read()


# ---- Pause


def test_pause_key_requests_a_pause_and_a_stop_key_after_it_the_end(terminal):
    keyboard, _ = terminal
    stop = Stop()
    with Keys(stop, pausable=True) as keys:
        keyboard.write(b"p")
        stop.wait(10)
        assert isinstance(stop.error, Paused)
        assert (str(stop.error), stop.error.exit_code) == ("paused", 0)
        keyboard.write(b"q")
        keys._thread.join(10)
    assert isinstance(stop.error, StopKey)


@pytest.mark.parametrize(("pausable", "typed"), [(False, b"p"), (True, b"x")])
def test_other_keys_do_not_pause(terminal, pausable, typed):
    keyboard, _ = terminal
    stop = Stop()
    with Keys(stop, *[True] * pausable) as keys:  # by default nothing can pause
        keyboard.write(typed)
        stop.wait(0.2)
        assert stop.error is None
        assert keys._thread.is_alive()


def test_pause_does_not_replace_another_request():
    stop = Stop()
    stop.request(StopKey("stop key pressed"))
    stop.request(Paused("paused"))
    assert isinstance(stop.error, StopKey)
