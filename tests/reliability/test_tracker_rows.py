"""Failure matrix, rows 13 to 19: what the tracker may do. On virtual time; on the real line in test_line_rows.py."""

import dataclasses
import itertools

import numpy as np
import pytest
from virtual_loop import PERIOD_S, ROBOT, World, corrupting, planar_poses

from modsoft.runtime import robot as robot_file
from modsoft.runtime import safety
from modsoft.runtime.control.features import bending_angle_deg
from modsoft.runtime.errors import LostInRun, Tripped
from modsoft.runtime.log_record import TickRecord
from modsoft.runtime.safety import FrameValidator
from modsoft.runtime.tracking.frame import LatestFrame, TrackerFrame

VENT_LIMIT_S = 3 * PERIOD_S + 0.05  # from the last good frame on
RUN_S = 8 * PERIOD_S  # of a run before its fault


def ended(world):
    """Runs until the tracker ends the run; seconds from the last good frame to the start of the venting."""
    good_s = []
    check = world.loop.validator.check

    def noted(frame, now_s):
        result = check(frame, now_s)
        if result.good:
            good_s.append(frame.monotonic_s)
        return result

    world.loop.validator.check = noted
    with pytest.raises((LostInRun, Tripped)):
        world.run()
    return world.time_s - good_s[-1]


def held(world):
    """Checks that each tick without a good frame sent the command of the tick before; how many there were."""
    count = 0
    for before, record in itertools.pairwise(world.ticks):
        if record.frame_status != "good":
            assert record.raw is None
            assert record.configuration is None
            assert np.array_equal(record.actuation, before.actuation)
            count += 1
    return count


def restless(world):
    """A model whose answer is another one in every step, so that a held command shows."""
    world.answer = lambda features: np.full((world.robot.modules, 1), 0.3 * np.sin(len(world.features)))
    return world


def test_row_13_tracker_off(matrix_row, full):
    rng, tries, worst_s = np.random.default_rng(13), 10_000 if full else 200, 0.0
    for _ in range(tries):
        world = restless(World(steps=20))
        world.frame_age_s = rng.uniform(0.002, 0.045)
        world.dark.append((world.time_s + rng.uniform(PERIOD_S, RUN_S), np.inf))
        worst_s = max(worst_s, ended(world))
        held(world)
    matrix_row(
        13,
        fault="tracker off",
        tries=tries,
        limit="vent 1.25 s after the last good frame",
        worst=f"{worst_s:.3f} s",
        clock="virtual",
    )
    assert worst_s <= VENT_LIMIT_S
    ticks = most = 0
    for _ in range(tries // 10):
        world, at_s = restless(World(steps=50)), 500.0
        while at_s < world.due_s(50):
            at_s += rng.uniform(1.2 * PERIOD_S, 2.5 * PERIOD_S)
            world.dark.append((at_s, at_s := at_s + rng.uniform(0.0, 2 * PERIOD_S)))
        world.run()
        most, ticks = max(most, held(world)), ticks + len(world.ticks)
        assert len(world.sent) == 51
    matrix_row(
        13,
        fault="tracker intermittent, up to 0.8 s",
        tries=ticks,
        limit="command held, run continues",
        worst=f"{most} of 50 ticks held",
        clock="virtual",
    )
    assert most >= 5


def test_row_14_tracker_frozen(matrix_row, full):
    rng, tries, worst, worst_s = np.random.default_rng(14), 10_000 if full else 200, 0, 0.0
    for _ in range(tries):
        world = restless(World(steps=20))
        world.frame_age_s = rng.uniform(0.002, 0.045)
        frozen_s = world.time_s + rng.uniform(PERIOD_S, RUN_S)
        number = int(frozen_s * 60)
        world.corrupted.append((frozen_s, np.inf, corrupting(device_frame=number)))  # fresh by the host's clock
        worst_s = max(worst_s, ended(world))
        used = [record for record in world.ticks if record.frame_status == "good" and record.frame.number == number]
        worst = max(worst, len(used) + 1)
    matrix_row(
        14,
        fault="tracker frozen, the same frame again",
        tries=tries,
        limit="found within 3 ticks",
        worst=f"tick {worst}, vent after {worst_s:.3f} s",
        clock="virtual",
    )
    assert worst <= 3
    assert worst_s <= VENT_LIMIT_S

    statuses, hours = [], 10 if full else 1
    for drift in (-1e-4, 1e-4):
        world = World(steps=round(hours / 2 * 3600 / PERIOD_S))
        world.log = lambda record: statuses.append(record.frame_status) if isinstance(record, TickRecord) else None
        world.frame = lambda drift=drift, world=world: noise(rng, world.time_s, drift)
        world.run()
    alarms = len(statuses) - statuses.count("good")
    matrix_row(
        14,
        fault="none: noise of 0.5 mm and 0.5 degrees, jitter of the line, clocks 100 ppm apart",
        tries=len(statuses),
        limit=f"no false alarm in {hours} h",
        worst=alarms,
        clock="virtual",
    )
    assert alarms == 0


def noise(rng, now_s, drift):
    """A frame of a working tracker, whose clock is off by a share of `drift`, that looks at a moving robot."""
    age_s = rng.uniform(0.002, 0.045)
    angles = np.array([5.0, 30.0, 80.0]) * np.sin(2 * np.pi * now_s / 80.0) + rng.normal(0, 0.5, 3)
    poses = planar_poses(angles)
    poses[:, :3, 3] += rng.normal(0, 0.5, (4, 3))
    number = int((now_s - age_s - rng.uniform(0, 0.017)) * 60 * (1 + drift))
    return TrackerFrame(number, now_s - age_s, poses, np.ones(4, bool), np.full(4, 0.1), 60.0)


def test_row_15_delayed(matrix_row, full):
    """Frames that are late on the line, which the host sees, or in the device, which only its count tells."""
    rng, tries, used, worst_s = np.random.default_rng(15), 1_000_000 if full else 20_000, 0, 0.0
    validator, now_s, seen_s = FrameValidator(ROBOT), 1000.0, 0.0
    for step in range(tries):
        now_s += PERIOD_S
        late = rng.choice(["no", "line", "device", "both"], p=[0.4, 0.2, 0.2, 0.2]) if step >= 10 else "no"
        on_line_s = rng.uniform(0.0, 1.5 if late in ("line", "both") else 0.045)
        in_device_s = rng.uniform(0.0, 1.5) if late in ("device", "both") else 0.0
        number = int((now_s - on_line_s - in_device_s) * 60)
        in_device_s = now_s - on_line_s - number / 60 if in_device_s else 0.0
        on_line_s = now_s - number / 60 - in_device_s
        frame = TrackerFrame(
            number, now_s - on_line_s, planar_poses((1.0, 2.0, 3.0)), np.ones(4, bool), np.full(4, 0.1), 60.0
        )
        if validator.check(frame, now_s).good:
            assert number / 60 > seen_s, "an older frame after a newer one"
            used, seen_s = used + 1, number / 60
            worst_s = max(worst_s, on_line_s + in_device_s)
    matrix_row(
        15,
        fault="frames delayed by up to 3 s, on the line and in the device",
        tries=tries,
        limit="0 older than a period (0.4 s) used",
        worst=f"0; oldest of {used} used {worst_s:.3f} s",
        clock="virtual",
    )
    assert worst_s <= PERIOD_S
    assert used > 0.3 * tries


def test_row_16_nan(matrix_row, full):
    rng, tries = np.random.default_rng(16), 100_000 if full else 10_000
    world = restless(World(steps=round(1.5 * tries)))
    world.log = lambda record: counts.append(record.frame_status) if isinstance(record, TickRecord) else None
    counts, frame = [], world.frame

    def sometimes(**changes):
        """Two of three ticks see a frame that is corrupted somewhere."""
        seen = frame(**changes)
        if int((world.time_s - 500.0 + 0.2) / PERIOD_S) % 3 == 0:
            return seen
        poses = seen.poses.copy()
        for _ in range(rng.integers(1, 4)):
            poses[rng.integers(4), rng.integers(3), rng.integers(4)] = rng.choice([np.nan, np.inf, -np.inf])
        return dataclasses.replace(seen, poses=poses)

    world.frame = sometimes
    world.run()
    refused = counts.count(safety.NOT_FINITE)
    assert refused >= 0.99 * tries
    assert counts.count("good") == len(counts) - refused == len(world.features)
    reached = sum(not np.isfinite(features).all() for features in world.features)
    matrix_row(
        16,
        fault="NaN and infinity in poses that call themselves valid",
        tries=refused,
        limit="0 reach the model",
        worst=reached,
        clock="virtual",
    )
    assert reached == 0
    assert all(np.isfinite(bar).all() for *_, bar in world.sent)


def test_row_17_outlier(matrix_row, full):
    rng, tries, worst = np.random.default_rng(17), 10_000 if full else 300, 0
    fastest_deg = 180.0 * ROBOT.limits.largest_actuation_step + safety.NOISE_DEG  # in one period
    for _ in range(tries):
        world, module = restless(World(steps=12)), rng.integers(3)
        angles = np.zeros(3)
        angles[module] = rng.choice([-1, 1]) * rng.uniform(1.05 * fastest_deg, 180.0)
        poses = planar_poses(angles)
        at_s = world.due_s(6) - world.frame_age_s
        world.corrupted.append((at_s - rng.uniform(0.0, PERIOD_S / 2), at_s + 0.001, corrupting(poses=poses)))
        world.run()
        refused = [record.tick for record in world.ticks if record.frame_status != "good"]
        assert refused[0] == 6
        assert world.ticks[6].frame_status in (safety.JUMP, safety.SWAPPED, safety.REVERSED)
        assert held(world) == len(refused)
        worst = max(worst, len(refused))
        used = [record.configuration for record in world.ticks if record.frame_status == "good"]
        assert np.all(bending_angle_deg(used) == 0.0)
    matrix_row(
        17,
        fault="a frame that jumps by more than the fastest motion",
        tries=tries,
        limit="command held on that tick, back within 3",
        worst=f"after {worst}",
        clock="virtual",
    )
    assert worst <= 3


ROBOTS = {"pneumatic-3": (6.0, 36.0, 90.0), "pneumatic-2": (30.0, 75.0)}  # how far they bend, degrees


def random_partial(rng, count):
    """(what, corrupt): some way in which a frame of `count` tools is not the state of the robot."""
    match rng.integers(4):
        case 0:
            valid = np.ones(count, bool)
            valid[rng.choice(count, rng.integers(1, count + 1), replace=False)] = False
            return "hidden", corrupting(valid=valid)
        case 1:
            tools = rng.choice([tools for tools in (0, 1, 2, 3, 4, 5, 8) if tools != count])
            parts = {"poses": np.tile(np.eye(4), (tools, 1, 1)), "valid": np.ones(tools, bool)}
            return "wrong number", corrupting(**parts, quality=np.full(tools, 0.1))
        case 2:
            return "wrong number", corrupting(valid=np.ones(rng.choice([0, 1, count - 1, count + 1]), bool))
        case _:
            order = np.arange(count)
            while np.array_equal(order, np.arange(count)):
                order = rng.permutation(count)
            return "swapped", lambda frame: dataclasses.replace(frame, poses=frame.poses[order])


def test_row_18_hidden_wrong_number_swapped(matrix_row, full):
    rng, tries, worst_s, kinds = np.random.default_rng(18), 10_000 if full else 300, 0.0, set()
    for _ in range(tries):
        name = rng.choice(list(ROBOTS))
        world = restless(World(steps=20, robot=robot_file.load(name)))
        world.frame_age_s = rng.uniform(0.002, 0.045)
        world.angles = tuple(rng.uniform(-1, 1, len(ROBOTS[name])) * ROBOTS[name])
        what, corrupt = random_partial(rng, len(ROBOTS[name]) + 1)
        kinds.add(what)
        world.corrupted.append((world.time_s + rng.uniform(PERIOD_S, RUN_S), np.inf, corrupt))
        worst_s = max(worst_s, ended(world))
        bad = [record for record in world.ticks if record.frame_status != "good"]
        assert len(bad) == 3
        assert world.ticks[-3:] == bad
        held(world)
    assert kinds == {"hidden", "wrong number", "swapped"}
    matrix_row(
        18,
        fault="tools hidden, of a wrong number, in any wrong order",
        tries=tries,
        limit="no partial state used; vent 1.25 s after the last good frame",
        worst=f"0; {worst_s:.3f} s",
        clock="virtual",
    )
    assert worst_s <= VENT_LIMIT_S


def test_row_19_numbers_backwards(matrix_row, full):
    rng, tries, used, dropped = np.random.default_rng(19), 1_000_000 if full else 20_000, 0, 0
    frames, validator = LatestFrame(), FrameValidator(ROBOT)
    good, newest, last, now_s = planar_poses((1.0, 2.0, 3.0)), -1, -1, 1000.0
    for step in range(tries):
        now_s += 1 / 60
        back = rng.choice([0, rng.integers(1, 100), rng.integers(100, 60_000)], p=[0.5, 0.3, 0.2])
        number = int(now_s * 60) - back
        frame = TrackerFrame(number, now_s, good, np.ones(4, bool), np.full(4, 0.1), 60.0)
        frames.put(frame)
        dropped += number <= newest
        newest = max(newest, number)
        seen = frame if step % 2 else frames.latest()  # the validator does not depend on the filter
        if validator.check(seen, now_s + 0.001).good:
            used += seen.device_frame <= last
            last = seen.device_frame
    assert frames.counts["repeated"] + frames.counts["backwards"] == dropped
    assert sum(frames.counts.values()) == tries
    matrix_row(
        19,
        fault="frame numbers that go backwards",
        tries=dropped,
        limit="0 used, each counted",
        worst=used,
        clock="virtual",
    )
    assert used == 0
    assert dropped > 0.3 * tries
    assert last > 0.99 * newest
