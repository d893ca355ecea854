"""The real-time plant: duties to set-points, poses as the tracker sees them, deadlines on virtual time."""

import json
import os

import numpy as np
import pytest
from rigid_arm import RigidArm

from modsoft.hil.plant import FilteredPins, ValvesAndArm, duties_from, run, tool_poses
from modsoft.runtime import robot as robot_file
from modsoft.runtime.control.actuation import channel_pressures_bar, pressures_bar
from modsoft.runtime.control.features import from_poses


@pytest.fixture
def robot():
    return robot_file.load("pneumatic-3")


def test_set_points_invert_the_commands_of_the_runtime(robot):
    actuation = np.array([[0.3], [-1.0], [0.0]])
    duty = channel_pressures_bar(robot, actuation) / robot.valve.full_scale_bar
    plant = ValvesAndArm(robot, RigidArm(3))
    plant.advance(duty, 0.02)
    np.testing.assert_allclose(plant.arm.pressures, pressures_bar(robot, actuation), atol=1e-12)


def test_no_duty_is_no_pressure(robot):
    plant = ValvesAndArm(robot, RigidArm(3))
    plant.advance(np.zeros(0), 0.02)
    assert not plant.arm.pressures.any()


def test_tracker_sees_the_configuration(robot):
    arm = RigidArm(3)
    arm.set_pressures([[0.3, 0.08], [0.08, 0.35], [0.2, 0.1]])
    poses = tool_poses(arm.positions, arm.directors)
    np.testing.assert_allclose(from_poses(poses), arm.configuration, atol=1e-12)
    assert not np.allclose(poses[0, :3, :3], np.eye(3)), "the base must not stand straight in the tracker's frame"
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1.0)
    # neighbouring tools are as far apart as the module ends, in mm
    np.testing.assert_allclose(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1), 50.0)


class Time:
    """Virtual time: advanced by sleeping, and by the test."""

    def __init__(self):
        self.now_ns = 1_000_000

    def clock_ns(self):
        return self.now_ns

    def sleep(self, seconds):
        self.now_ns += round(seconds * 1e9)


def test_slices_have_absolute_deadlines_and_catch_up(robot):
    time, lines, arm = Time(), [], RigidArm(3)
    start = time.now_ns

    def duties():
        for k in range(10):
            time.now_ns += 70_000_000 if k == 3 else 5_000_000  # slice 3 takes 70 ms, the others 5
            yield None

    run(ValvesAndArm(robot, arm), duties(), lines.append, time.clock_ns, time.sleep, slice_s=0.02)
    states = [line for line in lines if line["event"] == "state"]
    assert lines[0] == {"event": "ready"}
    assert [s["mono_ns"] - start for s in states] == [20_000_000 * (k + 1) for k in range(10)]
    assert arm.time_s == pytest.approx(0.2)
    assert time.now_ns - start == 200_000_000, "it must be in step again at the end"
    assert states[3]["late_ms"] == pytest.approx(50)
    assert states[4]["late_ms"] == pytest.approx(35)
    assert states[-1]["late_ms"] == 0
    assert lines[-1] == {"event": "summary", "slices": 10, "late_slices": 2, "late_max_ms": pytest.approx(50)}


def test_duties_are_held_until_new_ones_come(robot):
    lines, arm, time = [], RigidArm(3), Time()
    full = np.full(12, 0.1)
    run(ValvesAndArm(robot, arm), iter([None, full, None]), lines.append, time.clock_ns, time.sleep)
    pressures = [np.max(line["pressure_bar"]) for line in lines if line["event"] == "state"]
    assert pressures == pytest.approx([0.0, 0.3, 0.3])
    assert lines[2]["channel_bar"] == pytest.approx({chamber.channel: 0.3 for chamber in robot.chambers})


def test_newest_duties_are_used_and_a_closed_pipe_ends():
    read, write = os.pipe()
    try:
        duties = duties_from(read)
        assert next(duties) is None
        os.write(write, b'{"duty": [0.1]}\n{"duty": [0.2]}\n{"duty": [0')
        np.testing.assert_array_equal(next(duties), [0.2])
        os.write(write, b".3]}\n")
        np.testing.assert_array_equal(next(duties), [0.3])
        os.close(write)
        with pytest.raises(StopIteration):
            next(duties)
    finally:
        os.close(read)


def test_every_line_is_json(robot):
    lines = []
    stepped = ValvesAndArm(robot, RigidArm(3))
    run(stepped, iter([np.full(12, 0.1)]), lambda line: lines.append(json.dumps(line)), sleep=lambda seconds: None)
    assert [json.loads(line)["event"] for line in lines] == ["ready", "state", "summary"]


@pytest.mark.parametrize(("pull_downs", "after"), [(True, 0.1 * np.exp(-1.0)), (False, 0.1)])
def test_floating_pin_falls_with_a_pull_down_and_holds_without(robot, pull_downs, after):
    pins = FilteredPins(pull_downs)
    assert not pins.advance(np.array([np.nan, np.nan]), 1.0).any(), "nothing was commanded yet"
    pins.advance(np.array([0.1, 0.05]), 0.02)
    for _ in range(11):
        command = pins.advance(np.array([np.nan, 0.05]), 0.01)
    np.testing.assert_allclose(command, [after, 0.05])
    np.testing.assert_array_equal(pins.advance(np.zeros(2), 0.02), [0.0, 0.0])


@pytest.mark.parametrize("pull_downs", [True, False])
def test_plant_with_floating_pins(robot, pull_downs):
    plant = ValvesAndArm(robot, RigidArm(3), pull_downs)
    plant.advance(np.full(11, 0.1), 0.02)
    for _ in range(55):
        plant.advance(np.full(11, np.nan), 0.02)
    pressure = 0.3 * np.exp(-10.0) if pull_downs else 0.3
    np.testing.assert_allclose(list(plant.channel_bar().values()), pressure)


def test_null_in_the_pipe_is_a_floating_pin():
    read, write = os.pipe()
    try:
        os.write(write, b'{"duty": [0.1, null]}\n')
        np.testing.assert_array_equal(next(duties_from(read)), [0.1, np.nan])
    finally:
        os.close(read)
        os.close(write)
