"""Which frames are used, what is tolerated, and what ends a run."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tracker_frames import in_space
from virtual_loop import PERIOD_S, ROBOT, planar_poses

from modsoft.runtime import robot as robot_file
from modsoft.runtime import safety
from modsoft.runtime.control.features import bending_angle_deg, from_poses, out_of_plane_deg
from modsoft.runtime.errors import LostInRun, ModelError, Tripped
from modsoft.runtime.safety import FaultCounter, FrameCheck, FrameValidator, check_actuation, check_rest
from modsoft.runtime.tracking.frame import TrackerFrame


def frame(number, at_s, angles=(0.0, 0.0, 0.0), **changes):
    poses = planar_poses(angles)
    parts = {"poses": poses, "valid": np.ones(len(poses), bool), "quality": np.full(len(poses), 0.1), "device_hz": 60.0}
    return TrackerFrame(number, at_s, **(parts | changes))


def settled(start_s=100.0):
    """A validator that has seen one good frame, number 6000 at `start_s`."""
    validator = FrameValidator(ROBOT)
    assert validator.check(frame(6000, start_s), start_s + 0.02).good
    return validator


def test_every_check_of_poses_is_of_corrected_ones():
    """The tool of module 1 is beside that of the base, and turned; corrected, the robot is as it was at rest."""
    mounting = np.tile(np.eye(4), (4, 1, 1))
    mounting[1] = [[0.0, -1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, -80.0], [0.0, 0.0, 0.0, 1.0]]
    mounting[3, 2, 3] = -120.0  # behind that of module 2
    validator = FrameValidator(ROBOT, lambda poses: poses @ np.linalg.inv(mounting))
    for number, angles in ((1, (0.0, 0.0, 0.0)), (2, (3.0, 30.0, -40.0))):
        check = validator.check(
            frame(60 * number, 100.0 + number, poses=planar_poses(angles) @ mounting), 100.02 + number
        )
        assert check.good
        np.testing.assert_allclose(bending_angle_deg(check.configuration), angles, atol=1e-9)


def test_good_frame_gives_its_configuration():
    check = FrameValidator(ROBOT).check(frame(1, 100.0, (3.0, 30.0, -40.0)), 100.02)
    assert check.good
    assert check.age_s == pytest.approx(0.02)
    np.testing.assert_allclose(bending_angle_deg(check.configuration), [3.0, 30.0, -40.0])


def one_nan(poses):
    poses = poses.copy()
    poses[2, 0, 0] = np.nan
    return poses


def stretched(poses):
    poses = poses.copy()
    poses[2, :3, :3] *= 1.1
    return poses


def tilted_sideways(degrees):
    """Straight but for the tool of module 2 and those below, which are tilted out of the plane."""
    poses, angle = planar_poses((0.0, 0.0, 0.0)), np.radians(degrees)
    tilt = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    poses[2:, :3, :3] = poses[2:, :3, :3] @ tilt
    return poses


BAD = {
    safety.NO_FRAME: lambda: None,
    safety.STALE: lambda: frame(6010, 100.4 - 0.41),
    safety.FROZEN: lambda: frame(6000, 100.3),
    safety.BACKWARDS: lambda: frame(5999, 100.39),
    safety.DELAYED: lambda: frame(6000 + 1, 100.39 + 0.05),
    safety.WRONG_NUMBER: lambda: frame(6024, 100.39, (0.0, 0.0)),
    safety.HIDDEN: lambda: frame(6024, 100.39, valid=np.array([True, True, False, True])),
    safety.NOT_FINITE: lambda: frame(6024, 100.39, poses=one_nan(planar_poses((0.0, 0.0, 0.0)))),
    safety.DISTORTED: lambda: frame(6024, 100.39, poses=stretched(planar_poses((0.0, 0.0, 0.0)))),
    safety.OUT_OF_PLANE: lambda: frame(6024, 100.39, poses=tilted_sideways(36.0)),
    safety.SWAPPED: lambda: frame(6024, 100.39, poses=planar_poses((0.0, 10.0, 20.0))[[0, 2, 1, 3]]),
    safety.REVERSED: lambda: frame(6024, 100.39, poses=planar_poses((0.0, 10.0, 20.0))[::-1]),
    safety.JUMP: lambda: frame(6024, 100.39, (0.0, 0.0, 120.0)),
    safety.OUT_OF_VOLUME: lambda: frame(6024, 100.39, port_status=(0x31, 0x31, 0x71, 0x31)),
    safety.PORT_ERROR: lambda: frame(6024, 100.39, port_status=(0x31, 0x31, 0x1031, 0x31)),
    safety.INACCURATE: lambda: frame(6024, 100.39, quality=np.array([0.1, 0.1, 1.01, 0.1])),
}


@pytest.mark.parametrize("status", BAD)
def test_each_bad_frame_is_refused_by_name(status):
    validator = settled()
    check = validator.check(BAD[status](), 100.4 if status != safety.DELAYED else 100.79)
    assert check.status == status
    assert check.configuration is None
    # and the next good one is used again
    assert validator.check(frame(6072, 101.19), 101.2).good


@pytest.mark.parametrize(
    ("status", "detail"),
    [
        (safety.HIDDEN, "module 2"),
        (safety.NOT_FINITE, "module 2"),
        (safety.OUT_OF_VOLUME, "module 2"),
        (safety.PORT_ERROR, "module 2 0x1031"),
        (safety.INACCURATE, "module 2 1.01 mm, at most 1 mm"),
    ],
)
def test_detail_names_the_tool(status, detail):
    assert settled().check(BAD[status](), 100.4).detail == detail


@pytest.mark.parametrize(
    ("bits", "status"),
    [
        (0x31, "good"),
        (0x3F, "good"),  # buttons of the tool
        (0xB1, safety.PORT_ERROR),
        (0x131, safety.PORT_ERROR),
        (0x231, safety.PORT_ERROR),
        (0x8031, safety.PORT_ERROR),
        (0x11, safety.PORT_ERROR),  # not enabled
        (0x01, safety.PORT_ERROR),
    ],
)
def test_port_status_is_checked(bits, status):
    check = FrameValidator(ROBOT).check(frame(1, 100.0, port_status=(0x31, 0x31, 0x31, bits)), 100.01)
    assert check.status == status


def test_motion_out_of_the_plane_is_limited():
    """Tools tilted by the mounting are tolerated; a robot in space has no plane."""
    assert FrameValidator(ROBOT).check(frame(1, 100.0, poses=tilted_sideways(34.5)), 100.01).good
    check = FrameValidator(ROBOT).check(frame(1, 100.0, poses=tilted_sideways(-35.5)), 100.01)
    assert (check.status, check.detail[:40]) == (safety.OUT_OF_PLANE, "module 2 by 36 degrees, at most 35; the ")
    assert FrameValidator(in_space()).check(frame(1, 100.0, poses=tilted_sideways(80.0)), 100.01).good


def test_angle_at_the_limit_of_the_plane_is_accepted(monkeypatch):
    poses = tilted_sideways(20.0)
    limit_deg = out_of_plane_deg(from_poses(poses)).max()
    monkeypatch.setattr(safety, "OUT_OF_PLANE_LIMIT_DEG", limit_deg)
    assert FrameValidator(ROBOT).check(frame(1, 100.0, poses=poses), 100.01).good
    monkeypatch.setattr(safety, "OUT_OF_PLANE_LIMIT_DEG", np.nextafter(limit_deg, 0.0))
    assert FrameValidator(ROBOT).check(frame(1, 100.0, poses=poses), 100.01).status == safety.OUT_OF_PLANE


def test_limits_of_status_and_rms_are_those_of_the_robot_file():
    robot = with_limits(refused_port_status=0x40, largest_rms_mm=0.05)
    validator = FrameValidator(robot)
    quality = np.full(4, 0.04)
    assert validator.check(frame(1, 100.0, quality=quality, port_status=(0xB1,) * 4), 100.01).good
    assert validator.check(frame(2, 100.1, port_status=(0x31,) * 4), 100.11).status == safety.INACCURATE


def test_frame_without_quality_and_status_is_valid():
    assert FrameValidator(ROBOT).check(frame(1, 100.0, quality=np.full(4, np.nan)), 100.01).good


def with_limits(**limits):
    table = ROBOT.to_dict()
    table["limits"].update(limits)
    return robot_file.from_dict(table)


def test_jump_that_stays_is_accepted_after_three_confirming_frames():
    validator = settled()
    statuses = []
    for step in range(1, 6):
        now_s = 100.0 + step * PERIOD_S
        statuses.append(validator.check(frame(6000 + 24 * step, now_s, (0.0, 0.0, 90.0)), now_s + 0.02).status)
    assert statuses == [safety.JUMP] * 3 + ["good"] * 2


def test_jump_that_stays_ends_a_run_of_the_shipped_limits():
    validator, faults = settled(), FaultCounter(ROBOT)
    checks = []
    for step in range(1, 4):
        now_s = 100.0 + step * PERIOD_S
        checks.append(validator.check(frame(6000 + 24 * step, now_s, (0.0, 0.0, 90.0)), now_s + 0.02))
    faults.frame(checks[0])
    faults.frame(checks[1])
    with pytest.raises(Tripped, match="the last one jump"):
        faults.frame(checks[2])


@pytest.mark.parametrize("between", [(0.0, 0.0, -90.0), None])
def test_confirming_frames_are_in_a_row_and_within_the_gate_of_each_other(between):
    """Another jump, or a hidden tool, starts the confirmation again."""
    validator = settled()
    for step in range(1, 12):
        now_s = 100.0 + step * PERIOD_S
        disturbed = step % 3 == 0
        valid = np.array([True, True, True, not (disturbed and between is None)])
        angles = between if disturbed and between else (0.0, 0.0, 90.0)
        assert not validator.check(frame(6000 + 24 * step, now_s, angles, valid=valid), now_s + 0.02).good


def test_gap_allows_no_larger_jump():
    """The command is held without a valid frame, so that the robot does not move any further."""
    validator = settled()
    now_s = 100.0 + 3 * PERIOD_S
    assert validator.check(frame(6072, now_s, (0.0, 0.0, 90.0)), now_s + 0.02).status == safety.JUMP


def test_no_limits_in_the_robot_file_give_a_gate():
    table = ROBOT.to_dict()
    del table["limits"]
    validator = FrameValidator(robot_file.from_dict(table))
    assert validator.check(frame(6000, 100.0), 100.02).good
    assert validator.check(frame(6024, 100.4, (0.0, 0.0, 90.0)), 100.42).status == safety.JUMP


def test_robot_as_fast_as_its_limits_allow_is_no_jump():
    """The largest actuation step, over a reach of 90 degrees to each side, with half of it again as swing."""
    validator = settled()
    angle, sign = 0.0, 1.0
    for step in range(1, 40):
        if abs(angle) >= 90.0:
            sign = -sign
        angle += sign * 1.5 * 90.0 * ROBOT.limits.largest_actuation_step
        now_s = 100.0 + step * PERIOD_S
        check = validator.check(frame(6000 + 24 * step, now_s, (0.0, 0.0, angle)), now_s + 0.02)
        assert check.good, check


def test_frozen_tracker_is_detected_within_three_ticks_at_any_phase():
    for phase_s in np.linspace(0.0, PERIOD_S, 9):
        validator, held = settled(), frame(6000 + round(60 * phase_s), 100.0 + phase_s)
        statuses = [validator.check(held, 100.0 + phase_s + 0.01 + k * PERIOD_S).status for k in range(3)]
        assert statuses[1] != "good"
        assert statuses[2] != "good"


def test_delay_is_detected_in_fresh_frames():
    validator = FrameValidator(ROBOT)
    for step in range(10):
        now_s = 100.0 + step * PERIOD_S
        assert validator.check(frame(int((now_s - 0.02) * 60), now_s - 0.01), now_s).good
    now_s += PERIOD_S
    delayed = validator.check(frame(int((now_s - 0.02 - 0.35) * 60), now_s - 0.01), now_s)
    assert delayed.good  # 0.36 s: within the robot file's 0.4 s
    for _ in range(200):  # a delay that lasts does not become the norm
        now_s += PERIOD_S
        check = validator.check(frame(int((now_s - 0.02 - 0.45) * 60), now_s - 0.01), now_s)
        assert check.status == safety.DELAYED


@given(
    st.integers(0, 3),
    st.sampled_from([(0, 0), (1, 3), (2, 2), (0, 3)]),
    st.sampled_from([np.nan, np.inf, -np.inf]),
)
def test_pose_that_is_not_finite_is_refused(tool, entry, value):
    poses = planar_poses((5.0, 30.0, 80.0))
    poses[tool][entry] = value
    check = FrameValidator(ROBOT).check(frame(1, 1.0, poses=poses), 1.01)
    assert check.status == safety.NOT_FINITE


@pytest.mark.filterwarnings("ignore:(overflow|invalid value):RuntimeWarning")
def test_axes_too_large_for_a_length_are_distorted():
    """Their components along each other are infinite, or no numbers at all."""
    for axes in (np.full((3, 3), 1e200), np.array([[1e200, -1e200, 0.0]] * 3)):
        poses = planar_poses((5.0, 30.0, 80.0))
        poses[1:3, :3, :3] = axes
        assert FrameValidator(ROBOT).check(frame(1, 1.0, poses=poses), 1.01).status == safety.DISTORTED


# ---- What is tolerated


def test_third_bad_frame_in_a_row_ends_the_run():
    faults = FaultCounter(ROBOT)
    for _ in range(5):
        faults.frame(FrameCheck(safety.HIDDEN))
        faults.frame(FrameCheck(safety.JUMP))
        faults.frame(FrameCheck("good", np.zeros((3, 3))))
    faults.frame(FrameCheck(safety.HIDDEN))
    faults.frame(FrameCheck(safety.HIDDEN))
    with pytest.raises(Tripped, match=r"3 ticks in a row.*tool hidden \(module 2\)"):
        faults.frame(FrameCheck(safety.HIDDEN, detail="module 2"))


@pytest.mark.parametrize("status", safety.TRACKER_LOST)
def test_lost_tracker_is_reported_as_lost(status):
    faults = FaultCounter(ROBOT)
    faults.frame(FrameCheck(status))
    faults.frame(FrameCheck(status))
    with pytest.raises(LostInRun, match=status):
        faults.frame(FrameCheck(status))


def test_more_than_two_missed_ticks_end_the_run():
    faults = FaultCounter(ROBOT)
    faults.missed(2)
    faults.on_time()
    faults.missed(1)
    faults.missed(1)
    with pytest.raises(Tripped, match="3 control ticks"):
        faults.missed(1)
    with pytest.raises(Tripped, match="8 control ticks"):
        FaultCounter(ROBOT).missed(8)


# ---- Actuations and rest


@pytest.mark.parametrize("value", [np.nan, np.inf, 3.1, -40.0])
def test_actuation_out_of_range_is_refused(value):
    with pytest.raises(ModelError, match="nothing of it was sent"):
        check_actuation(np.array([[0.1], [value], [0.0]]))


def test_actuation_slightly_out_of_range_is_accepted():
    check_actuation(np.array([[1.2], [-1.2], [0.0]]))


def rest(poses):
    check_rest(FrameValidator(ROBOT).check(frame(1, 1.0, poses=poses), 1.0).configuration, poses)


def test_rest():
    rest(planar_poses((0.0, 0.0, 0.0)))
    rest(planar_poses((3.0, 40.0, -59.0)))
    with pytest.raises(Tripped, match="module 2 is at 90 degrees"):
        rest(planar_poses((0.0, 90.0, 0.0)))


@pytest.mark.parametrize(
    ("order", "module"), [((0, 2, 1, 3), 2), ((0, 1, 3, 2), 3), ((0, 3, 2, 1), 2), ((0, 3, 1, 2), 2), ((0, 2, 3, 1), 3)]
)
def test_straight_robot_with_its_tools_in_a_wrong_order_is_not_at_rest(order, module):
    """Every module of it looks straight, and a controller would bend the wrong ones."""
    poses = planar_poses((1.0, -2.0, 3.0))
    with pytest.raises(Tripped, match=f"the tool of module {module} hangs .* mm behind that of module {module - 1}"):
        rest(poses[list(order)])


def test_tool_of_the_base_may_be_anywhere_on_it():
    poses = planar_poses((0.0, 0.0, 0.0))
    poses[0, :3, 3] = [200.0, -30.0, 150.0]
    rest(poses)
