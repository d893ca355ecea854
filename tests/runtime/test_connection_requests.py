"""Requests on the connection: what is repeated, what answers it, what refuses it. Virtual time."""

from __future__ import annotations

import pytest
from board_messages import IDLE, OPEN, ZERO, frames, messages, ready

from modsoft.runtime.board.codec import encode, message_id
from modsoft.runtime.board.protocol import (
    PROTOCOL_HASH,
    Arm,
    ClearFault,
    Heartbeat,
    Nack,
    NackReason,
    Set,
    State,
    Vent,
    VentMode,
)


def running():
    """Armed at time 0 in session 1, with a heartbeat sent."""
    connection = ready()
    connection.arm(0x3F, 30000)
    connection.poll(0.0)
    connection.feed(encode(IDLE._replace(state=State.ARMED), session=1), 0.0)
    assert messages(connection.poll(0.0)) == [Heartbeat(0)]
    assert (connection.armed, connection.session) == (True, 1)
    return connection


@pytest.mark.parametrize(("board_session", "expected"), [(0, 1), (1, 2), (254, 255), (255, 1)])
def test_arm_requests_the_next_session(board_session, expected):
    connection = ready()
    connection.feed(encode(IDLE, session=board_session), 0.1)
    connection.arm(0x3F, 30000)
    assert messages(connection.poll(0.1)) == [Arm(PROTOCOL_HASH, 7, expected, 0x3F, 30000)]


def test_no_status_before_arming_means_the_first_session():
    connection = ready()
    connection.arm(0x3F, 30000)
    assert messages(connection.poll(0.1)) == [Arm(PROTOCOL_HASH, 7, 1, 0x3F, 30000)]


def test_arm_is_sent_four_times_without_heartbeats_then_dropped():
    connection = ready()
    connection.arm(0x3F, 30000)
    assert connection.poll(0.0)
    assert connection.poll(0.0495) == b""
    assert connection.poll(0.05)
    due_s = 0.05
    for _ in range(2):
        assert connection.poll(due_s + 0.0495) == b""
        due_s = due_s + 0.05
        assert isinstance(messages(connection.poll(due_s))[0], Arm)
        assert connection.busy
    assert messages(connection.poll(due_s + 0.05)) == [Heartbeat(0)]
    assert not connection.busy
    assert messages(connection.poll(due_s + 0.1)) == [Heartbeat(0)]


def test_request_carries_sequence_number_and_session():
    connection = running()
    seq = connection.set(Set(1, ZERO))
    connection.poll(0.01)
    connection.vent(VentMode.DUMP)
    assert frames(connection.poll(0.02)) == [(seq, 1, Vent(VentMode.DUMP))]


@pytest.mark.parametrize("state", [State.IDLE, State.FAULT])
def test_session_is_open_only_when_the_board_is_armed(state):
    connection = ready()
    connection.arm(0x3F, 30000)
    connection.poll(0.0)
    connection.feed(encode(IDLE._replace(state=state), session=1), 0.01)
    assert (connection.armed, connection.session, connection.busy) == (False, 0, True)
    connection.feed(encode(IDLE._replace(state=State.RUNNING), session=1), 0.02)
    assert (connection.armed, connection.session, connection.busy) == (True, 1, False)


def test_second_arm_closes_the_session_until_it_is_confirmed():
    connection = running()
    connection.arm(0x3F, 30000)
    assert not connection.armed


@pytest.mark.parametrize(
    "request_it", [lambda connection: connection.vent(VentMode.DUMP), lambda connection: connection.clear_fault(1)]
)
def test_status_before_a_request_is_sent_does_not_answer_it(request_it):
    connection = ready()
    request_it(connection)
    connection.feed(encode(IDLE), 0.0)
    assert connection.busy
    assert len(messages(connection.poll(0.0))) == 2  # and the heartbeat


@pytest.mark.parametrize(
    ("mode", "state", "applied", "done"),
    [
        (VentMode.DUMP, State.IDLE, ZERO, True),
        (VentMode.DUMP, State.FAULT, ZERO, True),
        (VentMode.DUMP, State.IDLE, OPEN, False),
        (VentMode.DUMP, State.RUNNING, ZERO, False),
        (VentMode.DUMP, State.RUNNING, OPEN, False),
        (VentMode.RAMP, State.IDLE, OPEN, True),
        (VentMode.RAMP, State.IDLE, ZERO, True),
        (VentMode.RAMP, State.ARMED, ZERO, False),
    ],
)
def test_vent_is_repeated_until_the_board_has_left_the_session(mode, state, applied, done):
    connection = ready()
    connection.vent(mode)
    for step in range(100):
        now = 0.06 * step
        assert Vent(mode) in messages(connection.poll(now))
        connection.feed(encode(IDLE._replace(state=State.RUNNING, applied=OPEN)), now)
    connection.feed(encode(IDLE._replace(state=state, applied=applied)), 6.0)
    assert connection.busy is not done


def test_vent_replaces_a_set_that_is_not_sent_and_stops_no_heartbeat():
    connection = running()
    connection.set(Set(1, OPEN))
    connection.vent(VentMode.RAMP)
    assert messages(connection.poll(0.1)) == [Vent(VentMode.RAMP), Heartbeat(1)]
    assert connection.counts["sets"] == 0


@pytest.mark.parametrize(
    ("state", "faults", "done"),
    [(State.IDLE, 0, True), (State.IDLE, 1, False), (State.FAULT, 0, False), (State.FAULT, 1, False)],
)
def test_faults_are_cleared_when_the_board_is_idle_without_any(state, faults, done):
    connection = ready()
    connection.clear_fault(0x0003)
    assert messages(connection.poll(0.0)) == [ClearFault(0x0003), Heartbeat(0)]
    connection.feed(encode(IDLE._replace(state=state, faults=faults)), 0.01)
    assert connection.busy is not done


@pytest.mark.parametrize("again", [lambda c: c.arm(0x3F, 30000), lambda c: c.clear_fault(1)])
@pytest.mark.parametrize(
    ("request_it", "table"), [(lambda c: c.arm(0x3F, 30000), Arm), (lambda c: c.clear_fault(1), ClearFault)]
)
def test_refused_request_ends_and_the_next_forgets_the_refusal(request_it, table, again):
    connection = ready()
    request_it(connection)
    connection.poll(0.0)
    nack = Nack(message_id(table), 0, NackReason.STATE)
    connection.feed(encode(nack), 0.01)
    assert (connection.busy, connection.refused, connection.counts["refused"]) == (False, nack, 1)
    connection.feed(encode(nack), 0.02)
    assert connection.counts["refused"] == 2
    again(connection)
    assert (connection.busy, connection.refused) == (True, None)


def test_refusal_of_something_else_or_of_venting_ends_no_request():
    connection = ready()
    connection.vent(VentMode.DUMP)
    connection.poll(0.0)
    for table in (Arm, Vent):
        connection.feed(encode(Nack(message_id(table), 0, NackReason.STATE)), 0.01)
        assert (connection.busy, connection.refused) == (True, None)
    connection.arm(0x3F, 30000)
    connection.feed(encode(Nack(message_id(Vent), 0, NackReason.STATE)), 0.02)
    assert (connection.busy, connection.refused) == (True, None)
    assert connection.missed_acks == 0
