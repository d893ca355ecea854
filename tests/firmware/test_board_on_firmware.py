"""The host's `Board` connected to the firmware's source, on one virtual clock."""

from __future__ import annotations

import numpy as np
import pytest

from modsoft.runtime import robot as robot_file
from modsoft.runtime.board import codec, protocol
from modsoft.runtime.board.board import Board
from modsoft.runtime.board.protocol import Fault, State, VentMode
from modsoft.runtime.errors import DeviceAbsent, LostInRun, ProtocolMismatch, RobotFileError, Tripped

BOOT_MS = 840  # the bootloader's window after a reset, as measured on the emulated MEGA
BOOTLOADER_MS = 4800  # its duration after it received a byte


class VirtualPort:
    """A port that is connected to a native board; reading advances the time, one millisecond a step."""

    def __init__(self, make_board, reset_on_open=True, firmware=True):
        self.make_board = make_board
        self.board = make_board(boot_id=1, start_ms=0)
        self.firmware = firmware
        self.now_ms = 0
        self.boots_at = 0 if not reset_on_open else BOOT_MS
        self.resets = 0
        self.pending = b""
        self.written = []  # (ms, bytes)
        self.bytes_to_bootloader = 0
        self.receives_nothing = self.sends_nothing = self.unplugged = False
        self.follows = True
        self._dtr = True
        self.is_open = True

    def clock(self):
        return self.now_ms / 1000

    def reset(self):
        self.resets += 1
        self.boots_at = self.now_ms + BOOT_MS
        self.board = self.make_board(boot_id=1 + self.resets, start_ms=0)

    def step(self):
        self.now_ms += 1
        if self.now_ms < self.boots_at or not self.firmware:
            return
        self.board.now_ms += 1
        self.board.update()
        if self.follows:
            self.board.follow()
        sent = self.board.drain()
        self.pending += b"" if self.sends_nothing else sent

    def run(self, milliseconds):
        """Advance the board while the host does nothing."""
        for _ in range(milliseconds):
            self.step()

    # ---- interface of pyserial

    @property
    def in_waiting(self):
        self._check()
        return len(self.pending)

    def read(self, size=1):
        self._check()
        for _ in range(5):
            if self.pending:
                break
            self.step()
        data, self.pending = self.pending[:size], self.pending[size:]
        return data

    def write(self, data):
        self._check()
        self.written.append((self.now_ms, data))
        if self.now_ms < self.boots_at:
            self.bytes_to_bootloader += 1
            self.boots_at = self.now_ms + BOOTLOADER_MS
        elif self.firmware and not self.receives_nothing:
            self.board.feed(data)

    def _check(self):
        if self.unplugged:
            raise OSError("device reports readiness to read but returned no data")

    @property
    def dtr(self):
        return self._dtr

    @dtr.setter
    def dtr(self, level):
        if level and not self._dtr:
            self.reset()
        self._dtr = level

    def open(self):
        self.is_open = True

    def close(self):
        self.is_open = False

    def count(self, table):
        """Return how often a message was sent."""
        identifier = codec.message_id(table)
        frames = [frame for _, data in self.written for frame in codec.Parser().feed(data)]
        return sum(codec.message_id(type(frame.message)) == identifier for frame in frames)


@pytest.fixture
def port(new_board):
    return VirtualPort(new_board)


@pytest.fixture
def rig(port):
    return connect(port), port


def connect(port):
    return Board(port, "virtual", clock=port.clock, threaded=False)


ROBOT = robot_file.load("pneumatic-3")
HALF = np.full(6, 0.2)


def changed(old, new):
    text = robot_file.text_of("pneumatic-3")
    assert old in text
    return robot_file.parse(text.replace(old, new, 1))


def run(board, port, seconds, pressures=HALF, first_tick=1, hz=2.5):
    """Run a correct control loop; return the next tick."""
    for tick in range(first_tick, first_tick + round(seconds * hz)):
        board.set_pressures(tick, pressures)
        until = port.clock() + 1 / hz
        while port.clock() < until:
            board._io_thread.pump()
    return first_tick + round(seconds * hz)


def test_run_arms_follows_set_points_and_vents(rig):
    board, port = rig
    assert port.board.state == State.IDLE
    board.arm(ROBOT)
    assert port.board.state == State.ARMED
    assert not any(port.board.counts)
    run(board, port, 20)
    assert port.board.state == State.RUNNING
    assert port.board.applied == [2000] * 6 + [0] * 6
    np.testing.assert_allclose(board.applied_bar[:6], 0.2)
    np.testing.assert_allclose(board.measured_bar[:6], 0.2)
    assert np.all(np.isnan(board.measured_bar[6:]))
    assert 0 < board.ack_latency_s <= 0.006
    assert board.vent()
    assert not any(port.board.counts)
    assert board.close()
    assert not port.is_open
    assert port.board.state == State.IDLE
    assert port.board.faults == 0
    statistics = board.statistics
    assert (statistics["sets"], statistics["missed_acks"], statistics["refused"], statistics["bad_frames"]) == (
        (50, 0, 0, 0)
    )


def test_nothing_is_sent_before_hello(port):
    board = connect(port)
    assert (port.bytes_to_bootloader, port.resets) == (0, 0)
    run_pumps(board, 1)
    assert min(at for at, _ in port.written) >= BOOT_MS


def run_pumps(board, times):
    for _ in range(times):
        board._io_thread.pump()


def test_silent_port_is_reset_three_times_before_error(new_board):
    port = VirtualPort(new_board, firmware=False)
    with pytest.raises(DeviceAbsent, match="no byte received"):
        connect(port)
    assert port.resets == 3
    assert port.written == []
    assert port.now_ms < 13_000
    assert not port.is_open


def test_lost_first_hello_causes_one_reset(port):
    port.sends_nothing = True
    original = port.reset

    def reset():
        original()
        port.sends_nothing = False

    port.reset = reset
    board = connect(port)
    assert (port.resets, board.hello.boot_id, port.bytes_to_bootloader) == (1, 2, 0)


def test_board_that_does_not_reset_on_opening_gets_hello_request(new_board):
    port = VirtualPort(new_board, reset_on_open=False)
    port.run(10_000)
    port.pending = b""
    board = connect(port)
    assert board.hello.boot_id == 1
    assert port.resets == 0
    assert port.count(protocol.HelloReq) == 1
    board.arm(ROBOT)


def test_fault_of_killed_host_is_cleared_only_at_arming(new_board):
    port = VirtualPort(new_board, reset_on_open=False)
    first = connect(port)
    first.arm(ROBOT)
    run(first, port, 1)
    port.run(2000)
    assert port.board.faults == Fault.LINK_TIMEOUT
    port.pending = b""
    second = connect(port)
    assert port.board.state == State.FAULT
    second.arm(ROBOT)
    assert port.board.state == State.ARMED
    run(second, port, 1)
    assert port.board.state == State.RUNNING


def test_fault_with_another_cause_is_not_cleared_at_arming(new_board):
    port = VirtualPort(new_board)
    board = connect(port)
    port.follows = False
    port.board.measured[0] = 9000
    port.run(200)
    port.board.measured[0] = 0
    port.run(200)
    with pytest.raises(Tripped, match="OVER_PRESSURE"):
        board.arm(ROBOT)
    assert port.board.faults == Fault.OVER_PRESSURE


def test_foreign_protocol_is_refused(new_board, monkeypatch):
    port = VirtualPort(new_board)
    monkeypatch.setattr("modsoft.runtime.board.connection.PROTOCOL_HASH", 0x1234)
    with pytest.raises(ProtocolMismatch, match="flash the firmware of this version"):
        connect(port)
    assert port.written == []


def test_noise_is_reported_as_wrong_baud_rate(new_board):
    port = VirtualPort(new_board, firmware=False)
    port.pending = bytes(range(256)) * 4
    with pytest.raises(DeviceAbsent, match="wrong baud rate"):
        connect(port)


@pytest.mark.parametrize(
    ("old", "new", "complaint"),
    [
        ("full_scale_bar = 3.0", "full_scale_bar = 10.0", "valve full scale: .* has 3 bar, the robot file 10"),
        ("p_min_bar = 0.08", "p_min_bar = 0.1", "smallest pressure"),
        ("p_max_bar = 0.35", "p_max_bar = 0.3", "largest pressure"),
        (
            "zero_v = 0.0",
            "zero_v = 0.5",
            "has 0 to 5 V for 0 to 1 bar, the robot file 0.5 to 5 V for 0 to 1 bar; correct",
        ),
        ("full_v = 5.0", "full_v = 4.5", "pressure sensors: .* the robot file 0 to 4.5 V for 0 to 1 bar"),
        ("full_scale_bar = 1.0", "full_scale_bar = 2.0", "pressure sensors: .* the robot file 0 to 5 V for 0 to 2 bar"),
        ("slew_bar_per_s = 2.0", "slew_bar_per_s = 1.0", "has 2 bar/s, the robot file allows 1"),
        ("hz = 2.5", "hz = 1.5", "has 1 s, expected more than 1 s at 1.5 Hz"),
        ("channel = 5", "channel = 11", "channel 11, the board at virtual has channels 0 to 10"),
    ],
)
def test_board_that_does_not_fit_robot_file_is_never_armed(rig, old, new, complaint):
    board, port = rig
    with pytest.raises(ProtocolMismatch, match=complaint):
        board.arm(changed(old, new))
    assert port.count(protocol.Arm) == 0
    assert port.board.state == State.IDLE


def test_sensors_of_robot_file_do_not_matter_to_board_without_sensors(rig):
    board, port = rig
    board._connection.hello = board.hello._replace(sensors=0)
    board.arm(changed("zero_v = 0.0", "zero_v = 0.5"))
    assert port.board.state == State.ARMED


def test_board_under_pressure_is_armed_when_pressure_is_down(rig):
    board, port = rig
    port.follows = False
    port.board.measured[:3] = [600, 499, 2100]
    with pytest.raises(Tripped, match=r"channel 0: 0.060, channel 2: 0.210 bar, expected less than 0.05; vent these"):
        board.arm(ROBOT)
    assert port.board.state == State.IDLE
    port.follows = True
    board.arm(ROBOT)
    assert port.board.state == State.ARMED


def test_low_supply_is_reported_with_its_limit(rig):
    board, port = rig
    board.arm(ROBOT)
    port.board.supply_mv = 4312
    with pytest.raises(Tripped, match=r"SUPPLY \(supply now 4.31 V, expected at least 4.5 V\); remove the cause"):
        run(board, port, 2)
    assert port.board.faults == Fault.SUPPLY


def test_cable_robot_has_nothing_to_arm(rig):
    with pytest.raises(RobotFileError, match="expected one: the board drives valves"):
        rig[0].arm(robot_file.load("cable-4"))


def test_run_continues_after_lost_frames(rig):
    """Every request is repeated; a set-point is not, because the next one replaces it."""
    board, port = rig
    original = port.write
    seen = []

    def write(data):
        seen.append(data)
        if len(seen) % 3 != 0:
            original(data)

    port.write = write
    board.arm(ROBOT)
    tick = run(board, port, 10)
    assert port.board.state == State.RUNNING
    port.write = original
    run(board, port, 2, first_tick=tick)
    assert board.vent()


def test_arming_succeeds_after_lost_answer(rig):
    board, port = rig
    original = port.step
    dropped = []

    def step():
        original()
        if port.board.state == State.ARMED and len(dropped) < 1 and port.pending:
            dropped.append(port.pending)
            port.pending = b""

    port.step = step
    board.arm(ROBOT)
    assert port.board.state == State.ARMED
    assert board.statistics["refused"] == 0
    run(board, port, 1)
    assert port.board.state == State.RUNNING


def test_board_vents_within_670_ms_of_last_byte_of_killed_host(rig):
    board, port = rig
    board.arm(ROBOT)
    run(board, port, 2, pressures=np.full(6, 0.35))
    last_written = port.written[-1][0]
    while any(port.board.counts):
        port.step()
    assert port.now_ms - last_written <= 670
    assert port.board.faults == Fault.LINK_TIMEOUT


def test_fault_after_stop_of_host_is_latched(rig):
    board, port = rig
    board.arm(ROBOT)
    tick = run(board, port, 2)
    port.run(5000)
    run_pumps(board, 5)
    with pytest.raises((Tripped, LostInRun)):
        board.set_pressures(tick, HALF)
    assert port.board.state == State.FAULT
    assert not any(port.board.counts)


def test_board_detects_stopped_control_loop(rig):
    board, port = rig
    board.arm(ROBOT)
    run(board, port, 2)
    stopped_at = port.now_ms
    while any(port.board.counts):
        board._io_thread.pump()  # the I/O thread still runs
    assert port.now_ms - stopped_at <= 1400
    assert port.board.faults == Fault.CONTROL_TIMEOUT
    run_pumps(board, 40)
    with pytest.raises(Tripped, match="CONTROL_TIMEOUT"):
        board.check()
    assert board.vent()


def test_board_keeps_running_while_loop_holds_its_set_points(rig):
    board, port = rig
    board.arm(ROBOT)
    tick = run(board, port, 1)
    for _ in range(10):
        tick += 1
        board.publish_tick(tick)
        run_pumps(board, 80)
    assert port.board.state == State.RUNNING


def test_unplugged_cable_is_loss_without_confirmed_vent(rig):
    board, port = rig
    board.arm(ROBOT)
    tick = run(board, port, 2)
    port.unplugged = True
    board._io_thread.pump()
    with pytest.raises(LostInRun, match="the port failed"):
        board.set_pressures(tick, HALF)
    assert board.vent() is False


def test_board_that_receives_no_frames_vents_and_reports_it(rig):
    board, port = rig
    board.arm(ROBOT)
    run(board, port, 2)
    port.receives_nothing = True
    with pytest.raises(LostInRun):
        run(board, port, 4, first_tick=100)
    assert board.vent()  # by its own timer, and its status reports it
    assert port.board.faults == Fault.LINK_TIMEOUT


def test_three_lost_set_points_end_sending_with_error(rig):
    board, port = rig
    board.arm(ROBOT)
    tick = run(board, port, 2)
    original = port.write
    port.write = lambda data: None if len(data) > 20 else original(data)  # heartbeats pass, set-points do not
    with pytest.raises(LostInRun, match="3 consecutive set-points were not acknowledged"):
        run(board, port, 4, first_tick=tick)
    port.write = original
    silent_from = len(port.written)
    assert board.vent()
    assert len(port.written) == silent_from


def test_refused_set_points_are_reported_as_loss(rig):
    board, port = rig
    board.arm(changed("channel = 5", "channel = 6"))
    with pytest.raises(LostInRun, match=r"not acknowledged \(refused: range\)"):
        run(board, port, 4)  # channel 5 is not armed
    assert board.vent()


def test_board_that_sends_nothing_is_lost(rig):
    board, port = rig
    board.arm(ROBOT)
    run(board, port, 2)
    port.sends_nothing = True
    silent_at = port.now_ms
    while board.lost is None:
        board._io_thread.pump()
    assert "no STATUS from the board" in board.lost
    assert port.now_ms - silent_at <= 460
    assert board.vent() is False  # it vented, but could not report it
    assert not any(port.board.counts)
    listened_until = port.now_ms
    assert board.close() is False
    assert port.now_ms == listened_until  # it does not wait again


def test_board_reset_in_mid_run_is_detected_and_no_more_is_sent(rig):
    board, port = rig
    board.arm(ROBOT)
    run(board, port, 2)
    port.reset()
    reset_at = port.now_ms
    while board.lost is None:
        board._io_thread.pump()
    assert port.now_ms - reset_at <= 1200
    with pytest.raises(LostInRun):
        board.set_pressures(99, HALF)
    run_pumps(board, 10)
    sent = len(port.written)
    assert board.vent()
    assert len(port.written) == sent
    assert port.now_ms - reset_at <= 6000
    assert port.board.state == State.IDLE


def test_waiting_set_point_is_never_sent_to_restarted_board(rig):
    board, port = rig
    board.arm(ROBOT)
    tick = run(board, port, 1)
    sets = port.count(protocol.Set)
    port.reset()
    port.boots_at = port.now_ms + 5
    port.run(20)  # it has sent HELLO, which the host has not read yet
    board.set_pressures(tick, HALF)
    run_pumps(board, 100)
    assert board.lost is not None
    assert port.count(protocol.Set) == sets
    assert not any(port.board.counts)


def test_vent_is_confirmed_only_by_status_after_request(rig):
    """A status that was sent before the request proves nothing: the board may have been armed since."""
    board, port = rig
    port.run(110)
    assert port.pending
    assert board.vent()
    requested_ms = max(
        at
        for at, data in port.written
        for frame in codec.Parser().feed(data)
        if isinstance(frame.message, protocol.Vent)
    )
    assert port.now_ms - 1e3 * board.status_age_s > requested_ms


def test_open_valve_is_reported_as_residual_pressure(rig):
    board, port = rig
    board.arm(ROBOT)
    run(board, port, 2)
    port.follows = False  # the sensors keep showing 0.2 bar
    port.board.measured[1:6] = [0] * 5
    assert board.vent()
    began_ms = port.now_ms
    assert board.residual_pressures_bar() == pytest.approx({0: 0.2})
    assert 950 <= port.now_ms - began_ms <= 1100


def test_host_waits_for_vented_robot_no_longer_than_needed(rig):
    board, port = rig
    board.arm(ROBOT)
    run(board, port, 2)
    assert board.vent()
    began_ms = port.now_ms
    assert board.residual_pressures_bar() == {}
    assert port.now_ms - began_ms <= 100


@pytest.mark.parametrize(("p_down", "residual_bar"), [(2000, {0: 0.2}), (2001, {})])
def test_residual_pressure_is_compared_with_limit_of_board(rig, p_down, residual_bar):
    board, port = rig
    board.arm(ROBOT)
    run(board, port, 2)
    board._connection.hello = board.hello._replace(p_down=p_down)
    port.follows = False  # the sensors keep showing 0.2 bar
    port.board.measured[1:6] = [0] * 5
    assert board.vent()
    assert board.residual_pressures_bar() == pytest.approx(residual_bar)


def test_boot_id_shows_restart_between_two_reads(rig):
    board, port = rig
    board.arm(ROBOT)
    run(board, port, 1)
    port.reset()
    port.boots_at = port.now_ms + 50
    run_pumps(board, 100)
    assert "restarted by itself" in board.lost


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e308, -0.01, 0.3501])
def test_no_invalid_set_point_is_sent(rig, bad):
    board, port = rig
    board.arm(ROBOT)
    run(board, port, 1)
    sets = port.count(protocol.Set)
    with pytest.raises(Tripped):
        board.set_pressures(99, [0.1, bad])
    run_pumps(board, 5)
    assert port.count(protocol.Set) == sets


def test_set_pressures_takes_one_dimension(rig):
    board, _ = rig
    board.arm(ROBOT)
    with pytest.raises(ValueError, match="shape"):
        board.set_pressures(1, np.zeros((3, 2)))
    with pytest.raises(ValueError, match="shape"):
        board.set_pressures(1, np.zeros(13))


def test_only_newest_set_point_is_sent_and_only_once(rig):
    board, port = rig
    board.arm(ROBOT)
    board.set_pressures(1, np.full(6, 0.1))
    assert board.set_pressures(2, np.full(6, 0.2)) == 2
    run_pumps(board, 10)
    assert port.count(protocol.Set) == 1
    assert board.status.acked_seq == 2


def test_over_pressure_trips_host(rig):
    board, port = rig
    board.arm(ROBOT)
    tick = run(board, port, 1)
    port.follows = False
    port.board.measured[2] = 8000
    with pytest.raises(Tripped, match="OVER_PRESSURE"):
        run(board, port, 2, first_tick=tick)
    assert not any(port.board.counts)
    assert board.clear_fault() is False
    port.board.measured[:6] = [0] * 6
    port.run(2)
    assert board.clear_fault() is True
    board.arm(ROBOT)
    run(board, port, 1, first_tick=100)
    assert port.board.state == State.RUNNING


@pytest.mark.parametrize("mode", list(VentMode))
def test_vent_succeeds_only_after_board_reports_it(rig, mode):
    board, port = rig
    board.arm(ROBOT)
    run(board, port, 2, pressures=np.full(6, 0.35))
    started = port.now_ms
    assert board.vent(mode)
    assert not any(port.board.counts)
    duration_ms = port.now_ms - started
    assert (duration_ms <= 20) if mode is VentMode.DUMP else (175 <= duration_ms <= 300)


def test_vent_reports_failure_when_valves_stay_open(rig):
    board, port = rig
    board.arm(ROBOT)
    run(board, port, 1)
    port.receives_nothing = True
    assert board.vent(timeout_s=0.2) is False


def test_context_manager_vents_on_exception(port):
    def fail():
        with connect(port) as board:
            board.arm(ROBOT)
            run(board, port, 1)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert not any(port.board.counts)
    assert port.board.faults == 0
    assert not port.is_open
