"""Builds and starts the emulated board, and communicates with it.

Two boards with one interface: `simavr` runs the compiled firmware on an emulated ATmega2560 behind the MEGA's real
bootloader; `native` runs the firmware's logic compiled for this machine, for machines without simavr, and shows no
bootloader, timer register or CPU time. Commands and events are described at the top of `tools/hil/board/board.c`.

simavr is GPL-3; what is linked with it here is a test tool, is built on the spot, and is not part of the wheel.
"""

from __future__ import annotations

import contextlib
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import IO, Any

import msgspec

from modsoft.hil.board.toolchain import BOOTLOADER, FIRMWARE_ELF, build, choose
from modsoft.runtime.errors import DeviceAbsent

Event = dict[str, Any]
START_TIMEOUT_S = 10.0
RUN_TIMEOUT_S = 60.0
STOP_TIMEOUT_S = 3.0
# A process that another thread starts has all open ports of this one, until it executes its program: a port that is
# closed meanwhile would remain open for its board.
process_start = threading.Lock()


def is_event(name: str, **values: Any) -> Callable[[Event], bool]:
    """A predicate for `EmulatedBoard.wait_for`: events of this name with these values."""
    return lambda event: event["event"] == name and all(event.get(key) == value for key, value in values.items())


def end(process: subprocess.Popen[bytes], sending: threading.Lock) -> None:
    """End a process by the end of its input, or by force. `sending` is the lock of its writers.

    A process that hangs with a full pipe blocks its writer, which keeps the lock: it is killed without the lock.
    """
    assert process.stdin is not None
    if sending.acquire(timeout=STOP_TIMEOUT_S):
        try:
            with contextlib.suppress(BrokenPipeError):  # of unwritten data
                process.stdin.close()
        finally:
            sending.release()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(STOP_TIMEOUT_S)
    if process.poll() is None:
        process.kill()
        process.wait()
    with sending, contextlib.suppress(BrokenPipeError):
        process.stdin.close()


class EmulatedBoard:
    """An emulated MEGA in a process of its own, used as a context manager.

    Every event is kept in `trace` (dicts with at least `event`, `t_us` in emulated microseconds, `mono_ns` in
    CLOCK_MONOTONIC nanoseconds); `on_event`, if given, is called for each from the reading thread and must be quick.
    Ends with the context, and when this process dies: the board sees the end of its input.
    """

    def __init__(
        self,
        board: str = "auto",
        *,
        firmware: Path | None = None,
        bootloader: bool | Path = True,
        port_link: Path | None = None,
        fast: bool = False,
        stepped: bool = False,
        on_event: Callable[[Event], None] | None = None,
    ) -> None:
        """Prepare a board; nothing is built or started before `start`.

        firmware: an ELF or Intel hex file; the project's own, freshly built, where it is None. simavr only.
        bootloader: run behind the MEGA's real bootloader, as a new board does, or behind that of an Intel hex file.
        simavr only.
        port_link: where the link to the serial port goes; a temporary folder where it is None.
        fast: run as fast as it can. The board's time-outs then fire early for a host in real time: only emulated
        times (`t_us`) are meaningful.
        stepped: its time advances only in `run`; `modsoft.hil.board.stepped_port` is a serial port for it.
        """
        self.board = choose(board)
        self._firmware = firmware
        self._bootloader = bootloader
        self._folder = None if port_link else tempfile.TemporaryDirectory(prefix="modsoft-board-")
        self._link = Path(self._folder.name) / "ttyMEGA" if self._folder else port_link
        self._pace = ["--fast"] * fast + ["--stepped"] * stepped
        self._on_event = on_event
        self._process: subprocess.Popen[bytes] | None = None
        self._complaint = ""
        self._sending = threading.Lock()
        self._changed = threading.Condition()
        self._duties: list[float] = []
        self._floating: list[bool] = []
        self.trace: list[Event] = []
        self.ready: Event = {}
        self.last_run: Event = {"t_us": 0.0, "from_host": 0, "to_host": 0}  # the last `run`; stepped only
        self.summary: Event = {}

    @property
    def port(self) -> str:
        """Path of the serial port for the host; missing while unplugged."""
        return str(self._link)

    @property
    def clock(self) -> str:
        """Clock of the board's time-outs, for the report."""
        return str(self.ready["clock"])

    @property
    def pid(self) -> int:
        """Process id of the board."""
        return int(self.ready["pid"])

    def start(self) -> EmulatedBoard:
        """Build what is missing and start; return when the serial port exists. `DeviceAbsent` where it cannot."""
        program = build(self.board, firmware=self._firmware is None)
        command = [str(program), "--port-link", str(self._link)]
        if self.board == "simavr":
            command += ["--elf", str(self._firmware or FIRMWARE_ELF)]
            bootloader = BOOTLOADER if self._bootloader is True else self._bootloader
            command += ["--bootloader", str(bootloader)] if bootloader else []
        command += self._pace
        self._stderr = tempfile.TemporaryFile()
        with process_start:
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._stderr, start_new_session=True
            )  # a Ctrl-C at the terminal is for the host; `stop` ends the board
        self._reader = threading.Thread(target=self._read, args=(self._process.stdout,), daemon=True)
        self._reader.start()
        try:
            self.ready = self.wait_for(is_event("ready"), START_TIMEOUT_S)
        except TimeoutError:
            self.stop()
            raise DeviceAbsent(f"the {self.board} board did not start: {self._complaint}") from None
        return self

    def send(self, command: str) -> None:
        """Send the board one command; see the top of board.c. `DeviceAbsent` if it has ended."""
        process = self._process
        if process is None or process.stdin is None:
            raise DeviceAbsent(f"the {self.board} board is not running")
        try:
            with self._sending:
                process.stdin.write(command.encode() + b"\n")
                process.stdin.flush()
        except BrokenPipeError:
            raise DeviceAbsent(f"the {self.board} board has ended") from None

    def run(self, microseconds: int, from_host: int) -> Event:
        """Stepped: let this time pass, as soon as `from_host` bytes in total have arrived from the host."""
        since = len(self.trace)
        self.send(f"run {microseconds} {from_host}")
        self.last_run = self.wait_for(is_event("ran"), RUN_TIMEOUT_S, since)
        return self.last_run

    def duties(self) -> list[float]:
        """The effective duty of each channel now, 0 to 1, in the order of firmware/pins.h."""
        with self._changed:
            return list(self._duties)

    def driven_duties(self) -> list[float | None]:
        """`duties`, with None where the pin is an input now, as from a reset to the start of the firmware."""
        with self._changed:
            pins = zip(self._duties, self._floating, strict=True)
            return [None if floating else duty for duty, floating in pins]

    def millivolt(self, pressure_bar: float) -> int:
        """Voltage of a sensor on this board at a pressure, for the command `adc`."""
        return round(self.ready["sensor_zero_mv"] + pressure_bar * self.ready["sensor_mv_per_bar"])

    def wait_for(self, predicate: Callable[[Event], bool], timeout_s: float, since: int = 0) -> Event:
        """Return the first event in `trace[since:]` that the predicate accepts; `TimeoutError` if none comes.

        Take `since = len(board.trace)` before the cause, to exclude earlier events.
        """
        deadline = time.monotonic() + timeout_s
        with self._changed:
            while True:
                for event in self.trace[since:]:
                    if predicate(event):
                        return event
                since = len(self.trace)
                left = deadline - time.monotonic()
                ended = self._process is not None and self._process.poll() is not None and not self._reader.is_alive()
                if left <= 0 or ended:
                    raise TimeoutError("the board ended" if ended else f"no such event within {timeout_s} s")
                self._changed.wait(min(left, 0.2))

    def stop(self) -> Event:
        """End the board, at once if need be, and return its summary (empty if it gave none)."""
        process, self._process = self._process, None
        if process is None or process.stdin is None or process.stdout is None:
            return self.summary
        end(process, self._sending)  # end of file, as when this process dies
        self._reader.join()
        process.stdout.close()
        self._stderr.seek(0)
        lines = self._stderr.read().decode(errors="replace").strip().splitlines()
        self._complaint = lines[-1] if lines else f"exit code {process.returncode}"
        self._stderr.close()
        if self._folder is not None:
            self._folder.cleanup()
        self.summary = next((event for event in reversed(self.trace) if event["event"] == "summary"), {})
        return self.summary

    def _read(self, lines: IO[bytes]) -> None:
        decode = msgspec.json.Decoder(Event).decode
        for line in lines:
            event = decode(line)
            with self._changed:
                if event["event"] == "ready":
                    self._resize(event["channels"])
                elif event["event"] == "pwm":
                    self._resize(event["channel"] + 1)
                    self._duties[event["channel"]] = event["duty"]
                    self._floating[event["channel"]] = event["floating"]
                self.trace.append(event)
                self._changed.notify_all()
            if self._on_event is not None:
                self._on_event(event)

    def _resize(self, channels: int) -> None:
        missing = channels - len(self._duties)
        self._duties += [0.0] * missing
        self._floating += [True] * missing

    def __enter__(self) -> EmulatedBoard:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        self.stop()
