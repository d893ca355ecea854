"""Signals and stop keys become one request; a second Ctrl-C leaves at once."""

import io
import signal
import threading

import pytest

from modsoft.runtime.errors import Tripped
from modsoft.runtime.stop import SIGNALS, Interrupted, Signals, Stop, StopKey
from modsoft.runtime.terminal import StatusLine

CODES = {"SIGINT": 130, "SIGTERM": 143, "SIGHUP": 129}
NUMBERS = {getattr(signal, name): code for name, code in CODES.items() if hasattr(signal, name)}


def test_first_request_wins():
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
def test_signal_before_the_run_raises_at_once(number):
    def interrupted():
        with Signals(Stop()):
            signal.raise_signal(number)
            threading.Event().wait(5)

    before = signal.getsignal(number)
    with pytest.raises(Interrupted):
        interrupted()
    assert signal.getsignal(number) is before


@pytest.mark.parametrize("number", NUMBERS)
def test_signal_in_the_run_only_requests_the_stop(number):
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


def test_signal_is_named():
    assert str(Interrupted(signal.SIGINT)) == "stopped by SIGINT"


@pytest.mark.parametrize("number", NUMBERS)
def test_second_signal_before_the_run_does_not_raise_again(number):
    """The program is already on its way out: only Ctrl-C and SIGTERM hurry it."""
    left = []
    with Signals(Stop(), left.append):
        with pytest.raises(Interrupted):
            signal.raise_signal(signal.SIGINT)
        signal.raise_signal(number)
    assert left == ([NUMBERS[number]] if number in (signal.SIGINT, signal.SIGTERM) else [])


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_closed_stream_has_no_status_line():
    with StatusLine(lambda: "one", None):
        pass


def test_status_line_is_overwritten(monkeypatch):
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


def test_halted_terminal_does_not_halt_the_run():
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


def test_closed_terminal_is_no_error():
    class Gone(Terminal):
        def write(self, text):
            raise OSError("gone")

    with StatusLine(lambda: "one", Gone()) as line:
        line._thread.join(10)
        assert not line._thread.is_alive()
