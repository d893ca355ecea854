"""The limits of the frame checks, of the model's actuation and of the rest position, each just inside and outside."""

import numpy as np
import pytest
from tracker_frames import in_space, tracker_frame, with_limits
from virtual_loop import PERIOD_S, ROBOT, planar_poses

from modsoft.runtime import safety
from modsoft.runtime.errors import ModelError, Tripped
from modsoft.runtime.safety import FrameValidator, check_actuation, check_rest

STRAIGHT = (0.0, 0.0, 0.0)


def settled(robot=ROBOT, **first):
    """A validator that has accepted a straight robot at time 0, frame 0."""
    validator = FrameValidator(robot)
    assert validator.check(tracker_frame(0, 0.0, **first), 0.0).good
    return validator


def status_and_detail(validator, **changes):
    """Of the frame one period after the first."""
    check = validator.check(tracker_frame(24, PERIOD_S, **changes), PERIOD_S)
    return check.status, check.detail


def straight_poses(*heights_mm):
    poses = np.stack([np.eye(4)] * len(heights_mm))
    poses[:, 2, 3] = heights_mm
    return poses


# ---- age and delay


@pytest.mark.parametrize(("age_s", "status"), [(0.5, "good"), (0.5625, safety.STALE)])
def test_largest_age_is_still_accepted(age_s, status):
    assert FrameValidator(with_limits(tracker_age_s=0.5)).check(tracker_frame(1, 1.0), 1.0 + age_s).status == status


@pytest.mark.parametrize(("delay_s", "status"), [(0.5, "good"), (0.75, safety.DELAYED)])
def test_largest_delay_is_still_accepted(delay_s, status):
    validator = settled(with_limits(tracker_age_s=0.5), device_hz=4.0)
    frame = tracker_frame(round(4 * (1.0 - delay_s)), 1.0, device_hz=4.0)
    assert validator.check(frame, 1.0).status == status


def test_delay_is_reported_with_the_age():
    validator = settled()
    check = validator.check(tracker_frame(27, 0.8), 0.9)
    assert (check.status, check.detail) == (safety.DELAYED, "0.45 s old by the device's count, at most 0.4 s")


@pytest.mark.parametrize("age_s", [0.01, 0.39])
def test_device_of_unknown_rate_has_no_delay(age_s):
    validator = settled(device_hz=None)
    assert validator.check(tracker_frame(1, 2.0, device_hz=None), 2.0 + age_s).good


@pytest.mark.parametrize(("delayed_until_s", "status"), [(60.0, safety.DELAYED), (60.5, "good")])
def test_shortest_delay_expires_after_a_minute(delayed_until_s, status):
    """Half a second of delay, at the limit, is the norm after it."""
    validator = settled(with_limits(tracker_age_s=0.5), device_hz=4.0)
    for at_s in np.arange(1.0, delayed_until_s + 0.25, 0.25):
        frame = tracker_frame(round(4 * (at_s - 0.5)), at_s, device_hz=4.0)
        assert validator.check(frame, at_s).good
    probe = tracker_frame(round(4 * (at_s - 0.5)) + 1, at_s + 0.5, device_hz=4.0)  # 0.75 s delayed
    assert validator.check(probe, at_s + 0.5).status == status


def test_delay_is_compared_with_four_frames_a_second():
    validator = settled(device_hz=64.0)
    for number in range(1, 129):
        assert validator.check(tracker_frame(number, number / 64, device_hz=64.0), number / 64).good
    assert list(validator._prompt) == [(number / 64, number) for number in range(0, 129, 16)]


# ---- content


@pytest.mark.parametrize(
    "changes",
    [
        {"valid": np.ones(3, bool)},
        {"poses": planar_poses((0.0, 0.0))},
        {"poses": planar_poses(STRAIGHT)[:, :3]},
    ],
)
def test_poses_and_flags_of_another_number_are_refused(changes):
    assert status_and_detail(settled(), **changes)[0] == safety.WRONG_NUMBER


@pytest.mark.parametrize(("tool", "name"), [(0, "base"), (1, "module 1"), (3, "module 3")])
def test_hidden_tool_is_named(tool, name):
    valid = np.ones(4, bool)
    valid[tool] = False
    assert status_and_detail(settled(), valid=valid) == (safety.HIDDEN, name)


@pytest.mark.parametrize(
    ("bits", "detail"),
    [
        (0xB1, "module 1 0xb1, partially out of volume"),
        (0x131, "module 1 0x131, sensor or algorithm"),
        (0x2B1, "module 1 0x2b1, partially out of volume, infrared interference"),
        (0x21, "module 1 0x21"),
    ],
)
def test_port_errors_are_named(bits, detail):
    assert status_and_detail(settled(), port_status=(0x31, bits, 0x31, 0x31)) == (safety.PORT_ERROR, detail)


def test_port_in_use_needs_initialised_and_enabled_only():
    assert status_and_detail(settled(), port_status=(0x30,) * 4) == ("good", "")


def test_other_refused_bits_of_the_port_are_errors_without_a_name():
    validator = FrameValidator(with_limits(refused_port_status=0x01))
    assert status_and_detail(validator, port_status=(0x31,) * 4) == (safety.PORT_ERROR, "base 0x31")


@pytest.mark.parametrize(("rms_mm", "status"), [(1.0, "good"), (1.001, safety.INACCURATE)])
def test_largest_rms_error_is_still_accepted(rms_mm, status):
    assert status_and_detail(settled(), quality=np.array([0.1, rms_mm, np.nan, 0.1]))[0] == status


@pytest.mark.parametrize(("scale", "expected"), [(1.019, ("good", "")), (1.021, (safety.DISTORTED, "module 3"))])
def test_axis_may_differ_from_a_unit_vector_by_two_percent(scale, expected):
    poses = planar_poses(STRAIGHT)
    poses[3, :3, :3] *= scale
    assert status_and_detail(settled(), poses=poses) == expected


def test_axis_at_the_tolerance_is_accepted(monkeypatch):
    monkeypatch.setattr(safety, "SIZE_TOLERANCE", 0.25)
    poses = planar_poses(STRAIGHT)
    poses[3, :3, :3] *= 1.25
    assert status_and_detail(settled(), poses=poses) == ("good", "")


@pytest.mark.parametrize(
    ("rest_mm", "length_mm", "status"),
    [(85.0, 120.4, "good"), (85.0, 120.6, safety.SWAPPED), (100.0, 140.0, "good"), (100.0, 140.1, safety.SWAPPED)],
)
def test_module_may_be_longer_than_at_rest_by_three_tenths_and_ten_millimetres(rest_mm, length_mm, status):
    validator = settled(poses=planar_poses(STRAIGHT, rest_mm))
    assert status_and_detail(validator, poses=planar_poses(STRAIGHT, length_mm))[0] == status


def test_tools_too_far_apart_are_named():
    poses = straight_poses(0.0, 85.0, 250.0, 335.0)
    assert status_and_detail(settled(), poses=poses) == (safety.SWAPPED, "module 1 and module 2")


@pytest.mark.parametrize(
    ("rest_mm", "behind_mm", "expected"),
    [
        (85.0, 21.2, ("good", "")),
        (85.0, 21.3, (safety.REVERSED, "module 3 behind module 2")),
        (100.0, 25.0, ("good", "")),
        (100.0, 25.1, (safety.REVERSED, "module 3 behind module 2")),
    ],
)
def test_tool_may_be_behind_the_one_before_by_a_quarter_of_the_module(rest_mm, behind_mm, expected):
    validator = settled(poses=planar_poses(STRAIGHT, rest_mm))
    poses = straight_poses(0.0, rest_mm, 2 * rest_mm, 2 * rest_mm - behind_mm)
    assert status_and_detail(validator, poses=poses) == expected


def test_order_of_tools_is_measured_along_the_axis_of_the_tool_before():
    validator = settled()
    assert validator.content(tracker_frame(24, PERIOD_S, (150.0, 0.0, 0.0)))[0] == "good"
    poses = planar_poses(STRAIGHT)
    poses[2, :3, :3] = planar_poses((150.0, 0.0, 0.0))[1, :3, :3]
    assert validator.content(tracker_frame(24, PERIOD_S, poses=poses))[:2] == (
        safety.REVERSED,
        "module 3 behind module 2",
    )


# ---- jumps


@pytest.mark.parametrize(
    ("passed_s", "angle", "detail"),
    [
        (PERIOD_S, 76.9, ""),
        (PERIOD_S, 77.1, "module 3 by 77 degrees, at most 77"),
        (2 * PERIOD_S, 77.1, "module 3 by 77 degrees, at most 77"),
        (0.1, 22.9, ""),
        (0.1, 23.1, "module 3 by 23 degrees, at most 23"),
    ],
)
def test_module_moves_by_the_largest_actuation_step_and_the_noise_at_most(passed_s, angle, detail):
    """180 degrees times a step of 0.4 in each period, and 5 degrees."""
    validator, now_s = FrameValidator(ROBOT), 50.0 + passed_s
    assert validator.check(tracker_frame(3000, 50.0), 50.0).good
    check = validator.check(tracker_frame(3000 + round(60 * passed_s), now_s, (0.0, 0.0, angle)), now_s)
    assert (check.good, check.detail) == (not detail, detail)


def test_movement_at_the_limit_is_accepted(monkeypatch):
    validator = settled()
    monkeypatch.setattr(safety, "angle_between_deg", lambda *configurations: np.array([0.0, 5.0, 0.0]))
    assert validator.check(tracker_frame(1, 0.0), 0.0).good


def checks(validator, robot_poses):
    """The status of one frame a period for each entry."""
    frames = [tracker_frame(24 * step, step * PERIOD_S, poses=poses) for step, poses in enumerate(robot_poses, 1)]
    return [validator.check(frame, frame.monotonic_s).status for frame in frames]


def test_valid_frame_between_jumps_starts_the_confirmation_again():
    jump, still = planar_poses((0.0, 0.0, 90.0)), planar_poses(STRAIGHT)
    statuses = checks(settled(), [jump, jump, still, jump, jump, jump, jump])
    assert statuses == [safety.JUMP, safety.JUMP, "good", safety.JUMP, safety.JUMP, safety.JUMP, "good"]


def test_confirming_frames_are_compared_with_the_one_before():
    """A module that is bent by 90 degrees and swings by 60 degrees a period."""
    swinging = []
    for azimuth in np.radians([0.0, 60.0, 120.0, 180.0]):
        turn = np.eye(4)
        turn[:2, :2] = [[np.cos(azimuth), -np.sin(azimuth)], [np.sin(azimuth), np.cos(azimuth)]]
        poses = planar_poses((0.0, 0.0, 90.0))
        poses[3] = turn @ poses[3]
        swinging.append(poses)
    assert checks(settled(in_space()), swinging) == [safety.JUMP] * 3 + ["good"]


# ---- the model's actuation


@pytest.mark.parametrize("value", [3.0, -3.0, 2.9])
def test_actuation_up_to_three_is_limited_later(value):
    check_actuation(np.array([[0.1], [value], [0.0]]))


@pytest.mark.parametrize(
    ("value", "message"),
    [(np.nan, "is not finite"), (-np.inf, "is not finite"), (3.01, "is 3.01,"), (-40.0, "is -40,")],
)
def test_refused_actuation_is_reported_with_its_cause(value, message):
    with pytest.raises(ModelError, match=message):
        check_actuation(np.array([[0.1], [value], [0.0]]))


# ---- rest


def configuration(*z):
    """Configurations (N, 3) with these components along the module's axis."""
    return np.array([[np.sqrt(max(0.0, 1.0 - each**2)), 0.0, each] for each in z])


def test_rounding_of_a_straight_or_reversed_module_is_no_error():
    with np.errstate(invalid="raise"):
        check_rest(configuration(1.0, 1.0 + 1e-9, 1.0), planar_poses(STRAIGHT))
        with pytest.raises(Tripped, match="module 2 is at 180 degrees"):
            check_rest(configuration(1.0, -1.0 - 1e-9, 1.0), planar_poses(STRAIGHT))


def test_bend_at_the_limit_is_at_rest(monkeypatch):
    bent = configuration(1.0, 0.5, 1.0)
    monkeypatch.setattr(safety, "REST_LIMIT_DEG", np.degrees(np.arccos(0.5)))
    check_rest(bent, planar_poses(STRAIGHT))
    monkeypatch.setattr(safety, "REST_LIMIT_DEG", 59.9)
    with pytest.raises(Tripped, match="module 2 is at 60 degrees"):
        check_rest(bent, planar_poses(STRAIGHT))


@pytest.mark.parametrize(
    ("heights_mm", "message"),
    [
        ((0.0, 85.0, 85.5, 86.0), None),
        ((0.0, 85.0, 85.0, 170.0), "tool of module 2 hangs -?0 mm behind that of module 1"),
        ((0.0, 85.0, 85.5, 80.5), "tool of module 3 hangs 5 mm behind that of module 2"),
    ],
)
def test_each_tool_is_further_along_than_the_one_before(heights_mm, message):
    poses = straight_poses(*heights_mm)
    if message is None:
        check_rest(configuration(1.0, 1.0, 1.0), poses)
        return
    with pytest.raises(Tripped, match=message):
        check_rest(configuration(1.0, 1.0, 1.0), poses)
