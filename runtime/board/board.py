"""The board at the other end of the serial port: what it says of itself, and calls that wait for its answer."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from types import TracebackType

import numpy as np
from numpy.typing import ArrayLike

from modsoft.runtime.board.configuration_check import check_board
from modsoft.runtime.board.connection import (
    HELLO_WAIT_S,
    RESETS,
    STATUS_SILENCE_S,
    Connection,
    Phase,
    fault_names,
    refusal,
)
from modsoft.runtime.board.io_thread import IoThread
from modsoft.runtime.board.ports import Port, may_be_mega, open_port
from modsoft.runtime.board.protocol import (
    CHANNELS,
    NOT_MEASURED,
    PROTOCOL_HASH,
    UNITS_PER_BAR,
    Fault,
    Hello,
    NackReason,
    Set,
    State,
    Status,
    VentMode,
    to_bar,
    to_units,
)
from modsoft.runtime.errors import DeviceAbsent, LostInRun, ProtocolMismatch, Tripped
from modsoft.runtime.robot import Robot

ARM_WAIT_S = 4.0  # a second of heartbeats, and the ramp of a vent before
ARM_AGAIN_S = 0.1
# What a former host leaves behind that went away, on a board that did not restart since; nothing to mend.
GONE_HOST = Fault.LINK_TIMEOUT | Fault.CONTROL_TIMEOUT
VENT_WAIT_S = 3.0
LOST_VENT_WAIT_S = 6.0  # a board in its bootloader needs up to 5 s of silence to come back
CLEAR_WAIT_S = 1.0
DOWN_WAIT_S = 1.0  # for the air to leave, after the valves are at 0


class Board:
    """A board that has announced itself and speaks this protocol. Use as a context manager: leaving vents and closes.

    port: an open serial port. name: for messages. clock: monotonic seconds. threaded: False drives the port from the
    calls that wait instead of a thread of its own, for tests on virtual time. resettable: False for a device that is
    known to be no MEGA, and is not to be reset through DTR.
    Raises `DeviceAbsent` when nothing announces itself, `ProtocolMismatch` when it speaks another protocol.
    """

    def __init__(
        self,
        port: Port,
        name: str = "port",
        clock: Callable[[], float] = time.monotonic,
        threaded: bool = True,
        resettable: bool = True,
    ) -> None:
        self.name = name
        self._clock = clock
        self._link = Connection(clock(), resettable)
        self._line = IoThread(port, self._link, clock, threaded)
        self._p_max = 0
        self._listened = False
        try:
            self._await_hello()
        except BaseException:
            self._line.close()
            raise

    @classmethod
    def open(cls, name: str, baud: int = 250000) -> Board:
        """Open the port called `name` for this program alone and wait until the board there has announced itself.

        Raises `DeviceAbsent`, `PortBusy` and `ProtocolMismatch`, each with what to do.
        """
        return cls(open_port(name, baud), name, resettable=may_be_mega(name))

    # ---- what is known

    @property
    def hello(self) -> Hello:
        """What the board said about itself."""
        assert self._link.hello is not None
        return self._link.hello

    @property
    def status(self) -> Status | None:
        """The board's last word; None before the first."""
        return self._link.status

    @property
    def status_age_s(self) -> float:
        """Seconds since that word."""
        return self._clock() - self._link.status_at

    @property
    def applied_bar(self) -> np.ndarray:
        """(channels,) what the valves are told, bar; NaN before the first STATUS."""
        return self._bar("applied")

    @property
    def measured_bar(self) -> np.ndarray:
        """(channels,) what the sensors read, bar; NaN where there is none."""
        return self._bar("measured")

    def _bar(self, field: str) -> np.ndarray:
        status = self._link.status
        if status is None:
            return np.full(CHANNELS, np.nan)
        return np.array([math.nan if units == NOT_MEASURED else to_bar(units) for units in getattr(status, field)])

    @property
    def ack_latency_s(self) -> float | None:
        """Seconds from the writing of the last set-points to their acknowledgement; None before that."""
        return self._link.ack_latency_s

    @property
    def lost(self) -> str | None:
        """Why the board is lost, or None."""
        return self._link.lost

    @property
    def statistics(self) -> dict[str, int]:
        """Counts since the opening: bytes, bad_frames, refused, sets, missed_acks."""
        with self._line.changed:
            return dict(self._link.counts)

    def check(self) -> None:
        """Raise `LostInRun` when either side lost the other, `Tripped` when the board latched another fault."""
        if self._link.lost is not None:
            raise LostInRun(
                f"board at {self.name} lost: {self._link.lost}; it vents by itself, check the cable and restart"
            )
        status = self._link.status
        if status is not None and status.faults == Fault.LINK_TIMEOUT:
            raise LostInRun(f"the board at {self.name} did not hear from us in time and vented by itself; start again")
        if status is not None and status.faults:
            raise Tripped(f"the board vented by itself: {fault_names(status.faults)}; mend the cause and start again")

    # ---- what is asked

    def arm(self, robot: Robot) -> None:
        """Check the board against the robot file and open a session that drives the robot's channels; still vented.

        A fault that only says that a former host went away is cleared first. Raises `ProtocolMismatch` when board and
        robot file differ, `Tripped` on any other latched fault, `LostInRun`.
        """
        channels = check_board(self.hello, robot, self.name)
        deadline = self._clock() + ARM_WAIT_S
        self._line.wait(lambda: self._link.status is not None, deadline)
        if self.status is not None and self.status.faults and not self.status.faults & ~GONE_HOST:
            self.clear_fault()
        while True:
            self._line.wait(lambda: self._link.can_arm, deadline)
            self.check()
            with self._line.changed:
                self._link.arm(channels, self.hello.p_full)
            self._line.wait(lambda: not self._link.busy, deadline)
            self.check()
            status = self.status
            if status is not None and status.state == State.ARMED and self._link.armed:
                self._p_max = self.hello.p_max
                return
            nack = self._link.refused
            if nack is not None and nack.reason != NackReason.STATE:
                raise ProtocolMismatch(f"board at {self.name} refused to be armed: {refusal(nack)}")
            if self._clock() >= deadline:
                state = State(status.state).name if status is not None and status.state in set(State) else "unknown"
                raise Tripped(f"board at {self.name} did not arm within {ARM_WAIT_S:.0f} s, its state is {state}")
            self._line.wait(lambda: False, self._clock() + ARM_AGAIN_S)

    def set_pressures(self, tick: int, pressures_bar: ArrayLike) -> int:
        """Have the set-points (channels,), bar, of this tick written, 2 ms at most; returns their sequence number.

        A shorter row is filled up with 0 (vented). Raises `Tripped` for a value that is no pressure of this robot, and
        what `check` raises.
        """
        self.check()
        pressures = np.array(pressures_bar, dtype=np.float64, ndmin=1)
        if pressures.ndim != 1 or len(pressures) > CHANNELS:
            raise ValueError(f"pressures of shape {pressures.shape}, expected (channels,), at most {CHANNELS}")
        values = pressures.tolist()  # numbers of Python: for twelve of them much faster than arrays
        if not all(math.isfinite(value * UNITS_PER_BAR) for value in values):
            raise Tripped(f"no set-point is sent that is not a number: {values}")
        units = [to_units(value) for value in values]
        if any(not 0 <= value <= self._p_max for value in units):
            raise Tripped(f"set-points {values} bar leave the range from 0 to {to_bar(self._p_max):g} bar")
        padded = tuple(units) + (0,) * (CHANNELS - len(units))
        return self._line.send_and_wait(lambda: self._link.set(Set(tick & 0xFFFFFFFF, padded)))

    def publish_tick(self, tick: int) -> None:
        """Publish the control loop's counter on a tick that sends no set-points."""
        with self._line.changed:
            self._link.tick = tick & 0xFFFFFFFF

    def vent(self, mode: VentMode = VentMode.RAMP, timeout_s: float = VENT_WAIT_S) -> bool:
        """Vent and wait; True only when the board itself said that every valve is at 0.

        A lost board is sent nothing (its own timer vents it); this then only listens whether it says so.
        """
        since = self._clock()
        with self._line.changed:
            if self._link.phase is Phase.READY:
                self._link.vent(mode)
                self._line.wake()
        if self._link.phase is Phase.READY:
            self._line.wait(lambda: self._reported_vented(since), self._clock() + timeout_s)
        if self._link.phase is Phase.LOST:
            since = self._link.lost_at  # whatever it said from then on still holds: nobody told it to open a valve
            if not self._listened:
                self._listened = True  # once: nothing more will come after that
                self._line.wait(lambda: self._reported_vented(since), self._clock() + LOST_VENT_WAIT_S)
        return self._reported_vented(since)

    def _reported_vented(self, since: float) -> bool:
        return self._link.vented and self._link.status_at >= since and not self._link.busy

    def residual_pressures_bar(self) -> dict[int, float]:
        """Channels whose sensor still measures pressure about a second after the venting, with that pressure, bar.

        Returns as soon as there is none; also where the board's word is too old to tell.
        """
        self._line.wait(lambda: not self._pressed(), self._clock() + DOWN_WAIT_S)
        return {} if self._line.closed or self.status_age_s > STATUS_SILENCE_S else self._pressed()

    def _pressed(self) -> dict[int, float]:
        measured_bar = self.measured_bar
        pressed = np.flatnonzero(measured_bar >= to_bar(self.hello.p_down))
        return {int(channel): float(measured_bar[channel]) for channel in pressed}

    def clear_fault(self, mask: int | None = None) -> bool:
        """Clear exactly these faults (None: all that are latched); True when the board did. It refuses while a sensor
        still shows pressure."""
        status = self.status
        if mask is None:
            mask = status.faults if status is not None else 0
        with self._line.changed:
            self._link.clear_fault(mask)
        self._line.wait(lambda: not self._link.busy, self._clock() + CLEAR_WAIT_S)
        return self.status is not None and self.status.faults == 0

    def close(self) -> bool:
        """Vent, where that is not yet done, and close the port. Returns whether the board said that it is vented."""
        vented = self._link.phase is Phase.READY and self._link.vented
        try:
            return vented or self.vent()
        finally:
            self._line.close()

    def __enter__(self) -> Board:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # ---- the port

    def _await_hello(self) -> None:
        deadline = self._clock() + (HELLO_WAIT_S + 1) * (RESETS + 1)
        self._line.wait(lambda: self._link.phase is not Phase.WAITING, deadline)
        if self._link.foreign_hash is not None:
            raise ProtocolMismatch(
                f"the board at {self.name} speaks protocol {self._link.foreign_hash:08x}, this version speaks "
                f"{PROTOCOL_HASH:08x}: flash the firmware of this version (make -C firmware flash PORT={self.name})"
            )
        if self._link.phase is Phase.READY:
            return
        if not self._link.gave_up:
            raise DeviceAbsent(f"board at {self.name}: {self._link.lost}")
        heard = self._link.counts["bytes"]
        what = f"{heard} bytes came that are not its language: wrong baud rate?" if heard else "not a byte came"
        tried = f", {self._link.resets} resets included" if self._link.resets else ""
        raise DeviceAbsent(
            f"nothing at {self.name} announced itself as our board{tried} ({what}); "
            f"another port, or flash the firmware (make -C firmware flash PORT={self.name})"
        )
