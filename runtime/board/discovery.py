"""The WAITING phase of a `Connection`: until the board sends HELLO, request it or reset the board."""

from __future__ import annotations

from modsoft.runtime.board.codec import encode
from modsoft.runtime.board.protocol import PROTOCOL_HASH, HelloReq

HELLO_WAIT_S = 3.0  # then the board is reset through DTR
RESETS = 3
RESET_PULSE_S = 0.1
RUNNING_AFTER_S = 1.5  # the bootloader has ended by then: a STATUS means that the firmware runs
FOREIGN_AFTER_S = 2.5  # one second later
FOREIGN_BYTES_S = 0.5  # in this time our firmware sends five frames
STATUS_AGE_S = 0.2  # two periods of STATUS: the board is still sending


class Discovery:
    """Requests and resets until the board sends HELLO, without I/O. Times as in `Connection`.

    resettable: False for a device that must not be reset.
    """

    def __init__(self, now: float, resettable: bool) -> None:
        self.resets = 0  # so far
        self.dtr = True  # required level of the port's DTR signal; its rising edge resets the board
        self.failure: str | None = None  # why the device is not the board
        self._resettable = resettable
        self._started_at = self._opened_at = now
        self._foreign_since: float | None = None  # first byte at a time when the firmware must be running
        self._pulse_until: float | None = None

    def on_bytes(self, now: float) -> None:
        """Take note that bytes, of any content, arrived."""
        if self._foreign_since is None and now - self._opened_at >= RUNNING_AFTER_S:
            self._foreign_since = now

    def poll(self, now: float, status_at: float | None) -> bytes:
        """Return the bytes to write now; sets `failure` to give up. status_at: time of the last STATUS, or None."""
        if self._pulse_until is not None:
            if now >= self._pulse_until:
                self._pulse_until = None
                self.dtr = True
                self._started_at = self._opened_at = now
            return b""
        if status_at is not None and now - self._opened_at >= RUNNING_AFTER_S and now - status_at < STATUS_AGE_S:
            # Opening the port did not restart the board (some adapters do not), so its HELLO was sent long ago.
            self._opened_at = now  # repeat after the same time
            return encode(HelloReq(PROTOCOL_HASH))
        foreign = self._foreign_since is not None and now - self._foreign_since >= FOREIGN_BYTES_S
        if status_at is None and (foreign or not self._resettable) and now - self._started_at >= FOREIGN_AFTER_S:
            self.failure = "the device does not use this protocol"  # a reset would not change that
        elif now - self._started_at >= HELLO_WAIT_S:
            if self.resets == RESETS or not self._resettable:
                self.failure = "no HELLO received"
            else:
                self.resets += 1
                self._foreign_since = None
                self.dtr = False
                self._pulse_until = now + RESET_PULSE_S
        return b""
