"""Failure matrix, row 23: what a board must not be armed with is refused by board and host."""

import pytest
from mega_in_run import stepped_host
from output_rises import rises

from modsoft.hil.board.emulator import EmulatedBoard
from modsoft.hil.board.stepped_port import SteppedPort
from modsoft.hil.board.toolchain import missing_packages
from modsoft.runtime import robot as robot_file
from modsoft.runtime.board import connection
from modsoft.runtime.board.codec import Parser, encode
from modsoft.runtime.board.protocol import (
    PROTOCOL_HASH,
    Arm,
    Heartbeat,
    Hello,
    HelloReq,
    Nack,
    NackReason,
    State,
    Status,
)
from modsoft.runtime.errors import ProtocolMismatch

missing = missing_packages("simavr")
pytestmark = pytest.mark.skipif(bool(missing), reason=f"simavr needs {' '.join(missing)}")


def refusals(port):
    """Sends a board, after its second of heartbeats, every message that it must not accept.

    Yields (what is wrong, the NACK's reason or None, the board's state after it).
    """
    parser, heard, heartbeat_s, tick = Parser(), [], float("inf"), 0

    def wait(kind, limit_s=1.0):
        nonlocal heartbeat_s, tick
        until_s = port.clock() + limit_s
        while port.clock() < until_s:
            if port.clock() >= heartbeat_s:
                heartbeat_s, tick = heartbeat_s + 0.1, tick + 1
                port.write(encode(Heartbeat(tick), 0, 0))
            heard.extend(frame.message for frame in parser.feed(port.read(256)))
            matching = [message for message in heard if isinstance(message, kind)]
            if matching:
                heard.clear()
                return matching[0]
        return None

    def answer(message):
        heard.clear()
        port.write(encode(message, 0, 0))
        nack = wait(Nack)
        return nack and nack.reason, wait(Status).state

    hello = wait(Hello, 5.0)
    heartbeat_s = port.clock()
    wait(Hello, 1.3)  # none comes: a second of heartbeats
    right = Arm(PROTOCOL_HASH, hello.boot_id, 1, 0x3F, hello.p_full)
    wrong = [("protocol hash", right._replace(protocol_hash=PROTOCOL_HASH ^ 1 << bit)) for bit in range(32)]
    wrong += [("channels", right._replace(channels=0x3F | 1 << bit)) for bit in range(hello.channels, 16)]
    wrong += [("full scale", right._replace(p_full=hello.p_full ^ 1 << bit)) for bit in range(32)]
    wrong += [("boot id", right._replace(boot_id=hello.boot_id ^ 1 << bit)) for bit in range(32)]
    wrong += [("session", right._replace(new_session=session)) for session in (0, *range(2, 256))]
    wrong += [("protocol hash of HELLO_REQ", HelloReq(PROTOCOL_HASH ^ 1 << bit)) for bit in range(32)]
    for what, message in wrong:
        yield what, *answer(message)
    port.write(encode(right, 0, 0))  # the same message without an error
    wait(Status)  # it may be from just before
    yield "nothing", None, wait(Status).state


REASONS = {
    "protocol hash": NackReason.HASH,
    "protocol hash of HELLO_REQ": NackReason.HASH,
    "channels": NackReason.RANGE,
    "full scale": NackReason.RANGE,
    "boot id": NackReason.SESSION,
    "session": NackReason.SESSION,
}
MISFITS = [
    ("full_scale_bar = 3.0", "full_scale_bar = 10.0"),
    ("p_min_bar = 0.08", "p_min_bar = 0.1"),
    ("p_max_bar = 0.35", "p_max_bar = 0.3"),
    ("slew_bar_per_s = 2.0", "slew_bar_per_s = 1.0"),
    ("channel = 5", "channel = 11"),
]


def test_row_23_channels_or_protocol_hash_differ(matrix_row, monkeypatch):
    with EmulatedBoard("simavr", stepped=True) as emulated:
        *refused, accepted = refusals(SteppedPort(emulated))
        assert rises(emulated.trace) == 0
    for what, reason, state in refused:
        assert (reason, state) == (REASONS[what], State.IDLE), what
    assert accepted == ("nothing", None, State.ARMED)
    with EmulatedBoard("simavr", stepped=True) as emulated:
        host = stepped_host(emulated)
        for old, new in MISFITS:
            text = robot_file.text_of("pneumatic-3")
            assert old in text
            with pytest.raises(ProtocolMismatch):
                host.board.arm(robot_file.parse(text.replace(old, new, 1)))
        host.board.close()
        sent = Parser().feed(b"".join(data for _, data in host.port.written))
        assert not [frame for frame in sent if isinstance(frame.message, Arm)]
        foreign = range(0, 32, 4)
        for bit in foreign:
            emulated.run(1000, 0)  # the board sees the port closed
            monkeypatch.setattr(connection, "PROTOCOL_HASH", PROTOCOL_HASH ^ 1 << bit)
            with pytest.raises(ProtocolMismatch, match="flash the firmware of this version"):
                stepped_host(emulated)
        assert rises(emulated.trace) == 0
    tries = len(refused) + len(MISFITS) + len(foreign)
    matrix_row(
        23,
        fault="channels, limits, session or protocol hash differ",
        tries=tries,
        limit="ARM refused, all",
        worst=f"{tries} of {tries} refused",
        clock="none",
    )
