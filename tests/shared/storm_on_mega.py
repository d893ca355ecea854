"""A bare host that sends an emulated MEGA in mid-run one bad frame after the other, each followed by a good one."""

import random
import time

import serial

from modsoft.hil.board.emulator import EmulatedBoard
from modsoft.runtime.board import protocol
from modsoft.runtime.board.protocol import (
    Arm,
    ClearFault,
    Heartbeat,
    Hello,
    HelloReq,
    Parser,
    Set,
    State,
    Status,
    Vent,
    encode,
)

BAUD = 250_000
BEAT_S = 0.1
TIMEOUT_S = 10.0
SETTLE_S = 0.3  # 0.35 bar at 2 bar/s, and a status
TRIES_PER_WRITE = 16  # 25 ms of the line


class Storm:
    """The board runs at `STEADY`; whatever moves a valve from there on was wrongly applied. Judged by the board's own
    registers and counters, so on its own clock."""

    STEADY = (2000,) * 11 + (0,)
    OTHER = (1000,) * 11 + (0,)

    def __init__(self, seed=1):
        self.random = random.Random(seed)
        self.emulated = EmulatedBoard("simavr", bootloader=False)
        self.parser = Parser()
        self.session = self.seq = self.tick = self.good = self.base_good = self.refused = 0

    def __enter__(self):
        self.emulated.start()
        self.emulated.send("sensors 20")
        self.port = serial.Serial(self.emulated.port, BAUD, timeout=0.005, exclusive=True)
        self.hello = self.answer(Hello)
        for pressures in (self.OTHER, self.STEADY):  # the first session is there to be replayed later
            self.begin_session(pressures)
        self.base = self.status()
        self.base_good = self.good
        self.since = len(self.emulated.trace)
        return self

    def __exit__(self, *error):
        self.port.close()
        self.emulated.stop()

    # ---- what a host does

    def write(self, message, seq=0):
        self.good += 1
        self.port.write(encode(message, seq, self.session))

    def answer(self, kind):
        """The next message of this kind."""
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
            time.sleep(BEAT_S)
        self.seq = 0
        self.write(Arm(protocol.PROTOCOL_HASH, self.hello.boot_id, self.session + 1, 0x7FF, self.hello.p_full))
        self.session += 1
        until_s = time.monotonic() + SETTLE_S
        while time.monotonic() < until_s:
            self.write(*self.next_set(pressures))
            time.sleep(BEAT_S / 2)
        assert self.status().state == State.RUNNING

    def next_set(self, pressures):
        self.tick += 1
        self.seq = (self.seq + 1) & 0xFF
        return Set(self.tick, pressures), self.seq

    def status(self):
        """A STATUS that the board wrote after it had taken all that was sent."""
        for _ in range(3):  # what is still on its way arrives meanwhile
            self.tick += 1
            self.write(Heartbeat(self.tick))
            time.sleep(BEAT_S)
        self.write(HelloReq(protocol.PROTOCOL_HASH))
        self.answer(Hello)
        return self.answer(Status)

    # ---- bad frames

    def random_frame(self):
        """Some good frame, whose content would be seen if it were taken."""
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

    def damaged(self, kind):
        """A frame that does not arrive whole: damage that misses all but a delimiter is done again."""
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
        """A frame that was good once or would be in another session; counts those that the board must refuse."""
        choice = self.random.randrange(4)
        if choice == 0:  # the last one again, as if with other pressures
            return encode(Set(self.tick, self.OTHER), self.seq, self.session)
        self.refused += 1
        if choice == 1:  # an older one
            age = self.random.randint(1, 200)
            return encode(Set(max(0, self.tick - age), self.OTHER), (self.seq - age) & 0xFF, self.session)
        if choice == 2:  # of the session before, and just what would come next in this one
            ahead = self.random.randint(1, protocol.SEQUENCE_WINDOW)
            return encode(Set(self.tick + ahead, self.OTHER), (self.seq + ahead) & 0xFF, self.session - 1)
        return encode(Heartbeat(self.tick + 1), 0, self.session - 1)

    def send(self, kind, tries):
        """`tries` damaged frames, each with a good one after it, as fast as the line takes them."""
        for done in range(0, tries, TRIES_PER_WRITE):
            block = b""
            for _ in range(min(TRIES_PER_WRITE, tries - done)):
                self.good += 1
                self.tick += 1
                block += self.damaged(kind) + encode(Heartbeat(self.tick), 0, self.session)
            self.port.write(block)
            self.port.reset_input_buffer()

    def send_repeated(self, tries):
        """`tries` frames that were good once, each with a new SET after it. A SET's answer takes twice its own time on
        the line, so it is waited for."""
        for _ in range(tries):
            bad = self.repeated()
            good = self.next_set(self.STEADY)
            self.good += 2
            self.port.write(bad + encode(*good, self.session))
            while self.answer(Status).acked_seq != self.seq:
                pass

    def judge(self):
        """{taken, refused: beyond what they should be (mod 65536); moved: events of valves, or resets; state}."""
        self.parser = Parser()
        status = self.status()
        return {
            "taken": self.above(status.rx_good - self.base.rx_good, self.good - self.base_good),
            "refused": self.above(status.rx_refused - self.base.rx_refused, self.refused),
            "moved": [e for e in self.emulated.trace[self.since :] if e["event"] in ("pwm", "reset", "watchdog")],
            "state": State(status.state),
        }

    @staticmethod
    def above(counted, expected):
        """The difference of two 16-bit counters, with its sign."""
        return (counted - expected + 0x8000) % 0x10000 - 0x8000
