"""A serial port on a stepped emulated board. Host and board share its clock, so the load of the PC has no effect."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable

import serial

from modsoft.hil.board.emulator import EmulatedBoard, process_start

STEP_US = 5000  # a read of the runtime's port waits 5 ms
BUFFERED_AT_MOST = 2048  # bytes in a pseudo-terminal that no process reads; its buffer is larger
ARRIVES_IN_S = 1.0  # real time


class SteppedPort:
    """The part of a serial port that `modsoft.runtime.board.board.Board` uses; for `threaded=False, clock=port.clock`.

    A read without data lets a step of time pass. Written bytes arrive in the next step; bytes that the board sends in a
    step can be read after it.
    """

    def __init__(
        self,
        board: EmulatedBoard,
        name: str = "",
        baud: int = 250_000,
        on_step: Callable[[float], None] = lambda duration_s: None,
        step_us: int = STEP_US,
    ) -> None:
        """board: started with `stepped`. name: the port's new name, if the board was plugged in again. on_step: called
        after every step with its duration in seconds. step_us: the longest step, of a read without data."""
        self.dtr = True
        self.written: list[tuple[float, bytes]] = []  # (clock, bytes)
        self._board, self._on_step, self.step_us = board, on_step, step_us
        self._port = serial.Serial(name or board.port, baud, timeout=0, exclusive=True)
        self._from_host, self._taken = board.last_run["from_host"], board.last_run["to_host"]

    def clock(self) -> float:
        """Emulated seconds."""
        return float(self._board.last_run["t_us"]) * 1e-6

    def idle(self, seconds: float) -> None:
        """Advances time without reading."""
        left_us = round(seconds * 1e6)
        while left_us > 0:
            self._step(min(left_us, self.step_us))
            left_us -= self.step_us

    @property
    def in_waiting(self) -> int:
        return self._port.in_waiting

    def read(self, size: int = 1) -> bytes:
        if not self.in_waiting:
            self._step(self.step_us)
        data = self._port.read(size)
        self._taken += len(data)
        return data

    def write(self, data: bytes) -> int | None:
        self.written.append((self.clock(), data))
        self._from_host += len(data)
        return self._port.write(data)

    def cancel_read(self) -> None:
        """Does nothing: no other thread reads."""

    def open(self) -> None:
        self._port.open()

    def close(self) -> None:
        with process_start:
            self._port.close()

    def _step(self, microseconds: int) -> None:
        to_host = self._board.run(microseconds, self._from_host)["to_host"]
        in_transit = min(to_host - self._taken, BUFFERED_AT_MOST)
        until_s = time.monotonic() + ARRIVES_IN_S
        with contextlib.suppress(OSError):  # the cable was pulled: the next read or write reports it
            while self.in_waiting < in_transit and time.monotonic() < until_s:
                time.sleep(0)
        self._on_step(microseconds * 1e-6)
