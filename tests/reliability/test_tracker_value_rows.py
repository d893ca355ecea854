"""Failure matrix, rows 35 to 37: frame rates, port status and RMS error of the tracker, and jumps that stay. On virtual
time."""

import itertools

import numpy as np
import pytest
from virtual_loop import PERIOD_S, ROBOT, World, corrupting, planar_poses

from modsoft.runtime import robot as robot_file
from modsoft.runtime import safety
from modsoft.runtime.errors import LostInRun, Tripped
from modsoft.runtime.safety import FrameValidator
from modsoft.runtime.tracking.frame import TrackerFrame
from modsoft.runtime.tracking.frame_rate import FrameRate

VENT_LIMIT_S = 3 * PERIOD_S + 0.05  # after the last valid frame
RATES_HZ = (10.0, 20.0, 30.0, 40.0, 59.94, 60.0, 60.2, 100.0, 250.0)


def statuses(hz, seconds, rng, delay_s=lambda at_s: 0.0):
    """Times and statuses of all ticks of a device whose rate is learned from requests at 60 Hz."""
    rate, validator, newest = FrameRate(), FrameValidator(ROBOT), None
    good, ticks = planar_poses((1.0, 2.0, 3.0)), itertools.count(500.0, PERIOD_S)
    tick_s, checks = next(ticks), []
    for at_s in np.arange(497.0, 500.0 + seconds, 1 / 60):
        requested_s = at_s + rng.uniform(0.0, 0.012)
        number = int((requested_s - rng.uniform(0.0, 0.02) - delay_s(at_s)) * hz)
        if newest is None or number > newest.device_frame:
            rate.add(number, requested_s)
            newest = TrackerFrame(number, requested_s, good, np.ones(4, bool), np.full(4, 0.1), rate.hz)
        if at_s >= tick_s:
            checks.append((tick_s, validator.check(newest, requested_s + 0.02).status))
            tick_s = next(ticks)
    return checks


def test_row_35_other_frame_rates(matrix_row, full):
    rng, minutes, alarms, ticks = np.random.default_rng(35), 60 if full else 3, 0, 0
    for hz in RATES_HZ:
        checked = [status for _, status in statuses(hz, 60.0 * minutes, rng)]
        alarms, ticks = alarms + len(checked) - checked.count("good"), ticks + len(checked)
    matrix_row(
        35,
        fault=f"none: frame rates of {RATES_HZ[0]:g} to {RATES_HZ[-1]:g} Hz, learned",
        tries=ticks,
        limit="no false alarm",
        worst=alarms,
        clock="virtual",
    )
    assert alarms == 0
    slowest_s, tries = 0.0, 0
    for hz, from_s in itertools.product(RATES_HZ, rng.uniform(500.0, 590.0, 10 if full else 2)):
        checked = statuses(hz, from_s - 500.0 + 20.0, rng, lambda at_s, from_s=from_s: 0.6 if at_s > from_s else 0.0)
        assert all(status == "good" for at_s, status in checked if at_s < from_s)
        # The device continues counting after its pause.
        late = [(at_s, status) for at_s, status in checked if at_s > from_s + 0.6]
        slowest_s = max([slowest_s, *(at_s - from_s for at_s, status in late if status == "good")])
        tries += 1
    matrix_row(
        35,
        fault="frames delayed by 0.6 s in a device of one of these rates",
        tries=tries,
        limit="0 of them used",
        worst=f"last use {slowest_s:.2f} s after the fault",
        clock="virtual",
    )
    assert slowest_s == 0.0


INVALID = {
    safety.OUT_OF_VOLUME: lambda rng, tool: {"port_status": with_bits(tool, 0x40)},
    safety.PORT_ERROR: lambda rng, tool: {"port_status": with_bits(tool, rng.choice([0x80, 0x100, 0x200, 0x1000]))},
    safety.INACCURATE: lambda rng, tool: {"quality": np.where(np.arange(4) == tool, rng.uniform(1.01, 9.0), 0.1)},
}


def with_bits(tool, bits):
    return tuple(0x31 | (int(bits) if each == tool else 0) for each in range(4))


def ended(world):
    """Runs until the tracker ends the run: the error, and seconds from the last valid frame to the venting."""
    with pytest.raises((LostInRun, Tripped)) as raised:
        world.run()
    valid = [record for record in world.ticks if record.frame_status == "good"]
    return raised.value, world.time_s - valid[-1].frame.mono_ns * 1e-9


def test_row_36_status_volume_and_rms_error(matrix_row, full):
    rng, worst_s = np.random.default_rng(36), dict.fromkeys(INVALID, 0.0)
    tries = 3000 if full else 60
    for status, _ in itertools.product(INVALID, range(tries)):
        world = World(steps=20)
        world.frame_age_s = rng.uniform(0.002, 0.045)
        changes = INVALID[status](rng, rng.integers(4))
        world.corrupted.append((world.time_s + rng.uniform(PERIOD_S, 8 * PERIOD_S), np.inf, corrupting(**changes)))
        error, took_s = ended(world)
        assert isinstance(error, Tripped)
        assert status in str(error)
        assert [record.frame_status for record in world.ticks[-3:]] == [status] * 3
        worst_s[status] = max(worst_s[status], took_s)
    for status in INVALID:
        matrix_row(
            36,
            fault=f"a tool with {status}",
            tries=tries,
            limit="0 used; vent 1.25 s after the last valid frame",
            worst=f"0; {worst_s[status]:.3f} s",
            clock="virtual",
        )
    assert max(worst_s.values()) <= VENT_LIMIT_S


def with_invalid_frames(count):
    table = ROBOT.to_dict()
    table["limits"]["invalid_frames"] = count
    return robot_file.from_dict(table)


def jumping(rng, robot):
    """A world in which one module jumps beyond the plausible motion and stays there."""
    world = World(steps=20, robot=robot)
    angles = np.zeros(3)
    angles[rng.integers(3)] = rng.choice([-1, 1]) * rng.uniform(80.0, 100.0)
    at_s = world.due_s(rng.integers(3, 9)) - rng.uniform(0.05, 0.3)
    world.corrupted.append((at_s, np.inf, corrupting(poses=planar_poses(angles))))
    return world


def test_row_37_jump_that_stays(matrix_row, full):
    rng, tries, worst_s, fewest = np.random.default_rng(37), 10_000 if full else 200, 0.0, 100
    for _ in range(tries):
        world = jumping(rng, ROBOT)
        error, took_s = ended(world)
        assert isinstance(error, Tripped)
        assert all(record.frame_status != "good" for record in world.ticks[-3:])
        worst_s = max(worst_s, took_s)
        world = jumping(rng, with_invalid_frames(10)).run()
        held = [record.tick for record in world.ticks if record.frame_status != "good"]
        assert held == list(range(held[0], held[0] + len(held)))
        fewest = min(fewest, len(held))
    matrix_row(
        37,
        fault="a jump of 80 to 100 degrees that stays, limits as shipped",
        tries=tries,
        limit="not used; vent 1.25 s after the last valid frame",
        worst=f"0; {worst_s:.3f} s",
        clock="virtual",
    )
    matrix_row(
        37,
        fault="a jump that stays, 10 invalid frames allowed",
        tries=tries,
        limit="used after 3 more frames that agree, not earlier",
        worst=f"after {fewest}",
        clock="virtual",
    )
    assert worst_s <= VENT_LIMIT_S
    assert fewest == 3
