"""The conversation as a state machine: what is taken for an answer and what is not."""

from __future__ import annotations

import pytest

from modsoft.runtime.board.connection import HEARTBEAT_S, Connection, Phase
from modsoft.runtime.board.protocol import CHANNELS, PROTOCOL_HASH, Hello, HelloReq, Set, State, Status, encode

HELLO = Hello(PROTOCOL_HASH, 1, 7, 1, 11, 0, 800, 3500, 500, 30000, 20000, 300, 1000)
ZERO = (0,) * CHANNELS
IDLE = Status(0, State.IDLE, 0, 7, 1, 0, ZERO, ZERO, 0, 0, 0, 5000)


def ready():
    link = Connection(0.0)
    link.feed(encode(HELLO), 0.1)
    assert link.phase is Phase.READY
    return link


def armed():
    link = ready()
    link.poll(0.1)
    link.arm(0x3F, 30000)
    link.poll(0.2)
    link.feed(encode(IDLE._replace(state=State.ARMED), session=1), 0.21)
    assert (link.session, link.armed, link.busy) == (1, True, False)
    return link


def test_an_acknowledgement_is_of_this_session():
    link = armed()
    seq = link.set(Set(1, ZERO))
    link.poll(0.22)
    told = IDLE._replace(state=State.RUNNING, acked_seq=seq)
    link.feed(encode(told, session=2), 0.23)
    assert link.ack_latency_s is None
    link.feed(encode(told, session=1), 0.24)
    assert link.ack_latency_s == pytest.approx(0.02)


def test_what_was_said_before_the_announcement_is_forgotten():
    link = Connection(0.0)
    link.feed(encode(IDLE), 0.05)
    assert link.status is not None
    link.feed(encode(HELLO), 0.1)
    assert link.status is None
    assert not link.vented


def test_the_second_of_heartbeats_begins_anew_after_a_gap():
    link = ready()
    for tenth in range(1, 15):
        link.poll(0.1 * tenth)
        link.feed(encode(IDLE), 0.1 * tenth + 0.01)
    assert link.can_arm
    link.poll(1.4 + 2.5 * HEARTBEAT_S)
    link.feed(encode(IDLE), 1.4 + 2.5 * HEARTBEAT_S + 0.01)
    assert not link.can_arm


def test_another_session_is_not_the_one_asked_for():
    link = ready()
    link.poll(0.1)
    link.arm(0x3F, 30000)
    link.poll(0.2)
    link.feed(encode(IDLE._replace(state=State.ARMED), session=9), 0.21)
    assert not link.armed
    assert link.busy


def test_what_talks_another_language_is_given_up_without_a_reset():
    link = Connection(0.0)
    for tenth in range(1, 25):
        link.feed(b"ready > ", 0.1 * tenth)
        assert link.poll(0.1 * tenth) == b""
        assert link.phase is Phase.WAITING
    link.feed(b"ready > ", 2.5)
    link.poll(2.5)
    assert (link.phase, link.gave_up, link.resets) == (Phase.LOST, True, 0)


def test_what_came_before_the_firmware_could_run_says_nothing():
    """Half a frame from before the reset, then silence: our board, whose announcement was lost."""
    link = Connection(0.0)
    link.feed(encode(IDLE)[20:], 0.01)
    link.poll(2.5)
    assert link.phase is Phase.WAITING
    link.poll(3.0)
    assert (link.phase, link.resets, link.dtr) == (Phase.WAITING, 1, False)


def test_an_announcement_that_is_just_coming_in_is_waited_for():
    link = Connection(0.0)
    announcement = encode(HELLO)
    link.feed(announcement[:9], 2.49)
    link.poll(2.5)
    assert link.phase is Phase.WAITING
    link.feed(announcement[9:], 2.51)
    assert link.phase is Phase.READY


def test_a_board_that_was_running_is_ours_whatever_else_came():
    link = Connection(0.0)
    link.feed(b"noise", 1.6)
    link.feed(encode(IDLE), 1.7)
    link.poll(2.5)
    assert link.phase is Phase.WAITING


def test_a_device_that_is_no_mega_is_never_reset():
    link = Connection(0.0, resettable=False)
    assert link.poll(2.4) == b""
    assert link.phase is Phase.WAITING
    link.poll(2.5)
    assert (link.phase, link.gave_up, link.resets, link.dtr) == (Phase.LOST, True, 0, True)
    talking = Connection(0.0, resettable=False)
    talking.feed(encode(IDLE), 2.4)
    assert talking.poll(2.5) == encode(HelloReq(PROTOCOL_HASH))
    talking.poll(3.0)
    assert (talking.phase, talking.resets) == (Phase.LOST, 0)
