"""Signals and stop keys become one request; a second Ctrl-C leaves at once."""

import io
import os
import signal
import threading
from types import SimpleNamespace

import pytest

from modsoft.runtime.errors import Tripped
from modsoft.runtime.stop import SIGNALS, Interrupted, Keys, Signals, Stop, StopKey
from modsoft.runtime.terminal import StatusLine

CODES = {"SIGINT": 130, "SIGTERM": 143, "SIGHUP": 129}
NUMBERS = {getattr(signal, name): code for name, code in CODES.items() if hasattr(signal, name)}


def test_the_first_request_wins():
    stop = Stop()
    stop.check()
    stop.request(StopKey("first"))
    stop.request(Tripped("second"))
    stop.wait(3600)  # returns at once
    with pytest.raises(StopKey, match="first") as caught:
        stop.check()
    assert caught.value.exit_code == 79


@pytest.mark.parametrize(("number", "code"), NUMBERS.items())
def test_exit_codes_of_signals(number, code):
    assert number in SIGNALS
    assert Interrupted(number).exit_code == code


@pytest.mark.parametrize("number", NUMBERS)
def test_before_the_run_a_signal_raises_where_the_program_is(number):
    def interrupted():
        with Signals(Stop()):
            signal.raise_signal(number)
            threading.Event().wait(5)

    before = signal.getsignal(number)
    with pytest.raises(Interrupted):
        interrupted()
    assert signal.getsignal(number) is before


@pytest.mark.parametrize("number", NUMBERS)
def test_in_the_run_a_signal_only_asks(number):
    stop, left = Stop(), []
    with Signals(stop, left.append) as signals:
        signals.hold()
        signal.raise_signal(number)
        stop.wait(5)
        with pytest.raises(Interrupted):
            stop.check()
        signal.raise_signal(number)
        # A closing terminal sends SIGHUP twice; a person who presses Ctrl-C again wants out.
        assert left == ([NUMBERS[number]] if number in (signal.SIGINT, signal.SIGTERM) else [])


def test_keys_do_nothing_without_a_terminal(monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO("q"))
    stop = Stop()
    with Keys(stop):
        stop.wait(0)
    assert stop.error is None


def test_keys_and_status_line_do_without_closed_streams(monkeypatch):
    monkeypatch.setattr("sys.stdin", None)
    stop = Stop()
    with Keys(stop), StatusLine(lambda: "one", None):
        stop.wait(0)
    assert stop.error is None


@pytest.fixture
def terminal(monkeypatch):
    """A pseudo-terminal as standard input, ours to read from."""
    pytest.importorskip("termios", reason="no pseudo-terminals on this system")
    master, slave = os.openpty()
    with open(slave, closefd=False) as stream:
        monkeypatch.setattr("sys.stdin", stream)
        monkeypatch.setattr("os.tcgetpgrp", lambda file: os.getpgrp())
        yield master, slave
    os.close(master)
    os.close(slave)


@pytest.mark.parametrize("key", [b" ", b"q", b"\x1b", b"xyq"])
def test_stop_keys(terminal, key):
    import termios

    master, slave = terminal
    before = termios.tcgetattr(slave)
    stop = Stop()
    with Keys(stop):
        os.write(master, key)
        stop.wait(10)
        assert isinstance(stop.error, StopKey)
    assert termios.tcgetattr(slave) == before


def test_other_keys_are_no_stop(terminal):
    master, _ = terminal
    stop = Stop()
    with Keys(stop):
        os.write(master, b"xyz\n")
        stop.wait(0.2)
    assert stop.error is None


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def console(monkeypatch):
    """Windows: no termios, and a console of which msvcrt gives the keys in the list."""
    keys = []
    msvcrt = SimpleNamespace(kbhit=lambda: bool(keys), getwch=lambda: keys.pop(0))
    monkeypatch.setattr("modsoft.runtime.stop.system_module", {"msvcrt": msvcrt}.get)
    monkeypatch.setattr("sys.stdin", Terminal())
    return keys


@pytest.mark.parametrize("keys", [" ", "q", "\x1b", "xyq", "\xe0Hq"])
def test_stop_keys_of_a_windows_console(console, keys):
    console += keys
    stop = Stop()
    with Keys(stop):
        stop.wait(10)
    assert isinstance(stop.error, StopKey)


def test_keys_of_windows_do_nothing_without_a_console(console, monkeypatch):
    monkeypatch.setattr("sys.stdin", io.StringIO("q"))
    console += "q"
    stop = Stop()
    with Keys(stop):
        pass
    assert stop.error is None
    assert console == ["q"]


def test_keys_do_nothing_where_a_system_has_no_way_to_read_them(monkeypatch):
    monkeypatch.setattr("modsoft.runtime.stop.system_module", {}.get)
    monkeypatch.setattr("sys.stdin", Terminal())
    stop = Stop()
    with Keys(stop):
        pass
    assert stop.error is None


def test_status_line_is_written_over(monkeypatch):
    shown, stream, written = ["one"], Terminal(), threading.Event()
    real = stream.write
    monkeypatch.setattr(stream, "write", lambda text: real(text) and written.set())
    with StatusLine(lambda: shown[0], stream):
        assert written.wait(10)
    assert stream.getvalue() == "\r\x1b[Kone\n"


def test_no_status_line_without_a_terminal():
    stream = io.StringIO()
    with StatusLine(lambda: "one", stream):
        pass
    assert stream.getvalue() == ""


def test_a_halted_terminal_does_not_halt_the_run():
    class Halted(Terminal):
        def write(self, text):
            threading.Event().wait(30)
            return len(text)

    shown = threading.Event()

    def text():
        shown.set()
        return "one"

    with StatusLine(text, Halted()):
        assert shown.wait(10)


def test_a_terminal_that_is_gone_is_no_error():
    class Gone(Terminal):
        def write(self, text):
            raise OSError("gone")

    with StatusLine(lambda: "one", Gone()) as line:
        line._thread.join(10)
        assert not line._thread.is_alive()
