"""A bare host that sends corrupted frames to an emulated MEGA in mid-run, each followed by a valid one."""

import random
import time

import serial

from modsoft.hil.board.emulator import EmulatedBoard, is_event
from modsoft.runtime.board import protocol
from modsoft.runtime.board.codec import Parser, encode
from modsoft.runtime.board.protocol import Arm, ClearFault, Heartbeat, Hello, HelloReq, Set, State, Status, Vent

BAUD = 250_000
HEARTBEAT_S = 0.1
TIMEOUT_S = 10.0
SETTLE_S = 0.3  # 0.35 bar at 2 bar/s, and a status
TRIES_PER_WRITE = 16  # 25 ms of the line


class FrameCorruption:
    """The board runs at `STEADY`: any later change of a valve comes from a frame that was wrongly accepted. The result
    is read from the board's registers and counters, in emulated time."""

    STEADY = (2000,) * 11 + (0,)
    OTHER = (1000,) * 11 + (0,)

    def __init__(self, seed=1):
        self.random = random.Random(seed)
        self.emulated = EmulatedBoard("simavr", bootloader=False)
        self.parser = Parser()
        self.session = self.seq = self.tick = self.valid_count = self.base_valid_count = self.refused_count = 0

    def __enter__(self):
        self.emulated.start()
        self.emulated.send("sensors 20")
        self.port = serial.Serial(self.emulated.port, BAUD, timeout=0.005, exclusive=True)
        self.hello = self.wait_for(Hello)
        for pressures in (self.OTHER, self.STEADY):  # the first session is replayed later
            self.begin_session(pressures)
        self.base = self.status()
        self.base_valid_count = self.valid_count
        self.since = len(self.emulated.trace)
        return self

    def __exit__(self, *error):
        self.port.close()
        self.emulated.stop()

    # ---- valid frames

    def write(self, message, seq=0):
        self.valid_count += 1
        self.port.write(encode(message, seq, self.session))

    def wait_for(self, kind):
        """Returns the next message of this kind."""
        until_s = time.monotonic() + TIMEOUT_S
        while time.monotonic() < until_s:
            for frame in self.parser.feed(self.port.read(256)):
                if isinstance(frame.message, kind):
                    return frame.message
        raise TimeoutError(f"no {kind.__name__} within {TIMEOUT_S} s")

    def begin_session(self, pressures):
        self.write(Vent(1))
        for _ in range(13):
            self.tick += 1
            self.write(Heartbeat(self.tick))
            time.sleep(HEARTBEAT_S)
        self.seq = 0
        self.write(Arm(protocol.PROTOCOL_HASH, self.hello.boot_id, self.session + 1, 0x7FF, self.hello.p_full))
        self.session += 1
        until_s = time.monotonic() + SETTLE_S
        while time.monotonic() < until_s:
            self.write(*self.next_set(pressures))
            time.sleep(HEARTBEAT_S / 2)
        assert self.status().state == State.RUNNING

    def next_set(self, pressures):
        self.tick += 1
        self.seq = (self.seq + 1) & 0xFF
        return Set(self.tick, pressures), self.seq

    def status(self):
        """A STATUS that the board wrote after it received every frame."""
        for _ in range(3):  # frames in transit arrive meanwhile
            self.tick += 1
            self.write(Heartbeat(self.tick))
            time.sleep(HEARTBEAT_S)
        self.write(HelloReq(protocol.PROTOCOL_HASH))
        self.wait_for(Hello)
        return self.wait_for(Status)

    # ---- corrupted frames

    def random_frame(self):
        """A random valid frame with an effect that shows if the board accepts it."""
        message = self.random.choice(
            (
                Set(self.tick + 1, (*(self.random.randrange(3501) for _ in range(11)), 0)),
                Heartbeat(self.tick + 1),
                Vent(self.random.randrange(2)),
                ClearFault(0),
                Arm(protocol.PROTOCOL_HASH, self.hello.boot_id, self.session, 1, 5),
            )
        )
        return encode(message, (self.seq + 1) & 0xFF, self.session)

    def corrupted(self, kind):
        """A frame that is invalid; corruption that leaves it valid is repeated."""
        while True:
            frame = bytearray(self.random_frame())
            for _ in range(self.random.randint(1, 4)):
                at = self.random.randrange(len(frame))
                if kind == "flip":
                    frame[at] ^= 1 << self.random.randrange(8)
                elif kind == "drop":
                    del frame[at]
                elif kind == "insert":
                    frame.insert(at, self.random.randrange(256))
                elif kind == "garbage":
                    frame[:] = self.random.randbytes(len(frame))
            if kind == "truncate":
                del frame[self.random.randrange(len(frame)) :]
            if not Parser().feed(bytes(frame) + b"\0"):
                return bytes(frame)

    def repeated(self):
        """A frame that was valid before, or is valid in another session; counts those that the board must refuse."""
        choice = self.random.randrange(4)
        if choice == 0:  # the sequence number of the last one, with other pressures
            return encode(Set(self.tick, self.OTHER), self.seq, self.session)
        self.refused_count += 1
        if choice == 1:  # an older one
            age = self.random.randint(1, 200)
            return encode(Set(max(0, self.tick - age), self.OTHER), (self.seq - age) & 0xFF, self.session)
        if choice == 2:  # of the session before, with the next sequence number of this one
            step = self.random.randint(1, protocol.SEQUENCE_WINDOW)
            return encode(Set(self.tick + step, self.OTHER), (self.seq + step) & 0xFF, self.session - 1)
        return encode(Heartbeat(self.tick + 1), 0, self.session - 1)

    def send(self, kind, tries):
        """Sends `tries` corrupted frames, each followed by a valid one, at the rate of the line."""
        for done in range(0, tries, TRIES_PER_WRITE):
            block = b""
            for _ in range(min(TRIES_PER_WRITE, tries - done)):
                self.valid_count += 1
                self.tick += 1
                block += self.corrupted(kind) + encode(Heartbeat(self.tick), 0, self.session)
            self.port.write(block)
            self.port.reset_input_buffer()

    def send_repeated(self, tries):
        """Sends `tries` repeated frames, each followed by a new SET, and waits for the answer to each SET, which takes
        twice the SET's own time on the line."""
        for _ in range(tries):
            repeated = self.repeated()
            valid = self.next_set(self.STEADY)
            self.valid_count += 2
            self.port.write(repeated + encode(*valid, self.session))
            while self.wait_for(Status).acked_seq != self.seq:
                pass

    def result(self):
        """accepted, refused: counts minus the expected ones; events: of valves and resets; state."""
        self.parser = Parser()
        self.final = status = self.status()
        return {
            "accepted": self.difference(status.rx_good - self.base.rx_good, self.valid_count - self.base_valid_count),
            "refused": self.difference(status.rx_refused - self.base.rx_refused, self.refused_count),
            "events": [e for e in self.emulated.trace[self.since :] if e["event"] in ("pwm", "reset", "watchdog")],
            "state": State(status.state),
        }

    def counts(self):
        """For the message of a failed test."""
        self.emulated.send("stats")
        statistics = self.emulated.wait_for(is_event("stats"), TIMEOUT_S, self.since)
        late = [event for event in self.emulated.trace[self.since :] if event["event"] == "late"]
        return f"before: {self.base}; after: {self.final}; {self.valid_count} valid sent; {statistics}; late: {late}"

    @staticmethod
    def difference(counted, expected):
        """The difference of two 16-bit counters, with its sign."""
        return (counted - expected + 0x8000) % 0x10000 - 0x8000
