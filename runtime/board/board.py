"""The board at the serial port: its state, and calls that wait for its replies."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from types import TracebackType

import numpy as np
from numpy.typing import ArrayLike

from modsoft.runtime.board.configuration_check import check_board
from modsoft.runtime.board.connection import STATUS_SILENCE_S, Connection, Phase
from modsoft.runtime.board.discovery import HELLO_WAIT_S, RESETS
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
    fault_names,
    refusal,
    to_bar,
    to_units,
)
from modsoft.runtime.errors import DeviceAbsent, LostInRun, ProtocolMismatch, Tripped
from modsoft.runtime.robot import Robot

ARM_WAIT_S = 4.0  # a second of heartbeats, after the ramp of a vent
ARM_RETRY_S = 0.1
# Faults of a board whose previous host disconnected; nothing to repair.
HOST_DISCONNECTED = Fault.LINK_TIMEOUT | Fault.CONTROL_TIMEOUT
VENT_WAIT_S = 3.0
LOST_VENT_WAIT_S = 6.0  # a board in its bootloader restarts after up to 5 s of silence
CLEAR_WAIT_S = 1.0
DOWN_WAIT_S = 1.0  # for the pressures to decay, after the valves are at 0


class Board:
    """A board that has sent HELLO in this version's protocol. As a context manager it vents and closes on exit.

    port: an open serial port. name: for messages. clock: monotonic seconds. threaded: False serves the port in the
    calls that wait, instead of in a thread, for tests on virtual time. resettable: False for a device that is known
    not to be a MEGA and must not be reset through DTR.
    Raises `DeviceAbsent` without a HELLO, `ProtocolMismatch` for another protocol.
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
        self._connection = Connection(clock(), resettable)
        self._io_thread = IoThread(port, self._connection, clock, threaded)
        self._p_max = 0
        self._listened = False
        try:
            self._await_hello()
        except BaseException:
            self._io_thread.close()
            raise

    @classmethod
    def open(cls, name: str, baud: int = 250000) -> Board:
        """Open the port `name` exclusively and wait for the HELLO of the board.

        Raises `DeviceAbsent`, `PortBusy` and `ProtocolMismatch`.
        """
        return cls(open_port(name, baud), name, resettable=may_be_mega(name))

    # ---- state

    @property
    def hello(self) -> Hello:
        """HELLO of the board: identity and configuration."""
        assert self._connection.hello is not None
        return self._connection.hello

    @property
    def status(self) -> Status | None:
        """The last STATUS; None before the first."""
        return self._connection.status

    @property
    def status_age_s(self) -> float:
        """Seconds since the last STATUS."""
        return self._clock() - self._connection.status_at

    @property
    def applied_bar(self) -> np.ndarray:
        """Set-points (channels,) of the valves, bar; NaN before the first STATUS."""
        return self._bar("applied")

    @property
    def measured_bar(self) -> np.ndarray:
        """Measured pressures (channels,), bar; NaN for channels without a sensor."""
        return self._bar("measured")

    def _bar(self, field: str) -> np.ndarray:
        status = self._connection.status
        if status is None:
            return np.full(CHANNELS, np.nan)
        return np.array([math.nan if units == NOT_MEASURED else to_bar(units) for units in getattr(status, field)])

    @property
    def ack_latency_s(self) -> float | None:
        """Seconds from sending the last set-points to their acknowledgement; None before it."""
        return self._connection.ack_latency_s

    @property
    def lost(self) -> str | None:
        """Reason why the board is lost, or None."""
        return self._connection.lost

    @property
    def statistics(self) -> dict[str, int]:
        """Counts since opening: bytes, bad_frames, refused, sets, missed_acks."""
        with self._io_thread.changed:
            return dict(self._connection.counts)

    def check(self) -> None:
        """Raise `LostInRun` if the connection is lost on either side, `Tripped` if the board latched a fault."""
        if self._connection.lost is not None:
            raise LostInRun(
                f"board at {self.name} lost: {self._connection.lost}; it vents by itself, check the cable and restart"
            )
        status = self._connection.status
        if status is not None and status.faults == Fault.LINK_TIMEOUT:
            raise LostInRun(f"the board at {self.name} received nothing in time and vented by itself; start again")
        if status is not None and status.faults:
            cause = fault_names(status.faults)
            if status.faults & Fault.SUPPLY:
                supply_v, least_v = status.supply_mv / 1000, self.hello.supply_least_mv / 1000
                cause += f" (supply now {supply_v:.2f} V, expected at least {least_v:g} V)"
            raise Tripped(f"the board vented by itself: {cause}; remove the cause and start again")

    # ---- requests

    def arm(self, robot: Robot) -> None:
        """Compare the board with the robot file and open a session for the robot's channels; it remains vented.

        A time-out fault of a previous host is cleared first. Raises `ProtocolMismatch` if board and robot file differ,
        `Tripped` on any other latched fault, `LostInRun`.
        """
        channels = check_board(self.hello, robot, self.name)
        deadline = self._clock() + ARM_WAIT_S
        self._io_thread.wait(lambda: self._connection.status is not None, deadline)
        if self.status is not None and self.status.faults and not self.status.faults & ~HOST_DISCONNECTED:
            self.clear_fault()
        nack = None
        while True:
            self._io_thread.wait(lambda: self._connection.can_arm, deadline)
            self.check()
            with self._io_thread.changed:
                self._connection.arm(channels, self.hello.p_full)
            self._io_thread.wait(lambda: not self._connection.busy, deadline)
            self.check()
            status = self.status
            if status is not None and status.state == State.ARMED and self._connection.armed:
                self._p_max = self.hello.p_max
                return
            nack = self._connection.refused or nack  # the last attempt may end without a reply
            if nack is not None and nack.reason not in (NackReason.STATE, NackReason.PRESSURE):
                raise ProtocolMismatch(f"board at {self.name} refused to arm: {refusal(nack)}")
            if self._clock() >= deadline:
                self._check_no_pressure(nack and nack.reason)
                state = State(status.state).name if status is not None and status.state in set(State) else "unknown"
                raise Tripped(f"board at {self.name} did not arm within {ARM_WAIT_S:.0f} s, its state is {state}")
            self._io_thread.wait(lambda: False, self._clock() + ARM_RETRY_S)

    def _check_no_pressure(self, refusal_reason: int | None) -> None:
        if refusal_reason == NackReason.PRESSURE:
            pressures = ", ".join(f"channel {c}: {bar:.3f}" for c, bar in self._pressures_left().items())
            raise Tripped(
                f"board at {self.name} did not arm: the sensors measure {pressures} bar, expected less than "
                f"{to_bar(self.hello.p_down):g}; vent these chambers, or correct the sensors' zero, then start again"
            )

    def set_pressures(self, tick: int, pressures_bar: ArrayLike) -> int:
        """Send the set-points (channels,), bar, of this tick; returns after 2 ms at most, with the sequence number.

        Missing channels are set to 0 (vented). Raises `Tripped` for a pressure out of range, ValueError for a wrong
        shape, and what `check` raises.
        """
        self.check()
        pressures = np.array(pressures_bar, dtype=np.float64, ndmin=1)
        if pressures.ndim != 1 or len(pressures) > CHANNELS:
            raise ValueError(f"pressures of shape {pressures.shape}, expected (channels,), at most {CHANNELS}")
        values = pressures.tolist()  # for twelve values, lists are much faster than arrays
        if not all(math.isfinite(value * UNITS_PER_BAR) for value in values):
            raise Tripped(f"set-points {values} bar are not all finite; none is sent")
        units = [to_units(value) for value in values]
        if any(not 0 <= value <= self._p_max for value in units):
            raise Tripped(f"set-points {values} bar, expected 0 to {to_bar(self._p_max):g} bar; none is sent")
        padded = tuple(units) + (0,) * (CHANNELS - len(units))
        return self._io_thread.send_and_wait(lambda: self._connection.set(Set(tick & 0xFFFFFFFF, padded)))

    def publish_tick(self, tick: int) -> None:
        """Set the tick of the heartbeats, for a tick without set-points."""
        with self._io_thread.changed:
            self._connection.tick = tick & 0xFFFFFFFF

    def vent(self, mode: VentMode = VentMode.RAMP, timeout_s: float = VENT_WAIT_S) -> bool:
        """Vent and wait; True only if the board reported that all valves are at 0.

        A lost board vents by its own timer; nothing is sent to it, only its reports are awaited.
        """
        since = self._clock()
        with self._io_thread.changed:
            if self._connection.phase is Phase.READY:
                self._connection.vent(mode)
                self._io_thread.wake()
        if self._connection.phase is Phase.READY:
            self._io_thread.wait(lambda: self._reported_vented(since), self._clock() + timeout_s)
        if self._connection.phase is Phase.LOST:
            since = self._connection.lost_at  # a later report is still valid: no set-points were sent
            if not self._listened:
                self._listened = True  # once: nothing more is expected
                self._io_thread.wait(lambda: self._reported_vented(since), self._clock() + LOST_VENT_WAIT_S)
        return self._reported_vented(since)

    def _reported_vented(self, since: float) -> bool:
        return self._connection.vented and self._connection.status_at >= since and not self._connection.busy

    def residual_pressures_bar(self) -> dict[int, float]:
        """Pressures, bar, of the channels that are still under pressure a second after venting.

        Returns as soon as there are none; empty if the last STATUS is too old.
        """
        self._io_thread.wait(lambda: not self._pressures_left(), self._clock() + DOWN_WAIT_S)
        return {} if self._io_thread.closed or self.status_age_s > STATUS_SILENCE_S else self._pressures_left()

    def _pressures_left(self) -> dict[int, float]:
        measured_bar = self.measured_bar
        channels = np.flatnonzero(measured_bar >= to_bar(self.hello.p_down))
        return {int(channel): float(measured_bar[channel]) for channel in channels}

    def clear_fault(self, mask: int | None = None) -> bool:
        """Clear exactly these faults (None: all that are latched) and return whether none is left. The board refuses
        while a channel is under pressure."""
        status = self.status
        if mask is None:
            mask = status.faults if status is not None else 0
        with self._io_thread.changed:
            self._connection.clear_fault(mask)
        self._io_thread.wait(lambda: not self._connection.busy, self._clock() + CLEAR_WAIT_S)
        return self.status is not None and self.status.faults == 0

    def close(self) -> bool:
        """Vent, unless vented, and close the port. Returns whether the board reported that it is vented."""
        vented = self._connection.phase is Phase.READY and self._connection.vented
        try:
            return vented or self.vent()
        finally:
            self._io_thread.close()

    def __enter__(self) -> Board:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    # ---- the port

    def _await_hello(self) -> None:
        deadline = self._clock() + (HELLO_WAIT_S + 1) * (RESETS + 1)
        self._io_thread.wait(lambda: self._connection.phase is not Phase.WAITING, deadline)
        if self._connection.foreign_hash is not None:
            raise ProtocolMismatch(
                f"the board at {self.name} uses protocol {self._connection.foreign_hash:08x}, expected "
                f"{PROTOCOL_HASH:08x}: flash the firmware of this version (make -C firmware flash PORT={self.name})"
            )
        if self._connection.phase is Phase.READY:
            return
        if self._connection.discovery.failure is None:
            raise DeviceAbsent(f"board at {self.name}: {self._connection.lost}")
        received, resets = self._connection.counts["bytes"], self._connection.discovery.resets
        what = f"received {received} bytes of another protocol: wrong baud rate?" if received else "no byte received"
        after = f" after {resets} resets" if resets else ""
        raise DeviceAbsent(
            f"no board found at {self.name}{after} ({what}); give another port, or flash the firmware "
            f"(make -C firmware flash PORT={self.name}); if it stopped during a run, its bootloader may reset "
            "repeatedly: remove its power and see docs/hardware.md"
        )
