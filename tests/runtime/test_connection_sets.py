"""Set-points on the connection: sequence numbers, acknowledgements, and what is counted as missed. Virtual time."""

from __future__ import annotations

import pytest
from board_messages import HELLO, IDLE, ZERO, frames

from modsoft.runtime.board.codec import encode, message_id
from modsoft.runtime.board.connection import Connection, Phase
from modsoft.runtime.board.protocol import Arm, Heartbeat, Nack, NackReason, Set, State, fault_names, refusal

RUNNING = IDLE._replace(state=State.RUNNING)


@pytest.fixture
def connection():
    """In session 9 since time 0."""
    connection = Connection(0.0)
    connection.feed(encode(HELLO, session=8), 0.0)
    connection.arm(0x3F, 30000)
    connection.poll(0.0)
    connection.feed(encode(RUNNING, session=9), 0.0)
    assert (connection.armed, connection.session) == (True, 9)
    connection.poll(0.0)
    return connection


def send(connection, now, tick=1):
    """Queue one set-point and send it; return its sequence number."""
    seq = connection.set(Set(tick, ZERO))
    assert (seq, 9, Set(tick, ZERO)) in frames(connection.poll(now))
    return seq


def acknowledge(connection, seq, now):
    connection.feed(encode(RUNNING._replace(acked_seq=seq), session=9), now)


def refuse(connection, table, seq, now):
    connection.feed(encode(Nack(message_id(table), seq, NackReason.RANGE), session=9), now)


def test_sequence_numbers_count_to_255_and_round_again(connection):
    assert [connection.set(Set(tick, ZERO)) for tick in range(257)] == [*range(1, 256), 0, 1]


def test_set_is_sent_once_and_only_the_newest(connection):
    connection.set(Set(1, ZERO))
    seq = connection.set(Set(2, ZERO))
    assert frames(connection.poll(0.01)) == [(seq, 9, Set(2, ZERO))]
    assert connection.poll(0.02) == b""
    send(connection, 0.03)
    assert connection.counts["sets"] == 2
    assert connection.tick == 1


def test_set_and_heartbeat_are_sent_together(connection):
    seq = connection.set(Set(5, ZERO))
    assert frames(connection.poll(0.1)) == [(seq, 9, Set(5, ZERO)), (0, 9, Heartbeat(5))]


def test_next_set_has_no_acknowledgement_yet(connection):
    acknowledge(connection, send(connection, 0.01), 0.02)
    assert connection.ack_latency_s == pytest.approx(0.01)
    connection.set(Set(2, ZERO))
    assert connection.ack_latency_s is None


def test_acknowledgement_counts_for_all_sets_up_to_its_own(connection):
    send(connection, 0.01, tick=1)
    second = send(connection, 0.02, tick=2)
    send(connection, 0.03, tick=3)
    acknowledge(connection, second, 0.04)
    assert connection.ack_latency_s == pytest.approx(0.02)
    connection.poll(0.2)
    assert connection.counts["missed_acks"] == 0
    connection.poll(0.3)
    assert connection.counts["missed_acks"] == 1  # of the third


def test_set_without_acknowledgement_is_missed_after_a_fifth_of_a_second(connection):
    send(connection, 0.0)
    acknowledge(connection, 77, 0.1)  # of no set that waits
    connection.poll(0.2)
    assert (connection.missed_acks, connection.counts["missed_acks"], connection.ack_latency_s) == (0, 0, None)
    connection.poll(0.205)
    assert (connection.missed_acks, connection.counts["missed_acks"]) == (1, 1)
    connection.poll(0.3)
    assert (connection.missed_acks, connection.counts["missed_acks"]) == (1, 1)


def test_acknowledgement_ends_a_row_of_missed_ones(connection):
    for number in range(5):
        now = 0.5 * number
        send(connection, now)
        send(connection, now + 0.01)
        acknowledge(connection, 77, now + 0.25)
        connection.poll(now + 0.25)
        assert connection.missed_acks == 2
        acknowledge(connection, send(connection, now + 0.26), now + 0.27)
        assert connection.missed_acks == 0
        acknowledge(connection, 77, now + 0.49)
    assert connection.phase is Phase.READY
    assert connection.counts["missed_acks"] == 10


def test_three_missed_acknowledgements_in_a_row_end_the_connection(connection):
    for tick in range(3):
        assert connection.phase is Phase.READY
        send(connection, 0.01 * tick)
    connection.set(Set(4, ZERO))
    assert connection.poll(0.3) == b""
    assert (connection.phase, connection.lost_at) == (Phase.LOST, 0.3)
    assert connection.lost == "3 consecutive set-points were not acknowledged"


def test_refused_set_counts_as_missed_and_names_the_reason(connection):
    for number in range(1, 4):
        seq = send(connection, 0.01 * number)
        for refusals in (1, 2):  # the second is a repetition
            refuse(connection, Set, seq, 0.01 * number)
            assert (connection.missed_acks, connection.counts["refused"]) == (number, 2 * number - 2 + refusals)
    connection.poll(0.05)
    assert connection.lost == "3 consecutive set-points were not acknowledged (refused: range)"
    assert connection.counts["missed_acks"] == 0


def test_refusal_of_another_message_with_the_number_of_a_set_is_not_of_the_set(connection):
    seq = send(connection, 0.01)
    refuse(connection, Arm, seq, 0.02)
    assert connection.missed_acks == 0
    acknowledge(connection, seq, 0.03)
    assert connection.ack_latency_s == pytest.approx(0.02)


def test_end_of_the_connection_is_final(connection):
    seq = send(connection, 0.01)
    connection.set(Set(2, ZERO))
    connection.clear_fault(1)
    connection.close("the port failed", 0.02)
    assert (connection.phase, connection.lost, connection.lost_at) == (Phase.LOST, "the port failed", 0.02)
    assert not connection.busy
    assert connection.poll(0.02) == b""
    acknowledge(connection, seq, 0.03)
    assert connection.ack_latency_s is None
    connection.close("later", 0.04)
    assert (connection.lost, connection.lost_at) == ("the port failed", 0.02)


def test_names_of_faults_and_refusals():
    assert fault_names(0) == ""
    assert fault_names(0x0009) == "LINK_TIMEOUT, LEAK"
    assert fault_names(0x8001) == "LINK_TIMEOUT, 0x8000"
    assert refusal(Nack(0x10, 0, NackReason.SEQUENCE)) == "sequence"
    assert refusal(Nack(0x10, 0, 200)) == "reason 200"


def test_ticks_of_a_second_session_follow_those_of_the_first(connection):
    """The board refuses a tick before its last one."""
    assert connection.status.tick == 0
    connection.feed(encode(RUNNING._replace(tick=40), session=9), 0.1)
    assert connection.status.tick == 40
    for _ in range(2):  # a refused request is repeated
        connection.arm(0x3F, 30000)
    assert connection.tick == 0
    connection.poll(0.2)
    connection.feed(encode(RUNNING._replace(tick=40), session=10), 0.2)
    assert connection.status.tick == 0
    seq = connection.set(Set(3, ZERO))
    assert frames(connection.poll(0.3)) == [(seq, 10, Set(43, ZERO)), (0, 10, Heartbeat(43))]
    connection.feed(encode(RUNNING._replace(tick=43), session=10), 0.3)
    assert connection.status.tick == 3


def test_ticks_go_round_after_the_largest(connection):
    connection.feed(encode(RUNNING._replace(tick=0xFFFFFFFF), session=9), 0.1)
    connection.arm(0x3F, 30000)
    connection.poll(0.2)
    connection.feed(encode(RUNNING._replace(tick=0xFFFFFFFF), session=10), 0.2)
    seq = connection.set(Set(2, ZERO))
    assert (seq, 10, Set(1, ZERO)) in frames(connection.poll(0.3))
    connection.feed(encode(RUNNING._replace(tick=1), session=10), 0.3)
    assert connection.status.tick == 2
