"""The terminal of a run: messages, the status line, and what its background threads share."""

from __future__ import annotations

import shutil
import sys
import threading
from collections.abc import Callable
from types import TracebackType
from typing import Self, TextIO

import click

PERIOD_S = 0.2
END_WAIT_S = 0.05  # the valves are vented after it


def say(text: str) -> None:
    """Prints a line for the operator, whose terminal may be closed."""
    try:
        click.echo(text, err=True)
    except (OSError, ValueError):
        pass


def has_terminal() -> bool:
    """Whether an operator can press Enter."""
    try:
        return sys.stdin is not None and sys.stdin.isatty()
    except ValueError:  # closed
        return False


class TerminalThread:
    """A context manager with a daemon thread between entry and exit. A terminal that is halted (Ctrl-S) or closed must
    not halt the loop, so that only such a thread reads or writes it during a run."""

    def __init__(self, name: str, end_wait_s: float):
        """`end_wait_s`: how long the exit waits for the end of the thread."""
        self._name, self._end_wait_s = name, end_wait_s
        self._done = threading.Event()
        self._thread: threading.Thread | None = None

    def _target(self) -> Callable[[], None] | None:
        """What the thread runs until `_done` is set. None: there is no terminal, and no thread starts."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        target = self._target()
        if target is not None:
            self._thread = threading.Thread(target=target, name=self._name, daemon=True)
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._done.set()
        if self._thread is not None:
            self._thread.join(self._end_wait_s)


class StatusLine(TerminalThread):
    """While entered, shows what `text()` returns in one line, which is overwritten. Does nothing if `stream` is not a
    terminal, or None: closed by the parent process."""

    def __init__(self, text: Callable[[], str], stream: TextIO | None):
        super().__init__("status line", END_WAIT_S)
        self._text = text
        self._stream = stream

    def _target(self) -> Callable[[], None] | None:
        stream = self._stream
        return (lambda: self._run(stream)) if stream is not None and stream.isatty() else None

    def _run(self, stream: TextIO) -> None:
        shown = ""
        try:
            while not self._done.wait(PERIOD_S):
                text = self._text()
                if text != shown:
                    _show(stream, text)
                    shown = text
            stream.write("\n" if shown else "")
            stream.flush()
        except (OSError, ValueError):
            pass  # the terminal is closed; the run continues


def _show(stream: TextIO, text: str) -> None:
    width = shutil.get_terminal_size().columns - 1
    stream.write(f"\r\x1b[K{text[:width]}")
    stream.flush()
