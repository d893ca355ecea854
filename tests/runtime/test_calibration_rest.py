"""Calibration at rest: mounting errors are removed from configurations, and what is no rest is refused."""

import re

import msgspec
import numpy as np
import pytest
from tools_at_rest import ERRORS, NOISE, Tracker, bent_poses, calibrated, measured, straight

from modsoft.hil.tool_errors import ToolErrors
from modsoft.runtime.calibration import rest, rotations
from modsoft.runtime.calibration.measure import at_rest
from modsoft.runtime.calibration.mounting import Mounting
from modsoft.runtime.control.features import angle_between_deg, bending_error_deg, from_poses
from modsoft.runtime.errors import DeviceAbsent, Tripped


def refusal(call, kind=Tripped):
    with pytest.raises(kind) as raised:
        call()
    assert "\n" not in str(raised.value)
    return str(raised.value)


# ---- Rotations


def test_rotation_vector_and_matrix_are_inverse():
    rng = np.random.default_rng(1)
    vectors = rng.normal(size=(200, 3))
    vectors *= rng.uniform(0.0, 180.0, (200, 1)) / np.linalg.norm(vectors, axis=1, keepdims=True)
    vectors = np.concatenate([vectors, 1e-9 * vectors, [[0.0, 0.0, 0.0]]])
    np.testing.assert_allclose(rotations.vector_deg(rotations.matrix(vectors)), vectors, atol=1e-9)
    np.testing.assert_allclose(rotations.matrix(np.array([0.0, 90.0, 0.0])) @ [0, 0, 1], [1, 0, 0], atol=1e-15)


def test_mean_rotation_is_a_rotation_and_needs_no_common_half():
    rng = np.random.default_rng(2)
    about = rotations.matrix(rng.normal(0.0, 60.0, (4, 3)))
    turns = about @ rotations.matrix(rng.normal(0.0, 5.0, (500, 4, 3)))
    mean = rotations.mean(turns)
    np.testing.assert_allclose(mean @ np.swapaxes(mean, -1, -2), np.tile(np.eye(3), (4, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(mean), 1.0)
    assert rotations.angle_deg(np.swapaxes(about, -1, -2) @ mean).max() < 1.0
    half_turns = rotations.matrix(np.array([[0.0, 179.0, 0.0], [0.0, -179.0, 0.0]]))  # entries average to no rotation
    np.testing.assert_allclose(rotations.angle_deg(rotations.mean(half_turns)), 180.0, atol=1e-6)


# ---- Mounting


def config_errors(modules, planar, seed):
    """Mean configuration error of random bends, degrees: calibrated, of the noise alone, without calibration."""
    errors, noise, rng = ERRORS._replace(seed=seed), NOISE._replace(seed=seed), np.random.default_rng(seed)
    mounting = Mounting(calibrated(errors, modules)[0], modules)
    between = bending_error_deg if planar else angle_between_deg
    sums = np.zeros(3)
    for number in range(1000, 1040):
        bends = straight(modules)
        axes = [1] if planar else [0, 1]
        bends[:, axes] = rng.uniform(-60.0, 60.0, (modules, len(axes)))
        poses = bent_poses(bends)
        seen = np.array(errors.measured(number, poses.tolist()))
        noisy = np.array(noise.measured(number, poses.tolist()))
        sums += [
            between(from_poses(each), from_poses(poses)).mean() for each in (mounting.corrected(seen), noisy, seen)
        ]
    return sums / 40


@pytest.mark.parametrize("planar", [True, False], ids=["planar", "spatial"])
@pytest.mark.parametrize("modules", [2, 3, 6])
def test_error_after_calibration_is_nearly_that_of_the_noise(modules, planar):
    """Mounting errors of up to 10 degrees and 5 mm, noise of 0.5 degree and 0.1 mm. At most 1.2 in each trial."""
    corrected, noise, raw = np.array([config_errors(modules, planar, seed) for seed in range(4)]).T
    print(
        f"{modules} modules: at most {(corrected / noise).max():.3f} of the error by noise, without calibration {raw}"
    )
    assert (corrected / noise).max() <= 1.2
    assert raw.mean() > 2.0 * noise.mean()


def test_mounting_error_of_the_rest_is_removed_with_its_translation():
    errors = ERRORS._replace(noise_deg=0.0, noise_mm=0.0)
    calibration, measurement = calibrated(errors, 4)
    mounting = Mounting(calibration, 4)
    ends = np.linalg.inv(measurement.poses[0]) @ mounting.corrected(measurement.poses)
    np.testing.assert_allclose(ends[:, :3, :3], np.tile(np.eye(3), (5, 1, 1)), atol=1e-5)
    steps = np.diff(ends[1:, :3, 3], axis=0)
    np.testing.assert_allclose(steps, np.tile(steps.mean(axis=0), (3, 1)), atol=1e-4)
    np.testing.assert_allclose(steps[:, :2], 0.0, atol=1e-4)
    for tool in range(1, 5):
        expected = np.array(errors.mounted(tool, np.eye(4).tolist()))[:3, :3]
        assert rotations.angle_deg(expected.T @ mounting.in_ends[tool, :3, :3]) < 1e-3


def test_rotation_of_the_base_turns_the_frame_of_the_robot():
    calibration, _ = calibrated(NOISE._replace(noise_deg=0.0, noise_mm=0.0))
    turned = msgspec.structs.replace(calibration.base, rotation_deg=(0.0, 0.0, 90.0))  # tool's x along the robot's y
    mounting = Mounting(msgspec.structs.replace(calibration, base=turned), 3)
    poses = bent_poses([[0.0, 30.0, 0.0]] * 3)
    expected = [[0.0, 0.5, np.cos(np.radians(30.0))]] * 3  # the tool's x direction
    np.testing.assert_allclose(from_poses(mounting.corrected(poses)), expected, atol=1e-6)


def test_shorter_robot_uses_the_first_entries():
    calibration, measurement = calibrated(modules=4)
    poses = measurement.poses[:3]
    corrected = Mounting(calibration, 2).corrected(poses)
    np.testing.assert_allclose(from_poses(corrected), [[0.0, 0.0, 1.0]] * 2, atol=1e-5)


def test_only_the_given_module_is_calibrated_again():
    before, _ = calibrated()
    moved = ERRORS._replace(seed=9)
    tools = Tracker(ERRORS).measure()
    others = Tracker(moved).measure()
    for name in ("rotations", "positions_mm"):
        getattr(tools, name)[2] = getattr(others, name)[2]
    after = rest.calibrated(measured(tools), "arm", before, [2])
    assert (after.base, after.modules[0], after.modules[2]) == (before.base, before.modules[0], before.modules[2])
    assert after.modules[1].rotation_deg != before.modules[1].rotation_deg
    Mounting(after, 3).check_rest(measured(tools).poses)


def test_added_module_gets_an_entry():
    before = rest.calibrated(measured(Tracker(bends=lambda at_s: straight(2)).measure(2)), "arm", None)
    after = rest.calibrated(measured(Tracker().measure()), "arm", before, [3])
    assert after.modules[:2] == before.modules
    assert len(after.modules) == 3


def test_moved_tool_of_another_module_is_refused():
    before, _ = calibrated()
    tools = Tracker(ERRORS).measure()
    tools.rotations[1] = tools.rotations[1] @ rotations.matrix(np.array([0.0, 0.0, 8.0]))
    message = refusal(lambda: rest.calibrated(measured(tools), "arm", before, [3]))
    assert "module 1 hangs 8 degrees from where it hung at the calibration on 2026" in message
    assert "rest --module 1" in message


def test_rotation_of_the_base_is_kept_for_the_same_tool_only():
    before, _ = calibrated()
    turned = msgspec.structs.replace(before.base, rotation_deg=(0.0, 0.0, 5.0))
    before = msgspec.structs.replace(before, base=turned)
    tools = Tracker().measure()
    assert rest.calibrated(measured(tools), "arm", before).base.rotation_deg == (0.0, 0.0, 5.0)
    other = measured(tools, [f"{tool:064x}" for tool in (9, 1, 2, 3)])
    assert rest.calibrated(other, "arm", before).base.rotation_deg == (0.0, 0.0, 0.0)


def test_noise_replaces_only_the_noise():
    before, _ = calibrated()
    measurement = measured(Tracker(ERRORS._replace(noise_deg=0.1)).measure())
    after = rest.with_noise(measurement, before)
    assert [entry.noise_deg for entry in after.modules] == pytest.approx([0.1] * 3, rel=0.2)
    assert [entry.rotation_deg for entry in after.modules] == [entry.rotation_deg for entry in before.modules]
    assert after.base.date == before.base.date


# ---- Measuring


def test_noise_is_the_standard_deviation_of_one_axis():
    tools = Tracker().measure(count=400)
    np.testing.assert_allclose(tools.noise_deg, 0.5, rtol=0.1)
    np.testing.assert_allclose(tools.noise_mm, 0.1, rtol=0.1)
    assert (tools.residual_deg < 0.25).all()


def test_residual_shows_a_drift():
    poses = np.array([bent_poses([[0.0, 0.0, 0.0], [0.0, angle, 0.0]]) for angle in np.linspace(0.0, 1.0, 100)])
    tools = at_rest(poses)
    np.testing.assert_allclose(tools.residual_deg, [0.0, 0.0, 0.4], atol=0.01)


def test_mounting_errors_within_the_limits_are_accepted():
    for seed in range(8):
        for modules in (2, 5):
            still = Tracker(ERRORS._replace(seed=seed), lambda at_s, modules=modules: straight(modules))
            rest.calibrated(measured(still.measure(modules, count=20)), "arm", None)


@pytest.mark.parametrize(
    ("bends", "message"),
    [
        (lambda at_s: [[0.0, 3.0 * np.sin(6.0 * at_s), 0.0]] * 3, "moves: residual"),
        (lambda at_s: [[0.0, 1.0 * (at_s - 100.0), 0.0]] * 3, "moves: residual"),
        (lambda at_s: [[0.0, 0.0, 0.0], [0.0, 6.0 * np.sin(100.0 * at_s), 0.0], [0.0] * 3], "with a noise of 2."),
    ],
    ids=["swings", "drifts", "vibrates"],
)
def test_moving_robot_is_refused(bends, message):
    assert message in refusal(lambda: Tracker(bends=bends).measure())


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("bent", [[1], [2], [3], [1, 2, 3]])
def test_robot_that_is_not_straight_is_refused(axis, bent):
    bends = straight()
    bends[np.array(bent) - 1, axis] = 36.0 if len(bent) == 1 else 15.0
    errors = ERRORS._replace(noise_mm=0.0)
    message = refusal(lambda: calibrated_bent(errors, bends))
    assert "let the vented robot hang straight" in message


def calibrated_bent(errors, bends):
    return rest.calibrated(measured(Tracker(errors, lambda at_s: bends).measure()), "arm", None)


def test_tools_in_a_wrong_order_are_refused():
    swapped = [0, 2, 1, 3]
    tracker = Tracker(NOISE, change=lambda number, poses: {"poses": poses[swapped]})
    message = refusal(lambda: rest.calibrated(measured(tracker.measure()), "arm", None))
    assert "the tool of module 2 hangs behind that of module 1" in message


def test_tilted_tool_of_the_base_is_refused():
    tilt = np.eye(4)
    tilt[:3, :3] = rotations.matrix(np.array([24.0, 0.0, 0.0]))
    tracker = Tracker(NOISE, change=lambda number, poses: {"poses": np.array([poses[0] @ tilt, *poses[1:]])})
    message = refusal(lambda: rest.calibrated(measured(tracker.measure()), "arm", None))
    assert "the line through the tools is 24 degrees off the z axis of the base's tool" in message


def test_hidden_tool_is_named_after_some_seconds():
    hidden = Tracker(change=lambda number, poses: {"valid": np.array([True, True, number < 30, True])})
    message = refusal(hidden.measure, DeviceAbsent)
    assert "29 of 100 valid frames" in message
    assert "the last one tool hidden (module 2); are all tools in view?" in message
    assert hidden.time_s - 100.0 == pytest.approx(30 / 60 + 5.0, abs=0.1)


def test_tool_that_is_hidden_now_and_then_only_takes_longer():
    flickers = Tracker(change=lambda number, poses: {"valid": np.array([True, True, number % 3 == 0, True])})
    assert flickers.measure().frames == 100


def test_too_few_frames_in_a_minute_are_refused():
    slow = Tracker(ToolErrors(), change=lambda number, poses: {"valid": np.full(4, number % 60 == 0)})
    assert "of 100 valid frames in 60 s" in refusal(slow.measure, DeviceAbsent)


def test_lost_tracker_is_refused():
    tracker = Tracker()
    tracker.frames.error = OSError("unplugged")
    assert "unplugged" in refusal(tracker.measure, DeviceAbsent)


def test_report_states_mounting_noise_and_what_marker_noise_costs():
    calibration, measurement = calibrated()
    tools = measurement.tools._replace(noise_mm=np.array([0.1, 0.25, 0.1, 0.1]))
    lines = rest.report(measurement._replace(tools=tools), calibration)
    assert re.match(
        r"base: mounted 0.0 degrees and 0.0 mm off, noise 0\.\d\d degrees and 0.10 mm, residual 0", lines[0]
    )
    assert "0.95 at 15 mm, 0.48 at 30 mm, 0.24 at 60 mm" in lines[-1]
    assert len(rest.report(measurement)) == 5
