"""States, timers, refusals and outputs of the firmware, on virtual time."""

from __future__ import annotations

import ctypes
import zlib

import pytest

from modsoft.runtime.board import cobs, codec, protocol
from modsoft.runtime.board.protocol import ClearFault, Fault, Hello, HelloReq, NackReason, State, Status, Vent, VentMode

FULL = (3500,) * 6


def reason(answers):
    """Return the reason of a refusal, which must be the only answer."""
    (nack,) = answers
    assert isinstance(nack, protocol.Nack)
    return NackReason(nack.reason)


def until_vented(board, limit_ms=2000):
    """Return the milliseconds until every output is 0, without bytes from the host."""
    for elapsed in range(limit_ms):
        if not any(board.applied):
            return elapsed
        board.wait(1)
    raise AssertionError(f"not vented after {limit_ms} ms: {board.applied}")


def test_hello_is_sent_once_at_boot_before_all_else(board):
    first, *rest = [frame.message for frame in board.messages()]
    assert isinstance(first, Hello)
    assert rest == []
    assert first.protocol_hash == protocol.PROTOCOL_HASH
    assert (first.boot_id, first.reset_cause) == (0xB0A4D, protocol.ResetCause.POWER_ON)
    assert (first.firmware_version, first.channels, first.sensors) == (2, 11, 0x3F)
    assert (first.p_min, first.p_max, first.p_down) == (800, 3500, 500)
    assert (first.p_full, first.slew) == (30000, 20000)
    assert (first.sensor_zero_mv, first.sensor_full_mv, first.sensor_full) == (0, 5000, 10000)
    assert first.supply_least_mv == 4500
    assert (first.link_timeout_ms, first.control_timeout_ms) == (300, 1000)
    assert board.state == State.BOOT
    answers = []
    for _ in range(10):
        board.wait(100)
        answers += [frame.message for frame in board.messages()]
    assert board.state == State.IDLE
    assert all(isinstance(answer, Status) for answer in answers)
    assert len(answers) == 10


def test_before_first_pass_no_channel_is_measured(board):
    (status,) = board.send(Vent(VentMode.RAMP))
    assert (status.state, status.measured) == (State.BOOT, (protocol.NOT_MEASURED,) * 12)


def test_status_is_sent_every_100_ms(board):
    for _ in range(3):
        board.messages()
        board.wait(99)
        assert board.messages() == []
        board.wait(1)
        assert len(board.messages()) == 1
    board.library.supervisor_next_byte.restype = ctypes.c_int16
    assert board.library.supervisor_next_byte(board.handle) == -1


def test_hello_is_sent_on_request_while_running(running):
    assert any(isinstance(answer, Hello) for answer in running.send(HelloReq(protocol.PROTOCOL_HASH)))
    assert running.state == State.RUNNING


def test_foreign_hello_request_is_answered_and_refused(board):
    for _ in range(2):
        answers = board.send(HelloReq(protocol.PROTOCOL_HASH ^ 1))
        assert isinstance(answers[0], Hello)
        assert reason(answers[1:]) == NackReason.HASH
        answers = board.send(HelloReq(protocol.PROTOCOL_HASH))
        assert [type(answer) for answer in answers] == [Hello]


def test_status_reports_state_of_board(running):
    running.wait(100)
    status = [frame.message for frame in running.messages()][-1]
    assert status.state == State.RUNNING
    assert status.applied[:6] == (3500, 800, 800, 2000, 800, 800)
    assert status.measured == (3500, 800, 800, 2000, 800, 800) + (protocol.NOT_MEASURED,) * 6
    assert status.tick == running.tick
    assert status.acked_seq == running.seq
    assert status.uptime_ms == running.now_ms
    assert status.boot_id == 0xB0A4D
    assert status.supply_mv == 5000
    assert (status.rx_bad, status.rx_refused) == (0, 0)


def test_status_counts_received_frames(running):
    def counted():
        running.messages()
        running.wait(100)
        status = [frame.message for frame in running.messages()][-1]
        return [status.rx_good, status.rx_bad, status.rx_refused]

    before = counted()
    for _ in range(3):
        running.send(protocol.Heartbeat(running.tick))
    running.send(ClearFault(0))  # nothing to clear: refused
    running.feed(b"\x05\x05\0" + b"\0")  # the second delimiter ends no frame
    assert [after - earlier for after, earlier in zip(counted(), before, strict=True)] == [4, 1, 1]


def test_frames_are_numbered(board):
    frames = []
    for _ in range(256):
        board.wait(100)
        frames += board.messages()
    assert [frame.seq for frame in frames] == [*range(256), 0]


def test_every_pass_reports_every_check(running):
    running.wait(1)
    assert running.update() == 31


# ---- arming


def test_arm_needs_heartbeats_for_one_second(board):
    board.heartbeats(1000)
    board.now_ms -= 1
    assert reason(board.arm()) == NackReason.STATE
    board.now_ms += 1
    board.arm()
    assert board.state == State.ARMED
    assert board.counts == [0] * 12


def test_arm_needs_at_least_one_heartbeat(board):
    """Also shortly after the boot, where "no heartbeat yet" must differ from "a heartbeat at 0 ms"."""
    board.wait(1)
    assert reason(board.arm()) == NackReason.STATE
    board.wait(1500)
    assert reason(board.arm()) == NackReason.STATE


@pytest.mark.parametrize(("gap_ms", "state"), [(300, State.ARMED), (301, State.IDLE)])
def test_arm_needs_unbroken_heartbeats(board, gap_ms, state):
    board.heartbeats(900)  # ends 100 ms after the last heartbeat
    board.wait(gap_ms - 100)
    board.heartbeats(300)
    board.arm()
    assert board.state == state


@pytest.mark.parametrize(("gap_ms", "state"), [(300, State.ARMED), (301, State.IDLE)])
def test_arm_needs_recent_heartbeat(board, gap_ms, state):
    board.heartbeats(1500)
    board.wait(gap_ms - 100)
    board.arm()
    assert board.state == state


def test_session_starts_at_sequence_number_of_its_arm(board):
    board.seq = 200
    board.heartbeats(1100)
    board.arm()
    (status,) = board.set(800)
    assert (status.acked_seq, status.state) == (201, State.RUNNING)


def test_long_wait_before_first_set_point_is_no_control_timeout(board):
    board.heartbeats(1100)
    board.arm()
    board.heartbeats(2000, ticking=False)
    board.set(800, tick=board.tick)
    board.wait(250)
    assert board.state == State.RUNNING


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"protocol_hash": 1}, NackReason.HASH),
        ({"boot_id": 7}, NackReason.SESSION),
        ({"new_session": 2}, NackReason.SESSION),
        ({"new_session": 0}, NackReason.SESSION),
        ({"channels": 0x800}, NackReason.RANGE),
        ({"p_full": 100000}, NackReason.RANGE),
    ],
)
def test_arm_with_wrong_field_is_refused(board, changes, expected):
    board.heartbeats(1100)
    assert reason(board.arm(**changes)) == expected
    assert board.state == State.IDLE


def test_repeated_arm_keeps_session(board):
    board.heartbeats(1100)
    board.arm()
    (again,) = board.arm(new_session=1)
    assert isinstance(again, Status)
    assert board.state == State.ARMED


@pytest.mark.parametrize(("session", "expected"), [(2, NackReason.STATE), (3, NackReason.SESSION)])
def test_arm_for_another_session_while_armed_refused(board, session, expected):
    board.heartbeats(1100)
    board.arm()
    assert reason(board.arm(new_session=session)) == expected
    assert reason(board.set(800, session=session)) == NackReason.SESSION


def test_arm_while_running_and_old_arm_afterwards_are_refused(running):
    assert reason(running.arm()) == NackReason.STATE
    running.send(Vent(VentMode.DUMP))
    running.follow()
    running.heartbeats(1100)
    assert reason(running.arm(new_session=1)) == NackReason.SESSION
    running.arm()
    assert running.state == State.ARMED


def test_arm_refused_before_vented(running):
    running.heartbeats(1000)
    running.send(Vent(VentMode.RAMP))
    assert any(running.applied)
    assert reason(running.arm()) == NackReason.STATE


def test_session_numbers_wrap_and_skip_zero(board):
    for session in [*range(1, 256), 1]:
        board.heartbeats(1000)
        board.arm(new_session=session)
        assert (board.state, board.session) == (State.ARMED, session)
        board.send(Vent(VentMode.DUMP))
        board.messages()


# ---- set-points


def test_outputs_reach_set_points_at_slew_limit(board):
    board.heartbeats(1100)
    board.arm()
    board.set(*FULL)
    worst = 0
    for _ in range(200):
        before = board.applied[0]
        board.wait(1)
        worst = max(worst, board.applied[0] - before)
    assert worst == 20  # 2 bar/s
    assert board.applied == [*FULL, 0, 0, 0, 0, 0, 0]


def test_counts_are_pressure_over_full_scale(running):
    assert running.counts == [round(pressure * 4096 / 30000) for pressure in running.applied]
    for pressure in range(0, 3501, 7):
        running.set(pressure)
        running.heartbeats(100)
        running.follow()
        running.heartbeats(200)
        running.follow()
        assert abs(running.counts[0] - pressure * 4096 / 30000) <= 0.51


@pytest.mark.parametrize("pressures", [(-1,), (3501,), (800, 32767), (0, 0, 0, 0, 0, 0, 800), (0,) * 11 + (800,)])
def test_set_out_of_range_is_refused_entirely(running, pressures):
    before = [running.library.board_set_point(running.handle, channel) for channel in range(12)]
    assert reason(running.set(*pressures)) == NackReason.RANGE
    assert [running.library.board_set_point(running.handle, channel) for channel in range(12)] == before
    assert running.state == State.RUNNING


def test_set_refused_outside_session(board):
    board.heartbeats(1100)
    assert reason(board.set(800)) == NackReason.STATE


def test_set_and_heartbeat_of_another_session_refused(running):
    assert reason(running.set(800, session=2)) == NackReason.SESSION
    assert reason(running.send(protocol.Heartbeat(99), session=0)) == NackReason.SESSION


def test_set_is_accepted_up_to_8_sequence_numbers_ahead(running):
    last = running.seq
    for ahead in (9, 100, 128, 255):
        assert reason(running.set(800, seq=(last + ahead) & 0xFF)) == NackReason.SEQUENCE
    for ahead in (1, 8, 8, 8, 8):
        last = (last + ahead) & 0xFF
        (status,) = running.set(900, seq=last)
        assert status.acked_seq == last


def test_first_set_must_follow_arm(board):
    board.heartbeats(1100)
    board.arm()
    assert reason(board.set(800, seq=0)) == NackReason.SEQUENCE
    assert board.state == State.ARMED
    board.set(800, seq=1)
    assert board.state == State.RUNNING


def test_older_tick_refused(running):
    running.set(800, tick=1000)
    assert reason(running.set(900, tick=999)) == NackReason.SEQUENCE
    running.set(1000, tick=1000, seq=(running.seq + 1) & 0xFF)
    assert running.library.board_set_point(running.handle, 0) == 1000


def test_duplicate_is_acknowledged_but_not_applied_and_feeds_no_timer(running):
    running.set(1000)
    (status,) = running.set(2000, seq=running.seq)
    assert status.acked_seq == running.seq
    assert running.library.board_set_point(running.handle, 0) == 1000
    for _ in range(31):
        running.set(1000, seq=running.seq)
        running.wait(10)
    assert running.faults == Fault.LINK_TIMEOUT


@pytest.mark.parametrize(("start_ms", "ticks"), [(0xFFFFFFFF - 1500, 0), (5, 0xFFFFFFF0)])
def test_clock_and_tick_may_wrap(new_board, start_ms, ticks):
    board = new_board(start_ms=start_ms)
    board.tick = ticks
    board.heartbeats(1100)
    board.arm()
    for _ in range(30):
        board.set(800)
        board.follow()
        board.wait(100)
        board.follow()
    assert (board.state, board.faults) == (State.RUNNING, Fault(0))


# ---- length, type


@pytest.mark.parametrize("extra", [-1, 1])
@pytest.mark.parametrize("message", [protocol.Vent(0), protocol.Heartbeat(1), protocol.Set(1, (0,) * 12)])
def test_wrong_length_refused(running, message, extra):
    whole = cobs.cobs_decode(codec.encode(message, 1, running.session)[1:-1])[:-4]
    body = whole[:-1] if extra < 0 else whole + b"\0"
    running.messages()
    running.feed(b"\0" + with_crc(body) + b"\0")
    assert reason([frame.message for frame in running.messages()]) == NackReason.LENGTH
    assert running.state == State.RUNNING


def test_unknown_type_refused(running):
    for unknown in (0x00, 0x03, 0x7F, 0x81, 0x90, 0xFF):
        running.messages()
        running.feed(b"\0" + with_crc(bytes((unknown, 5, running.session))) + b"\0")
        (frame,) = running.messages()
        assert frame.message == protocol.Nack(unknown, 5, NackReason.TYPE)


def with_crc(body):
    return cobs.cobs_encode(body + zlib.crc32(body).to_bytes(4, "little"))


# ---- timers and faults


def test_lost_host_vents_in_time(running):
    running.heartbeats(100)
    running.wait(200)  # 300 ms after the last heartbeat
    assert running.state == State.RUNNING
    running.wait(1)
    assert (running.state, running.faults) == (State.FAULT, Fault.LINK_TIMEOUT)
    assert running.applied[0] == 3480, "no ramp"
    assert 301 + until_vented(running) <= 670
    assert running.counts == [0] * 12


def test_lost_host_while_armed_is_fault(board):
    board.heartbeats(1100)
    (status,) = board.arm()
    assert status.state == State.ARMED
    board.wait(300)
    assert board.state == State.ARMED
    board.wait(1)
    assert (board.state, board.faults) == (State.FAULT, Fault.LINK_TIMEOUT)


def test_garbage_and_corrupted_frames_do_not_feed_link_timer(running):
    good = codec.encode(protocol.Heartbeat(1000), 0, running.session)
    for _ in range(310):
        running.feed(good[:5] + b"\x55" + good[6:] + b"\xaa\x00")
        running.wait(1)
    assert running.faults == Fault.LINK_TIMEOUT
    running.wait(400)
    running.messages()
    assert isinstance(running.send(HelloReq(protocol.PROTOCOL_HASH))[0], Hello)


def test_heartbeats_of_old_session_do_not_feed_link_timer(running):
    for _ in range(31):
        running.tick += 1
        running.send(protocol.Heartbeat(running.tick), session=0)
        running.wait(10)
    assert running.faults == Fault.LINK_TIMEOUT


def test_stopped_control_loop_vents(running):
    running.set(3500)
    started = running.now_ms
    for _ in range(11):
        running.heartbeats(100, ticking=False)
        running.follow()
    assert running.faults == Fault.CONTROL_TIMEOUT
    assert running.now_ms - started + until_vented(running) <= 1400


@pytest.mark.parametrize(("waited_ms", "state"), [(1000, State.RUNNING), (1001, State.FAULT)])
def test_control_loop_may_stop_for_one_second(running, waited_ms, state):
    running.set(800)
    for _ in range(waited_ms):
        running.wait(1)
        running.follow()
        running.send(protocol.Heartbeat(running.tick))
    assert running.state == state


def test_latched_fault_needs_exact_mask_and_pressures_down(running):
    running.wait(301)
    assert running.faults == Fault.LINK_TIMEOUT
    assert reason(running.set(800)) == NackReason.STATE
    assert reason(running.send(ClearFault(Fault.LINK_TIMEOUT))) == NackReason.STATE  # still ramping
    until_vented(running)
    assert reason(running.send(ClearFault(Fault.LINK_TIMEOUT))) == NackReason.STATE  # sensors still show pressure
    for channel in range(6):
        running.measured[:6] = [499] * 6
        running.measured[channel] = 500
        running.wait(1)
        assert reason(running.send(ClearFault(Fault.LINK_TIMEOUT))) == NackReason.STATE
    running.measured[:6] = [499] * 6
    running.wait(1)
    for mask in (0, Fault.LINK_TIMEOUT | Fault.LEAK, Fault.CONTROL_TIMEOUT):
        assert reason(running.send(ClearFault(mask))) == NackReason.RANGE
    running.send(ClearFault(Fault.LINK_TIMEOUT))
    assert (running.state, running.faults) == (State.IDLE, Fault(0))
    assert reason(running.set(800)) == NackReason.STATE


def test_faults_accumulate_and_are_cleared_together(running):
    running.wait(301)
    running.measured[:6] = [4501] * 6
    running.wait(100)
    both = Fault.LINK_TIMEOUT | Fault.OVER_PRESSURE
    assert running.faults == both
    running.measured[:6] = [0] * 6
    running.wait(1)
    assert reason(running.send(ClearFault(Fault.OVER_PRESSURE))) == NackReason.RANGE
    running.send(ClearFault(both))
    assert running.state == State.IDLE


def test_clear_fault_without_fault_refused(running):
    assert reason(running.send(ClearFault(0))) == NackReason.STATE


def test_over_pressure_dumps(running):
    running.measured[3] = 4501
    running.wait(99)
    assert running.state == State.RUNNING
    running.wait(1)
    assert running.faults == Fault.OVER_PRESSURE
    assert running.counts == [0] * 12


def test_short_over_pressure_is_no_fault(running):
    for _ in range(5):
        running.measured[3] = 4501
        running.wait(99)
        running.measured[3] = 2000
        running.wait(1)
        running.send(protocol.Heartbeat(running.tick))
    assert running.faults == Fault(0)


def test_over_pressure_during_stall_of_any_length_dumps(board):
    """The next pass comes after 65.6 s, which 16 bits of milliseconds would count as 50 ms."""
    board.wait(1)
    board.measured[0] = 9000
    board.now_ms += 0x10000 + 50
    board.update()
    assert board.faults == Fault.OVER_PRESSURE


def test_over_pressure_is_detected_while_idle_and_stays_latched(board):
    board.measured[0] = 9000
    board.wait(200)
    assert board.faults == Fault.OVER_PRESSURE
    assert reason(board.send(ClearFault(Fault.OVER_PRESSURE))) == NackReason.STATE


@pytest.mark.parametrize(("reading", "fault"), [(1499, Fault.LEAK), (2501, Fault.SENSOR)])
def test_sensor_that_does_not_follow_output_is_fault(running, reading, fault):
    running.measured[3] = reading
    running.heartbeats(1900)
    running.send(protocol.Heartbeat(running.tick + 1))
    running.wait(99)
    assert running.state == State.RUNNING
    running.wait(1)
    assert running.faults == fault


@pytest.mark.parametrize("reading", [1500, 2500])
def test_small_sensor_difference_is_no_fault(running, reading):
    running.measured[3] = reading
    running.heartbeats(5000)
    assert (running.state, running.faults) == (State.RUNNING, Fault(0))


def test_pressure_at_limit_is_no_over_pressure(board):
    board.measured[0] = 4500
    board.wait(500)
    assert board.faults == Fault(0)


def test_over_pressure_counts_from_first_pass(new_board):
    """The time before the first reading does not count as over-pressure."""
    board = new_board(start_ms=50_000)
    board.measured[0] = 9000
    board.wait(99)
    assert board.faults == Fault(0)
    board.wait(1)
    assert board.faults == Fault.OVER_PRESSURE


def test_channels_without_sensor_cause_no_fault(board):
    board.heartbeats(1100)
    board.arm(channels=0x7FF)
    board.set(*(800,) * 11)
    for _ in range(30):
        board.heartbeats(100)
        board.follow()
    assert board.state == State.RUNNING


def test_channels_outside_session_cause_no_leak(board):
    board.heartbeats(1100)
    board.arm(channels=0x03)
    board.set(800, 800)
    board.measured[:6] = [800, 800, 4000, 4000, 4000, 4000]
    board.heartbeats(5000)
    assert board.state == State.RUNNING


# ---- venting


@pytest.mark.parametrize("session", [0, 77])
def test_vent_ramps_from_any_session(running, session):
    (status,) = running.send(Vent(VentMode.RAMP), session=session)
    assert status.state == State.IDLE
    assert status.applied[0] == 3500
    assert 160 <= until_vented(running) <= 180


@pytest.mark.parametrize("mode", [VentMode.DUMP, 200])
def test_dump_is_immediate(running, mode):
    (status,) = running.send(Vent(mode))
    assert status.applied == (0,) * 12


def test_vent_in_fault_stays_in_fault(running):
    running.wait(301)
    (status,) = running.send(Vent(VentMode.DUMP))
    assert (status.state, status.faults) == (State.FAULT, Fault.LINK_TIMEOUT)
    assert status.applied == (0,) * 12


def test_no_set_point_opens_valve_while_idle(board):
    board.heartbeats(1100)
    for seq in range(256):
        board.set(*FULL, seq=seq, session=seq)
        board.wait(1)
        assert board.counts == [0] * 12


@pytest.mark.parametrize(("taken", "refusals"), [(11, 4), (10, 3)])
def test_queue_to_host_accepts_255_bytes(board, taken, refusals):
    """A full ring buffer would look like an empty one: 256 bytes must not be queued."""
    first = b"".join(bytes([board.library.supervisor_next_byte(board.handle)]) for _ in range(taken))
    board.feed(codec.encode(Vent(VentMode.RAMP)) * 2)
    board.feed((b"\0" + with_crc(bytes((0x7F, 9, 0))) + b"\0") * 4)
    raw = first + board.drain()
    kinds = [type(frame.message) for frame in codec.Parser().feed(raw)]
    assert kinds == [Hello, Status, Status] + [protocol.Nack] * refusals
    nack_size = len(raw) - raw.rindex(b"\0\0") - 1
    assert len(raw) - taken + (4 - refusals) * nack_size == 266 - taken  # with the last refusal


def test_board_never_waits_for_host_that_does_not_read(board):
    board.start(800)
    for _ in range(100):
        board.feed(codec.encode(HelloReq(protocol.PROTOCOL_HASH), 0, board.session))
        board.feed(codec.encode(protocol.Heartbeat(board.tick + 1), 0, board.session))
        board.tick += 1
        board.wait(100)
        board.follow()
    assert board.state == State.RUNNING
    board.parser = codec.Parser()
    assert board.messages()  # complete frames only


def test_clear_fault_is_answered_immediately(running):
    running.wait(400)  # no frames: the link timer
    until_vented(running)
    running.measured[:6] = [0] * 6
    running.wait(1)
    running.messages()
    (answer,) = running.send(ClearFault(running.faults))
    assert isinstance(answer, Status)
    assert (answer.state, answer.faults) == (State.IDLE, 0)


def test_every_frame_of_board_carries_session(board):
    sessions = []
    for _ in range(3):
        board.heartbeats(1100)
        board.arm()
        board.messages()
        board.wait(100)
        sessions += [frame.session for frame in board.messages()]
        board.send(Vent(VentMode.RAMP))
    assert sessions == [1, 2, 3]


@pytest.mark.parametrize(("channel", "fault"), [(3, Fault.SENSOR), (2, Fault(0)), (4, Fault(0))])
def test_only_channels_of_robot_can_disagree(board, channel, fault):
    """Armed for channel 3 only: the sensors of its neighbours belong to no chamber of the robot."""
    board.heartbeats(1100)
    board.arm(channels=1 << 3)
    board.set(0, 0, 0, 1000)
    for _ in range(40):
        board.heartbeats(100)
        board.follow()
        board.measured[channel] += 1500
    assert board.faults == fault


@pytest.mark.parametrize(("units", "expected"), [(499, State.ARMED), (500, State.IDLE)])
@pytest.mark.parametrize("channel", [0, 5])
def test_arm_refused_while_sensor_measures_pressure(board, channel, units, expected):
    board.heartbeats(1100)
    board.measured[channel] = units
    board.update()
    answers = board.arm()
    assert board.state == expected
    if expected == State.IDLE:
        assert reason(answers) == NackReason.PRESSURE


@pytest.mark.parametrize(("units", "faulty"), [(-1, True), (0, False), (-2500, True)])
def test_sensor_below_its_range_is_fault_in_any_state(board, units, faulty):
    """With 0 to 5 V sensors a negative pressure cannot be read; with 0.5 to 4.5 V it is a broken wire."""
    board.heartbeats(1100)
    board.measured[4] = units
    board.wait(99)
    assert board.faults == Fault(0)
    board.wait(1)
    assert board.faults == (Fault.SENSOR if faulty else Fault(0))


def test_sensor_above_its_range_is_fault(board):
    board.measured[4] = 10000
    board.wait(101)
    assert board.faults == Fault.OVER_PRESSURE
    board.measured[4] = 10001
    board.wait(100)
    assert board.faults == Fault.OVER_PRESSURE | Fault.SENSOR


def test_broken_wire_ramps_pressures_down(running):
    running.measured[0] = -1
    running.wait(100)
    assert running.faults == Fault.SENSOR
    assert any(running.applied), "a dump"
    running.measured[0] = 0
    assert until_vented(running) <= 200


def test_brief_sensor_glitches_are_no_fault(running):
    for _ in range(20):
        running.measured[0] = -1
        running.wait(50)
        running.measured[0] = running.applied[0]
        running.heartbeats(100)
    assert running.faults == Fault(0)


@pytest.mark.parametrize("supply_mv", [4499, 0])
def test_low_supply_ramps_pressures_down(running, supply_mv):
    running.supply_mv = supply_mv
    running.wait(99)
    assert running.state == State.RUNNING
    running.wait(1)
    assert (running.state, running.faults) == (State.FAULT, Fault.SUPPLY)
    assert any(running.applied), "a dump"
    assert until_vented(running) <= 200


def test_lowest_allowed_supply_is_no_fault(running):
    running.supply_mv = 4500
    running.heartbeats(1000)
    running.supply_mv = 4499
    running.wait(99)
    running.supply_mv = 4500
    running.wait(1)
    running.supply_mv = 4499
    running.wait(99)
    assert running.faults == Fault(0)


@pytest.mark.parametrize(("units", "faulty"), [(-1251, True), (-1250, False), (21250, False), (21251, True)])
def test_sensor_with_offset_outside_its_range_is_fault(board45, units, faulty):
    """Below 0.25 V and above 4.75 V the wire is broken."""
    (hello,) = [frame.message for frame in board45.messages()]
    assert (hello.sensor_zero_mv, hello.sensor_full_mv, hello.sensor_full) == (500, 4500, 20000)
    board45.measured[0] = units
    board45.wait(101)
    assert (Fault.SENSOR in board45.faults) == faulty
