"""The connection as a state machine: which frames count as a reply, and when a device is given up."""

from __future__ import annotations

import pytest

from modsoft.runtime.board.codec import encode
from modsoft.runtime.board.connection import HEARTBEAT_S, Connection, Phase
from modsoft.runtime.board.protocol import CHANNELS, PROTOCOL_HASH, Hello, HelloReq, Set, State, Status

HELLO = Hello(PROTOCOL_HASH, 1, 7, 1, 11, 0, 800, 3500, 500, 30000, 0, 5000, 10000, 4500, 20000, 300, 1000)
ZERO = (0,) * CHANNELS
IDLE = Status(0, State.IDLE, 0, 7, 1, 0, ZERO, ZERO, 0, 0, 0, 5000)


def ready():
    connection = Connection(0.0)
    connection.feed(encode(HELLO), 0.1)
    assert connection.phase is Phase.READY
    return connection


def armed():
    connection = ready()
    connection.poll(0.1)
    connection.arm(0x3F, 30000)
    connection.poll(0.2)
    connection.feed(encode(IDLE._replace(state=State.ARMED), session=1), 0.21)
    assert (connection.session, connection.armed, connection.busy) == (1, True, False)
    return connection


def test_acknowledgement_of_another_session_is_ignored():
    connection = armed()
    seq = connection.set(Set(1, ZERO))
    connection.poll(0.22)
    status = IDLE._replace(state=State.RUNNING, acked_seq=seq)
    connection.feed(encode(status, session=2), 0.23)
    assert connection.ack_latency_s is None
    connection.feed(encode(status, session=1), 0.24)
    assert connection.ack_latency_s == pytest.approx(0.02)


def test_status_before_hello_is_discarded():
    connection = Connection(0.0)
    connection.feed(encode(IDLE), 0.05)
    assert connection.status is not None
    connection.feed(encode(HELLO), 0.1)
    assert connection.status is None
    assert not connection.vented


def test_second_of_heartbeats_restarts_after_a_gap():
    connection = ready()
    for tenth in range(1, 15):
        connection.poll(0.1 * tenth)
        connection.feed(encode(IDLE), 0.1 * tenth + 0.01)
    assert connection.can_arm
    connection.poll(1.4 + 2.5 * HEARTBEAT_S)
    connection.feed(encode(IDLE), 1.4 + 2.5 * HEARTBEAT_S + 0.01)
    assert not connection.can_arm


def test_another_session_does_not_complete_the_request():
    connection = ready()
    connection.poll(0.1)
    connection.arm(0x3F, 30000)
    connection.poll(0.2)
    connection.feed(encode(IDLE._replace(state=State.ARMED), session=9), 0.21)
    assert not connection.armed
    assert connection.busy


def test_device_of_another_protocol_is_given_up_without_a_reset():
    connection = Connection(0.0)
    for tenth in range(1, 25):
        connection.feed(b"ready > ", 0.1 * tenth)
        assert connection.poll(0.1 * tenth) == b""
        assert connection.phase is Phase.WAITING
    connection.feed(b"ready > ", 2.5)
    connection.poll(2.5)
    assert (connection.phase, connection.lost) == (Phase.LOST, "the device does not use this protocol")
    assert connection.discovery.resets == 0


def test_bytes_before_the_firmware_runs_are_ignored():
    """Part of a frame from before the reset, then silence: the board is reset again."""
    connection = Connection(0.0)
    connection.feed(encode(IDLE)[20:], 0.01)
    connection.poll(2.5)
    assert connection.phase is Phase.WAITING
    connection.poll(3.0)
    assert (connection.phase, connection.discovery.resets, connection.discovery.dtr) == (Phase.WAITING, 1, False)


def test_hello_in_transmission_is_awaited():
    connection = Connection(0.0)
    hello = encode(HELLO)
    connection.feed(hello[:9], 2.49)
    connection.poll(2.5)
    assert connection.phase is Phase.WAITING
    connection.feed(hello[9:], 2.51)
    assert connection.phase is Phase.READY


def test_status_identifies_the_board_after_noise():
    connection = Connection(0.0)
    connection.feed(b"noise", 1.6)
    connection.feed(encode(IDLE), 1.7)
    connection.poll(2.5)
    assert connection.phase is Phase.WAITING


def test_device_that_is_not_a_mega_is_never_reset():
    connection = Connection(0.0, resettable=False)
    assert connection.poll(2.4) == b""
    assert connection.phase is Phase.WAITING
    connection.poll(2.5)
    assert (connection.phase, connection.discovery.resets, connection.discovery.dtr) == (Phase.LOST, 0, True)
    assert connection.discovery.failure is not None
    running = Connection(0.0, resettable=False)
    running.feed(encode(IDLE), 2.4)
    assert running.poll(2.5) == encode(HelloReq(PROTOCOL_HASH))
    running.poll(3.0)
    assert (running.phase, running.discovery.resets) == (Phase.LOST, 0)
