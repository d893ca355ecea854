"""The host's end of the wire as a state machine: bytes and times in, bytes out; no port, no thread, no clock.

    WAITING --HELLO--> READY --anything odd--> LOST

WAITING sends nothing: a host that talks at once keeps the MEGA's bootloader listening for an upload for ever. READY
sends heartbeats, set-points and requests. LOST sends nothing more, for the same reason and because silence vents the
board by its own timer; it never leaves LOST, so no set-point that was meant for before is sent after.
"""

from __future__ import annotations

from enum import Enum

from modsoft.runtime.board.protocol import (
    ARM_AFTER_MS,
    HEARTBEAT_PERIOD_MS,
    PROTOCOL_HASH,
    Arm,
    ClearFault,
    Fault,
    ForeignHello,
    Heartbeat,
    Hello,
    HelloReq,
    Message,
    Nack,
    NackReason,
    Parser,
    ResetCause,
    Set,
    State,
    Status,
    Vent,
    VentMode,
    WireFrame,
    encode,
    message_id,
)

HELLO_WAIT_S = 3.0  # then the board is reset through DTR
RESETS = 3
RESET_PULSE_S = 0.1
RUNNING_AFTER_S = 1.5  # the bootloader's window is over by then: a STATUS means the firmware runs and can be asked
STRANGER_AFTER_S = 2.5  # a second after that
STRANGER_TALKS_S = 0.5  # in which our firmware would have said five things
STATUS_SILENCE_S = 0.35  # three at 10 Hz, and a little
ACK_WAIT_S = 0.2  # twenty times the usual round trip
MISSED_ACKS = 3
RETRY_S = 0.05
RETRIES = 3
HEARTBEAT_S = HEARTBEAT_PERIOD_MS / 1000


class Phase(Enum):
    """How far the conversation is."""

    WAITING = "waiting for the board to announce itself"
    READY = "connected"
    LOST = "lost"


class _Request:
    """A message that is repeated until the board's STATUS shows its effect."""

    def __init__(self, message: Message, retries: float) -> None:
        self.message = message
        self.left = retries + 1
        self.due = 0.0  # at once


class Connection:
    """One conversation with one board. Times are seconds of one monotonic clock, `now` never runs backwards.

    resettable: False where the device is known not to be a MEGA, and is not to be reset.
    """

    def __init__(self, now: float, resettable: bool = True) -> None:
        self.phase = Phase.WAITING
        self.hello: Hello | None = None
        self.foreign_hash: int | None = None
        self.status: Status | None = None
        self.status_at = now
        self.lost: str | None = None  # why, in words
        self.lost_at = now
        self.gave_up = False  # nothing announced itself, not even after all resets; or something else talks there
        self.resets = 0  # tried so far
        self.dtr = True  # what the port's DTR line should be; its rising edge resets the board
        self.ack_latency_s: float | None = None  # of the last SET, once it is acknowledged in time
        self.missed_acks = 0  # in a row
        self.refused: Nack | None = None  # the answer to the last request, when it was no
        self.counts = dict.fromkeys(("bytes", "bad_frames", "refused", "sets", "missed_acks"), 0)  # for the log
        self.tick = 0
        self.session = 0
        self.armed = False  # the board opened the session that was asked for last
        self.heartbeats_since: float | None = None

        self._parser = Parser()
        self._asked_at = self._opened_at = now
        self._resettable = resettable
        self._talks_since: float | None = None  # bytes of any kind, from when on the firmware had to be running
        self._pulse_until: float | None = None
        self._heartbeat_due = now
        self._board_session = 0
        self._seq = 0
        self._set: tuple[int, Set] | None = None
        self._unacked: dict[int, float] = {}
        self._refused_set = ""
        self._request: _Request | None = None

    # ---- what the owner asks for

    def set(self, message: Set) -> int:
        """Queue set-points for the next `poll`; one not sent yet is replaced. Returns the sequence number."""
        self.tick = message.tick
        self._seq = (self._seq + 1) & 0xFF
        self._set = (self._seq, message)
        self.ack_latency_s = None
        return self._seq

    def arm(self, channels: int, p_full: int) -> None:
        """Ask for a new session that drives the channels of this mask; READY only."""
        assert self.hello is not None
        self.refused = None
        self.armed = False
        session = self._board_session % 255 + 1
        self._request = _Request(Arm(PROTOCOL_HASH, self.hello.boot_id, session, channels, p_full), RETRIES)

    def vent(self, mode: VentMode) -> None:
        """Ask for venting, again and again until the board says that it left the session."""
        self._set = None
        self._request = _Request(Vent(mode), float("inf"))

    def clear_fault(self, mask: int) -> None:
        """Ask to clear exactly these faults."""
        self.refused = None
        self._request = _Request(ClearFault(mask), RETRIES)

    def close(self, why: str, now: float) -> None:
        """The port failed, or the owner gives up."""
        self._lose(why, now)

    # ---- what the board is known to do

    @property
    def vented(self) -> bool:
        """Whether the board's last word was that every valve is at 0, and will stay there."""
        status = self.status
        return status is not None and status.state not in (State.ARMED, State.RUNNING) and not any(status.applied)

    @property
    def busy(self) -> bool:
        """Whether a request still waits for its effect."""
        return self._request is not None

    @property
    def can_arm(self) -> bool:
        """Whether the board has had its second of heartbeats (and a few more, one may be lost)."""
        wait_s = ARM_AFTER_MS / 1000 + 1.5 * HEARTBEAT_S
        return self.heartbeats_since is not None and self.status_at - self.heartbeats_since >= wait_s

    # ---- bytes in

    def feed(self, data: bytes, now: float) -> None:
        """Take what came from the port."""
        self.counts["bytes"] += len(data)
        if self._talks_since is None and now - self._opened_at >= RUNNING_AFTER_S:
            self._talks_since = now
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
        self._lose(f"the board speaks another protocol ({protocol_hash:08x}, ours is {PROTOCOL_HASH:08x})", now)

    def _on_hello(self, hello: Hello, now: float) -> None:
        if hello.protocol_hash != PROTOCOL_HASH:
            self._on_foreign(hello.protocol_hash, now)
        elif self.phase is Phase.WAITING:
            self.hello = hello
            self.phase = Phase.READY
            self.status = None  # what came before, came from before the reset
            self.status_at = self._heartbeat_due = now
        elif self.hello is not None and hello.boot_id != self.hello.boot_id:
            cause = ResetCause(hello.reset_cause).name if hello.reset_cause in set(ResetCause) else "?"
            self._lose(f"the board restarted by itself (reset cause {cause})", now)

    def _on_status(self, status: Status, frame: WireFrame, now: float) -> None:
        self.status, self.status_at = status, now
        if self.hello is None:  # not announced; once LOST, nothing is left that a status could change
            return
        if status.boot_id != self.hello.boot_id:
            self._lose("the board restarted by itself", now)
            return
        if status.acked_seq in self._unacked and frame.session == self.session:
            self.ack_latency_s = now - self._unacked[status.acked_seq]
            self.missed_acks = 0
            for seq in list(self._unacked):  # in the order they were sent; the newer ones still wait
                del self._unacked[seq]
                if seq == status.acked_seq:
                    break
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
            self.missed_acks += 1  # heard, but no better than unheard: the valves stay at the old set-points
            self._refused_set = f" (refused: {refusal(nack)})"
        request = self._request
        if request is not None and nack.nacked_type == message_id(type(request.message)):
            if not isinstance(request.message, Vent):
                self._request = None
                self.refused = nack

    # ---- bytes out

    def poll(self, now: float) -> bytes:
        """Let time pass; returns what has to be written now."""
        if self.phase is Phase.WAITING:
            return self._wait_for_hello(now)
        if self.phase is Phase.READY:
            self._watch(now)
        if self.phase is not Phase.READY:
            return b""
        out = self._next_request(now)
        if self._set is not None:
            seq, message = self._set
            self._set = None
            self._unacked[seq] = now
            self.counts["sets"] += 1
            out += encode(message, seq, self.session)
        # While an ARM is on its way nobody knows which session a heartbeat would have to name.
        arming = self._request is not None and isinstance(self._request.message, Arm)
        if now >= self._heartbeat_due and not arming:
            if self.heartbeats_since is None or now - self._heartbeat_due > HEARTBEAT_S:
                self.heartbeats_since = now  # the board counts anew after a gap
            self._heartbeat_due = max(self._heartbeat_due + HEARTBEAT_S, now)
            out += encode(Heartbeat(self.tick), 0, self.session)
        return out

    def _wait_for_hello(self, now: float) -> bytes:
        if self._pulse_until is not None:
            if now >= self._pulse_until:
                self._pulse_until = None
                self.dtr = True
                self._asked_at = self._opened_at = now
            return b""
        if (
            self.status is not None
            and now - self._opened_at >= RUNNING_AFTER_S
            and now - self.status_at < HEARTBEAT_S * 2
        ):
            # It never restarted when the port was opened (some adapters do not), so its HELLO is long gone.
            self._opened_at = now  # asked again after the same time
            return encode(HelloReq(PROTOCOL_HASH))
        # A device that runs something else is not made ours by a reset.
        talks = self._talks_since is not None and now - self._talks_since >= STRANGER_TALKS_S
        if self.status is None and (talks or not self._resettable) and now - self._asked_at >= STRANGER_AFTER_S:
            self.gave_up = True
            self._lose("what is there does not speak this protocol", now)
        elif now - self._asked_at >= HELLO_WAIT_S:
            if self.resets == RESETS or not self._resettable:
                self.gave_up = True
                self._lose("nothing announced itself", now)
            else:
                self.resets += 1
                self._talks_since = None
                self.dtr = False
                self._pulse_until = now + RESET_PULSE_S
        return b""

    def _watch(self, now: float) -> None:
        for seq, sent in list(self._unacked.items()):
            if now - sent > ACK_WAIT_S:
                del self._unacked[seq]
                self.missed_acks += 1
                self.counts["missed_acks"] += 1
        if self.missed_acks >= MISSED_ACKS:
            self._lose(f"{self.missed_acks} set-points in a row were not acknowledged{self._refused_set}", now)
        elif now - self.status_at > STATUS_SILENCE_S:
            self._lose(f"no word from the board for {now - self.status_at:.2f} s", now)

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

    def _lose(self, why: str, now: float) -> None:
        if self.phase is not Phase.LOST:
            self.phase = Phase.LOST
            self.lost = why
            self.lost_at = now
            self._set = self._request = None
            self._unacked.clear()


def fault_names(faults: int) -> str:
    """The names in a mask of faults, such as "LINK_TIMEOUT, LEAK"."""
    known = [str(fault.name) for fault in Fault if fault & faults]
    unknown = faults & ~sum(Fault)
    return ", ".join(known + ([f"0x{unknown:04x}"] if unknown else []))


def refusal(nack: Nack) -> str:
    """The reason in a NACK, in words."""
    return NackReason(nack.reason).name.lower() if nack.reason in set(NackReason) else f"reason {nack.reason}"
