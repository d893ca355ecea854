"""The host's side of the protocol as a state machine: bytes and times in, bytes out; no port, no thread, no clock.

    WAITING --HELLO--> READY --any error--> LOST

WAITING sends nothing at first: the MEGA's bootloader would take the bytes for an upload and wait indefinitely. READY
sends heartbeats, set-points and requests. LOST sends nothing, for the same reason, and because the board vents by its
own timer. LOST is final, so that no outdated set-point is ever sent.
"""

from __future__ import annotations

from enum import Enum

from modsoft.runtime.board.codec import ForeignHello, Parser, WireFrame, encode, message_id
from modsoft.runtime.board.discovery import Discovery
from modsoft.runtime.board.protocol import (
    ARM_AFTER_MS,
    HEARTBEAT_PERIOD_MS,
    PROTOCOL_HASH,
    Arm,
    ClearFault,
    Heartbeat,
    Hello,
    Message,
    Nack,
    ResetCause,
    Set,
    State,
    Status,
    Vent,
    VentMode,
    refusal,
)

STATUS_SILENCE_S = 0.35  # three periods of STATUS and a margin
ACK_WAIT_S = 0.2  # twenty times the usual round-trip time
MISSED_ACKS = 3
RETRY_S = 0.05
RETRIES = 3
HEARTBEAT_S = HEARTBEAT_PERIOD_MS / 1000
TICK_MASK = 0xFFFFFFFF


class Phase(Enum):
    """Phase of a connection."""

    WAITING = "waiting for HELLO"
    READY = "connected"
    LOST = "lost"


class _Request:
    """A message that is repeated until a STATUS shows its effect."""

    def __init__(self, message: Message, retries: float) -> None:
        self.message = message
        self.left = retries + 1
        self.due = 0.0  # immediately


class Connection:
    """A connection to one board. Times are seconds of a monotonic clock.

    resettable: False for a device that is known not to be a MEGA and must not be reset.
    """

    def __init__(self, now: float, resettable: bool = True) -> None:
        self.phase = Phase.WAITING
        self.hello: Hello | None = None
        self.foreign_hash: int | None = None
        self.status: Status | None = None
        self.status_at = now
        self.lost: str | None = None  # the reason
        self.lost_at = now
        self.discovery = Discovery(now, resettable)
        self.ack_latency_s: float | None = None  # of the last SET, after its acknowledgement
        self.missed_acks = 0  # consecutive
        self.refused: Nack | None = None  # reply to the last request, if it was refused
        self.counts = dict.fromkeys(("bytes", "bad_frames", "refused", "sets", "missed_acks"), 0)  # for the log
        self.tick = 0
        self.session = 0
        self.armed = False  # the board opened the requested session
        self.heartbeats_since: float | None = None

        self._parser = Parser()
        self._heartbeat_due = now
        self._board_session = 0
        self._board_tick = self._first_tick = 0  # the board's last one, and its one at the start of the session
        self._seq = 0
        self._set: tuple[int, Set] | None = None
        self._unacked: dict[int, float] = {}
        self._refused_set = ""
        self._request: _Request | None = None

    # ---- requests of the owner

    def set(self, message: Set) -> int:
        """Queue set-points for the next `poll`, in place of those not yet sent. Returns the sequence number."""
        self.tick = message.tick
        self._seq = (self._seq + 1) & 0xFF
        self._set = (self._seq, message)
        self.ack_latency_s = None
        return self._seq

    def arm(self, channels: int, p_full: int) -> None:
        """Request a new session that drives the channels of this mask; READY only."""
        assert self.hello is not None
        self.refused = None
        self.armed = False
        # The board refuses a tick before its last one, which is that of an earlier session.
        self.tick, self._first_tick = 0, self._board_tick
        session = self._board_session % 255 + 1
        self._request = _Request(Arm(PROTOCOL_HASH, self.hello.boot_id, session, channels, p_full), RETRIES)

    def vent(self, mode: VentMode) -> None:
        """Request venting; repeated until the board has left the session."""
        self._set = None
        self._request = _Request(Vent(mode), float("inf"))

    def clear_fault(self, mask: int) -> None:
        """Request to clear exactly these faults."""
        self.refused = None
        self._request = _Request(ClearFault(mask), RETRIES)

    def close(self, reason: str, now: float) -> None:
        """End the connection, for instance after an error of the port."""
        self._lose(reason, now)

    # ---- state of the board

    @property
    def vented(self) -> bool:
        """Whether, by the last STATUS, all valves are at 0 and the board drives none of them."""
        status = self.status
        return status is not None and status.state not in (State.ARMED, State.RUNNING) and not any(status.applied)

    @property
    def busy(self) -> bool:
        """Whether a request is pending."""
        return self._request is not None

    @property
    def can_arm(self) -> bool:
        """Whether the board has received heartbeats for a second, and a margin for one that is lost."""
        wait_s = ARM_AFTER_MS / 1000 + 1.5 * HEARTBEAT_S
        return self.heartbeats_since is not None and self.status_at - self.heartbeats_since >= wait_s

    # ---- bytes in

    def feed(self, data: bytes, now: float) -> None:
        """Process bytes from the port."""
        self.counts["bytes"] += len(data)
        self.discovery.on_bytes(now)
        for frame in self._parser.feed(data):
            if isinstance(frame, ForeignHello):
                self._on_foreign(frame.protocol_hash, now)
                continue
            self._board_session = frame.session
            message = frame.message
            if isinstance(message, Hello):
                self._on_hello(message, now)
            elif isinstance(message, Status):
                self._on_status(message, frame, now)
            elif isinstance(message, Nack):
                self._on_nack(message)
        self.counts["bad_frames"] = self._parser.errors

    def _on_foreign(self, protocol_hash: int, now: float) -> None:
        self.foreign_hash = protocol_hash
        self._lose(f"the board uses protocol {protocol_hash:08x}, expected {PROTOCOL_HASH:08x}", now)

    def _on_hello(self, hello: Hello, now: float) -> None:
        if hello.protocol_hash != PROTOCOL_HASH:
            self._on_foreign(hello.protocol_hash, now)
        elif self.phase is Phase.WAITING:
            self.hello = hello
            self.phase = Phase.READY
            self.status = None  # from before the reset
            self.status_at = self._heartbeat_due = now
        elif self.hello is not None and hello.boot_id != self.hello.boot_id:
            cause = ResetCause(hello.reset_cause).name if hello.reset_cause in set(ResetCause) else "?"
            self._lose(f"the board restarted by itself (reset cause {cause})", now)

    def _on_status(self, status: Status, frame: WireFrame, now: float) -> None:
        self._board_tick = status.tick
        self.status, self.status_at = status._replace(tick=(status.tick - self._first_tick) & TICK_MASK), now
        if self.hello is None:  # in LOST, a status has no effect
            return
        if status.boot_id != self.hello.boot_id:
            self._lose("the board restarted by itself", now)
            return
        if status.acked_seq in self._unacked and frame.session == self.session:
            self.ack_latency_s = now - self._unacked[status.acked_seq]
            self.missed_acks = 0
            sent = list(self._unacked)  # in the order of sending; newer ones remain
            for seq in sent[: sent.index(status.acked_seq) + 1]:
                del self._unacked[seq]
        self._settle(status, frame.session)

    def _settle(self, status: Status, board_session: int) -> None:
        """Drop the request when this STATUS shows its effect."""
        request = self._request
        if request is None or request.due == 0.0:  # not sent yet
            return
        message = request.message
        if isinstance(message, Arm):
            done = board_session == message.new_session and status.state in (State.ARMED, State.RUNNING)
            if done:
                self.session = message.new_session
                self.armed = True
        elif isinstance(message, Vent):
            done = status.state not in (State.ARMED, State.RUNNING)
            if message.mode == VentMode.DUMP:
                done = done and not any(status.applied)
        else:
            done = status.state == State.IDLE and status.faults == 0
        if done:
            self._request = None

    def _on_nack(self, nack: Nack) -> None:
        self.counts["refused"] += 1
        if nack.nacked_type == message_id(Set) and self._unacked.pop(nack.nacked_seq, None) is not None:
            self.missed_acks += 1  # counts as missed: the valves keep the old set-points
            self._refused_set = f" (refused: {refusal(nack)})"
        request = self._request
        if request is not None and nack.nacked_type == message_id(type(request.message)):
            if not isinstance(request.message, Vent):
                self._request = None
                self.refused = nack

    # ---- bytes out

    def poll(self, now: float) -> bytes:
        """Advance to `now` and return the bytes to write."""
        if self.phase is Phase.WAITING:
            out = self.discovery.poll(now, None if self.status is None else self.status_at)
            if self.discovery.failure is not None:
                self._lose(self.discovery.failure, now)
            return out
        if self.phase is Phase.READY:
            self._check_timeouts(now)
        if self.phase is not Phase.READY:
            return b""
        out = self._next_request(now)
        if self._set is not None:
            seq, message = self._set
            self._set = None
            self._unacked[seq] = now
            self.counts["sets"] += 1
            out += encode(message._replace(tick=self._on_wire(message.tick)), seq, self.session)
        # While an ARM is pending, the session number for a heartbeat is unknown.
        arming = self._request is not None and isinstance(self._request.message, Arm)
        if now >= self._heartbeat_due and not arming:
            if self.heartbeats_since is None or now - self._heartbeat_due > HEARTBEAT_S:
                self.heartbeats_since = now  # the board restarts its count after a gap
            self._heartbeat_due = max(self._heartbeat_due + HEARTBEAT_S, now)
            out += encode(Heartbeat(self._on_wire(self.tick)), 0, self.session)
        return out

    def _on_wire(self, tick: int) -> int:
        """The board's tick of a tick of this session."""
        return (self._first_tick + tick) & TICK_MASK

    def _check_timeouts(self, now: float) -> None:
        for seq, sent in list(self._unacked.items()):
            if now - sent > ACK_WAIT_S:
                del self._unacked[seq]
                self.missed_acks += 1
                self.counts["missed_acks"] += 1
        if self.missed_acks >= MISSED_ACKS:
            self._lose(f"{self.missed_acks} consecutive set-points were not acknowledged{self._refused_set}", now)
        elif now - self.status_at > STATUS_SILENCE_S:
            self._lose(f"no STATUS from the board for {now - self.status_at:.2f} s", now)

    def _next_request(self, now: float) -> bytes:
        request = self._request
        if request is None or now < request.due:
            return b""
        if request.left <= 0:
            self._request = None
            return b""
        request.left -= 1
        request.due = now + RETRY_S
        return encode(request.message, self._seq, self.session)

    def _lose(self, reason: str, now: float) -> None:
        if self.phase is not Phase.LOST:
            self.phase = Phase.LOST
            self.lost = reason
            self.lost_at = now
            self._set = self._request = None
            self._unacked.clear()
