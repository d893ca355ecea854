"""The robot's frame from bends: how the base's tool is mounted."""

import msgspec
import numpy as np
import pytest
from tools_at_rest import DATE, ERRORS, Tracker, bent_poses, measured, straight

from modsoft.runtime.calibration import base, file, rest, rotations
from modsoft.runtime.calibration.mounting import Mounting
from modsoft.runtime.control.features import from_poses
from modsoft.runtime.errors import Tripped

MODULES = 3


class Robot:
    """A robot whose tools are mounted with errors, that of the base too, and its calibration at rest."""

    def __init__(self, seed, planar, errors=ERRORS):
        self.rng, self.planar = np.random.default_rng(seed), planar
        self.errors = errors._replace(seed=seed)
        axis = self.rng.normal(size=3)
        self.base = np.eye(4)
        self.base[:3, :3] = rotations.matrix(axis / np.linalg.norm(axis) * self.rng.uniform(3.0, 10.0))
        tracker = Tracker(self.errors, change=lambda number, poses: {"poses": self.with_base(poses)})
        self.calibration = rest.calibrated(measured(tracker.measure(MODULES)), "arm", None)

    def with_base(self, poses):
        poses[0] = poses[0] @ self.base
        return poses

    def bends(self, count, largest_deg=40.0):
        """Rotation vectors (count, N, 3) of bends."""
        vectors = np.zeros((count, MODULES, 3))
        axes = [1] if self.planar else [0, 1]
        vectors[..., axes] = self.rng.uniform(-largest_deg, largest_deg, (count, MODULES, len(axes)))
        return vectors

    def seen(self, bends):
        """Poses (K, T, 4, 4) that the tracker sees."""
        poses = (self.errors.measured(2000 + number, bent_poses(each).tolist()) for number, each in enumerate(bends))
        return np.array([self.with_base(np.array(each)) for each in poses])

    def aligned(self, bends):
        frame = base.frame_of(self.seen(bends), self.calibration, self.planar)
        return base.aligned(frame, self.calibration, self.planar, DATE)


@pytest.mark.parametrize("planar", [True, False], ids=["planar", "spatial"])
def test_bends_show_the_axis_of_the_robot_in_spite_of_noise(planar):
    """Which is y of a planar robot and z of a spatial one."""
    for seed in range(5):
        robot = Robot(seed, planar)
        calibration = robot.aligned(robot.bends(200))
        left = rotations.matrix(np.array(calibration.base.rotation_deg)) @ robot.base[:3, :3].T
        axis = left[1, 1] if planar else left[2, 2]
        assert np.degrees(np.arccos(min(1.0, axis))) < 0.3
        assert calibration.base.rotation_date == DATE
        assert calibration.base.rotation_residual_deg == pytest.approx(1.0 if planar else 0.7, abs=0.2)  # of the noise


def test_configurations_of_a_planar_robot_are_in_its_plane():
    robot = Robot(7, planar=True, errors=ERRORS._replace(noise_deg=0.0, noise_mm=0.0))
    poses, expected = robot.seen(robot.bends(50)), from_poses(bent_poses(robot.bends(1)[0]))
    assert expected.shape == (MODULES, 3)
    for calibration, largest in ((robot.aligned(robot.bends(50)), 1e-4), (robot.calibration, None)):
        mounting = Mounting(calibration, MODULES)
        across = max(np.abs(from_poses(mounting.corrected(each))[:, 1]).max() for each in poses)
        assert across < largest if largest else across > 0.02


def test_rotation_of_earlier_bends_has_no_effect():
    robot = Robot(3, planar=False)
    poses = robot.seen(robot.bends(100))
    turned = msgspec.structs.replace(robot.calibration.base, rotation_deg=(10.0, 20.0, 30.0))
    before = msgspec.structs.replace(robot.calibration, base=turned)
    expected = base.frame_of(poses, robot.calibration, False).rotation
    np.testing.assert_allclose(base.frame_of(poses, before, False).rotation, expected, atol=1e-12)


def test_calibration_with_a_frame_is_read_back(tmp_path):
    calibration = Robot(1, planar=True).aligned(Robot(1, planar=True).bends(50))
    file.write(tmp_path / "c.toml", calibration)
    assert file.read(tmp_path / "c.toml") == calibration


@pytest.mark.parametrize(
    ("planar", "change", "message"),
    [
        (True, lambda bends: 0.1 * bends, "expected at least 10 in its plane; bend every module further"),
        (False, lambda bends: bends * [1.0, 0.05, 1.0], "expected at least 5 in every direction"),
        (True, lambda bends: bends[..., [1, 1, 2]] * [2.0, 1.0, 1.0], "frame, expected at most 45"),
        (True, lambda bends: bends + np.abs(bends[..., [1, 0, 2]]), "of them about other axes, expected at most"),
        (False, lambda bends: bends[..., [2, 0, 1]], "frame, expected at most 45"),
    ],
    ids=["small", "one direction", "diagonal", "not in a plane", "twisted"],
)
def test_bends_that_do_not_show_the_frame_are_refused(planar, change, message):
    robot = Robot(2, planar, ERRORS._replace(mounting_deg=0.0))
    with pytest.raises(Tripped) as raised:
        robot.aligned(change(robot.bends(100)))
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


def test_straight_robot_shows_no_frame():
    robot = Robot(2, planar=True)
    with pytest.raises(Tripped, match=r"found bends of [01]\."):
        robot.aligned([straight()] * 50)


def test_robot_at_rest_without_any_error_shows_no_frame():
    """Its bends are exactly 0, by which nothing is divided."""
    exact = ERRORS._replace(**{name: 0.0 for name in ERRORS._fields if name != "seed"})
    calibration = rest.calibrated(measured(Tracker(exact).measure(MODULES)), "arm", None)
    with np.errstate(all="raise"):
        frame = base.frame_of(np.tile(np.eye(4), (30, MODULES + 1, 1, 1)), calibration, True)
    with pytest.raises(Tripped, match=r"found bends of 0\.0 degrees"):
        base.aligned(frame, calibration, True, DATE)
