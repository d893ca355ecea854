"""A process of the rig that takes JSON lines and gives JSON lines."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from typing import IO, Any, cast

from modsoft.hil.board.emulator import end
from modsoft.runtime.errors import DeviceAbsent, LostInRun

Line = dict[str, Any]

START_TIMEOUT_S = 60.0  # the first start compiles the simulator


class Child:
    """A helper process that takes JSON lines and gives JSON lines. `on_line` runs in its reading thread."""

    def __init__(self, module: str, arguments: Sequence[str], on_line: Callable[[Line], None]):
        self.name = module.rpartition(".")[2]
        self._on_line = on_line
        self._sending = threading.Lock()
        self._ready = threading.Event()
        self._ended = False
        self._stderr = tempfile.TemporaryFile()
        self.ready: Line = {}
        self.summary: Line = {}
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-m", module, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            start_new_session=True,  # a Ctrl-C at the terminal is for the rig, which ends its children in order
        )
        # Popen's own are optional, for processes without pipes.
        self._input, self._output = cast(IO[bytes], self.process.stdin), cast(IO[bytes], self.process.stdout)
        self._reader = threading.Thread(target=self._read, name=self.name, daemon=True)
        self._reader.start()

    def wait_ready(self, timeout_s: float = START_TIMEOUT_S) -> None:
        """Returns when the process reports `ready`; `DeviceAbsent` with its last message when it ended."""
        deadline = time.monotonic() + timeout_s
        while not self._ready.wait(0.1):
            if self.process.poll() is not None or time.monotonic() > deadline:
                raise DeviceAbsent(f"the {self.name} did not start: {self.last_message()}")

    def send(self, line: Line) -> None:
        """Sends one line to the process; `check` finds out whether it has ended."""
        with contextlib.suppress(BrokenPipeError, ValueError), self._sending:
            self._input.write(json.dumps(line).encode() + b"\n")
            self._input.flush()

    def check(self) -> None:
        """`LostInRun` if the process ended by itself."""
        if self._ended and self.process.poll() is not None:
            raise LostInRun(f"the {self.name} ended in mid-run: {self.last_message()}")

    def last_message(self) -> str:
        self._stderr.seek(0)
        lines = self._stderr.read().decode(errors="replace").strip().splitlines()
        return lines[-1] if lines else f"exit code {self.process.poll()}"

    def stop(self) -> None:
        """Ends the process by the end of its input, or by force. May be called twice."""
        end(self.process, self._sending)
        self._reader.join()
        self._output.close()
        self._stderr.close()

    def _read(self) -> None:
        for text in self._output:
            line = json.loads(text)
            if line["event"] == "ready":
                self.ready = line
                self._ready.set()
            elif line["event"] == "summary":
                self.summary = line
            else:
                self._on_line(line)
        self._ended = True
