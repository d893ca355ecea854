"""The connection's limits and times: when it resets, asks, repeats, counts a miss and gives up. Virtual time."""

from __future__ import annotations

import zlib

import pytest
from board_messages import HELLO, IDLE, OPEN, ZERO, frames, messages, ready

from modsoft.runtime.board.cobs import cobs_encode
from modsoft.runtime.board.codec import encode, message_id
from modsoft.runtime.board.connection import Connection, Phase
from modsoft.runtime.board.protocol import PROTOCOL_HASH, Heartbeat, Hello, HelloReq, ResetCause, Set, State

FOREIGN_HASH = 0x0123ABCD


# ---- before HELLO


def test_new_connection_waits_for_hello():
    connection = Connection(5.0)
    assert (connection.phase, connection.discovery.dtr, connection.discovery.resets) == (Phase.WAITING, True, 0)
    assert connection.hello is connection.foreign_hash is connection.status is connection.lost is None
    assert connection.ack_latency_s is connection.refused is connection.heartbeats_since is None
    assert (connection.status_at, connection.lost_at) == (5.0, 5.0)
    assert (connection.tick, connection.session, connection.missed_acks) == (0, 0, 0)
    flags = (
        connection.discovery.failure is not None,
        connection.armed,
        connection.busy,
        connection.can_arm,
        connection.vented,
    )
    assert flags == (False,) * 5
    assert connection.counts == {"bytes": 0, "bad_frames": 0, "refused": 0, "sets": 0, "missed_acks": 0}


def test_silent_board_is_reset_three_times_then_given_up():
    connection, opened = Connection(10.0), 10.0
    for reset in range(1, 4):
        assert connection.poll(opened + 2.99) == b""
        assert (connection.discovery.dtr, connection.discovery.resets) == (True, reset - 1)
        low = opened + 3.0
        assert connection.poll(low) == b""
        assert (connection.discovery.dtr, connection.discovery.resets) == (False, reset)
        assert connection.poll(low + 0.095) == b""
        assert not connection.discovery.dtr
        opened = low + 0.1
        assert connection.poll(opened) == b""
        assert connection.discovery.dtr
    connection.poll(opened + 2.99)
    assert (connection.phase, connection.discovery.failure is not None) == (Phase.WAITING, False)
    assert connection.poll(opened + 3.0) == b""
    assert (connection.phase, connection.discovery.failure is not None, connection.discovery.resets) == (
        Phase.LOST,
        True,
        3,
    )
    assert connection.lost == connection.discovery.failure == "no HELLO received"
    assert connection.lost_at == opened + 3.0


def test_hello_is_requested_periodically_from_a_running_board():
    connection = Connection(10.0)
    connection.feed(encode(IDLE), 11.4)
    assert connection.poll(11.49) == b""
    assert messages(connection.poll(11.5)) == [HelloReq(PROTOCOL_HASH)]
    assert connection.poll(11.5) == b""
    connection.feed(encode(IDLE), 12.9)
    assert connection.poll(12.99) == b""
    assert messages(connection.poll(13.0)) == [HelloReq(PROTOCOL_HASH)]
    assert connection.discovery.resets == 0


@pytest.mark.parametrize(("age_s", "asked"), [(0.19, True), (0.2, False), (0.25, False)])
def test_hello_is_requested_only_from_a_board_that_sends(age_s, asked):
    connection = Connection(-1.6)
    connection.feed(encode(IDLE), 0.0)
    assert bool(connection.poll(age_s)) is asked


def test_wait_for_hello_begins_again_with_a_reset():
    connection = Connection(0.0)
    connection.poll(3.0)
    connection.poll(3.1)
    connection.feed(encode(IDLE), 4.5)
    assert connection.poll(4.55) == b""
    connection.feed(encode(IDLE), 4.61)
    assert messages(connection.poll(4.61)) == [HelloReq(PROTOCOL_HASH)]


def test_bytes_from_before_a_reset_do_not_count_after_it():
    connection = Connection(0.0)
    connection.feed(b"noise", 2.8)
    connection.poll(3.0)
    connection.poll(3.1)
    connection.poll(5.7)
    assert connection.phase is Phase.WAITING
    connection.feed(b"noise", 4.7)
    connection.poll(5.8)
    assert (connection.phase, connection.lost) == (Phase.LOST, "the device does not use this protocol")


@pytest.mark.parametrize(("first_byte_s", "lost"), [(11.49, False), (11.5, True), (12.0, True), (12.04, False)])
def test_other_device_is_detected_after_half_a_second_of_its_bytes(first_byte_s, lost):
    connection = Connection(10.0)
    connection.feed(b"ready > ", first_byte_s)
    connection.poll(12.49)
    assert connection.phase is Phase.WAITING
    connection.poll(12.5)
    assert (connection.phase is Phase.LOST, connection.discovery.failure is not None, connection.discovery.resets) == (
        lost,
        lost,
        0,
    )


# ---- HELLO


def foreign_hello():
    """A HELLO of another layout, of which only the hash can be read."""
    body = bytes((message_id(Hello), 0, 0)) + FOREIGN_HASH.to_bytes(4, "little") + b"newer"
    return b"\0" + cobs_encode(body + zlib.crc32(body).to_bytes(4, "little")) + b"\0"


@pytest.mark.parametrize("hello", [foreign_hello(), encode(HELLO._replace(protocol_hash=FOREIGN_HASH))])
@pytest.mark.parametrize("start", [lambda: Connection(0.0), ready], ids=["waiting", "ready"])
def test_hello_of_another_protocol_ends_the_connection(start, hello):
    connection = start()
    connection.feed(hello, 0.3)
    assert (connection.phase, connection.foreign_hash, connection.lost_at) == (Phase.LOST, FOREIGN_HASH, 0.3)
    assert f"the board uses protocol 0123abcd, expected {PROTOCOL_HASH:08x}" in connection.lost
    assert connection.poll(0.4) == b""


@pytest.mark.parametrize(("cause", "name"), [(ResetCause.WATCHDOG, "WATCHDOG"), (99, "?")])
def test_second_hello_of_another_boot_is_a_restart(cause, name):
    connection = ready()
    connection.feed(encode(HELLO), 0.1)
    assert connection.phase is Phase.READY
    connection.feed(encode(HELLO._replace(boot_id=8, reset_cause=cause)), 0.2)
    assert connection.phase is Phase.LOST
    assert f"reset cause {name}" in connection.lost


def test_hello_after_the_end_changes_nothing():
    connection = Connection(0.0)
    connection.close("closed", 0.1)
    connection.feed(encode(HELLO), 0.2)
    assert (connection.phase, connection.hello, connection.lost) == (Phase.LOST, None, "closed")


# ---- status


def test_status_of_another_boot_is_a_restart():
    connection = ready()
    connection.feed(encode(IDLE._replace(boot_id=8)), 0.1)
    assert (connection.phase, connection.lost) == (Phase.LOST, "the board restarted by itself")


def test_silence_of_the_board_ends_the_connection():
    connection = ready()
    connection.poll(0.35)
    assert connection.phase is Phase.READY
    connection.feed(encode(IDLE), 0.35)
    connection.poll(0.7)
    assert connection.phase is Phase.READY
    assert connection.poll(0.71) == b""
    assert (connection.phase, connection.lost_at) == (Phase.LOST, 0.71)
    assert "0.36 s" in connection.lost


@pytest.mark.parametrize(
    ("state", "applied", "vented"),
    [
        (State.IDLE, ZERO, True),
        (State.FAULT, ZERO, True),
        (State.IDLE, OPEN, False),
        (State.ARMED, ZERO, False),
        (State.RUNNING, ZERO, False),
        (State.RUNNING, OPEN, False),
    ],
)
def test_vented_is_what_the_last_status_confirms(state, applied, vented):
    connection = ready()
    assert connection.vented is False
    connection.feed(encode(IDLE._replace(state=state, applied=applied)), 0.1)
    assert connection.vented is vented


def test_bytes_and_bad_frames_are_counted():
    connection = ready()
    connection.feed(b"\0abc\0", 0.1)
    connection.feed(b"\0abc\0", 0.2)
    assert (connection.counts["bytes"], connection.counts["bad_frames"]) == (len(encode(HELLO)) + 10, 2)


def test_messages_of_a_host_have_no_effect_on_the_connection():
    """A device that echoes what it receives."""
    connection = ready()
    before = (connection.phase, connection.status, connection.status_at, connection.missed_acks)
    connection.feed(encode(Heartbeat(1)) + encode(Set(1, OPEN)), 0.1)
    assert (connection.phase, connection.status, connection.status_at, connection.missed_acks) == before
    assert connection.counts["refused"] == connection.counts["bad_frames"] == 0


# ---- heartbeats


def test_heartbeats_are_sent_every_tenth_of_a_second_with_tick_and_session():
    connection = ready()
    assert frames(connection.poll(0.0)) == [(0, 0, Heartbeat(0))]
    assert connection.poll(0.09995) == b""
    assert frames(connection.poll(0.1)) == [(0, 0, Heartbeat(0))]
    connection.set(Set(41, ZERO))
    connection.poll(0.15)
    assert frames(connection.poll(0.2)) == [(0, 0, Heartbeat(41))]


def test_late_heartbeat_is_made_up_for_once_at_most():
    connection = ready()
    connection.poll(0.0)
    connection.feed(encode(IDLE), 0.3)
    connection.poll(0.35)
    assert sum(bool(connection.poll(0.351 + 0.001 * step)) for step in range(90)) <= 1
    assert connection.poll(0.46)


def test_heartbeats_are_unbroken_up_to_one_lost():
    connection = ready()
    connection.poll(0.0)
    connection.poll(0.2)  # due at 0.1
    assert connection.heartbeats_since == 0.0
    connection.poll(0.31)
    assert connection.heartbeats_since == 0.31


@pytest.mark.parametrize(("status_s", "can_arm"), [(1.1495, False), (1.0 + 1.5 * 0.1, True)])
def test_board_can_be_armed_after_its_second_of_heartbeats(status_s, can_arm):
    connection = ready()
    for tenth in range(12):
        connection.poll(0.1 * tenth)
        connection.feed(encode(IDLE), 0.1 * tenth)
    connection.feed(encode(IDLE), status_s)
    assert connection.heartbeats_since == 0.0
    assert connection.can_arm is can_arm
