"""A line of a terminal that is written over, by a thread of its own: a terminal that is halted (Ctrl-S) or gone must
not halt the loop."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable
from types import TracebackType
from typing import TextIO

PERIOD_S = 0.2
END_WAIT_S = 0.05  # the valves are vented after it


class StatusLine:
    """While entered, shows what `text()` says. Does nothing where `stream` is no terminal, or None: closed by whoever
    started the program."""

    def __init__(self, text: Callable[[], str], stream: TextIO | None):
        self._text = text
        self._stream = stream
        self._done = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> StatusLine:
        if self._stream is not None and self._stream.isatty():
            self._thread = threading.Thread(target=self._run, args=(self._stream,), name="status line", daemon=True)
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._done.set()
        if self._thread is not None:
            self._thread.join(END_WAIT_S)

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
            pass  # the terminal is gone; the run is not


def _show(stream: TextIO, text: str) -> None:
    width = shutil.get_terminal_size().columns - 1
    stream.write(f"\r\x1b[K{text[:width]}")
    stream.flush()
