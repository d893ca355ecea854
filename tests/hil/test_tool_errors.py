"""Mounting errors and noise of the fake tracker's tools."""

import subprocess
import sys
from pathlib import Path

import numpy as np
from tools_at_rest import bent_poses, straight

from modsoft.hil.child import Child
from modsoft.hil.polaris import write_tool_files
from modsoft.hil.polaris_device import Polaris
from modsoft.hil.tool_errors import ToolErrors
from modsoft.runtime import robot as robot_file
from modsoft.runtime.calibration import file, rotations
from modsoft.runtime.calibration.mounting import Mounting

STRAIGHT = np.tile(np.eye(4), (4, 1, 1))
STRAIGHT[:, 2, 3] = 85.0 * np.arange(4)


def off(errors, poses=STRAIGHT, number=0):
    """Angles (T,) in degrees and distances (T,) in mm of the measured poses from the true ones."""
    off = np.linalg.inv(poses) @ np.array(errors.measured(number, poses.tolist()))
    return rotations.angle_deg(off[:, :3, :3]), np.linalg.norm(off[:, :3, 3], axis=1)


def test_without_errors_poses_are_exact():
    assert ToolErrors().measured(7, STRAIGHT.tolist()) == STRAIGHT.tolist()


def test_mounting_errors_are_those_of_module_tools_in_every_frame():
    seen = np.array([off(ToolErrors(10.0, 5.0, seed=seed)) for seed in range(100)])  # (seed, angle or distance, tool)
    assert (seen[:, :, 0] == 0.0).all()
    assert 9.0 < seen[:, 0, 1:].max() <= 10.0
    assert 4.5 < seen[:, 1, 1:].max() <= 5.0
    turned = STRAIGHT @ np.diag([-1.0, -1.0, 1.0, 1.0])
    np.testing.assert_allclose(off(ToolErrors(10.0, 5.0), turned, number=9), off(ToolErrors(10.0, 5.0)), atol=1e-6)


def test_noise_has_the_standard_deviation_on_each_axis_and_differs_between_frames():
    errors = ToolErrors(noise_deg=0.5, noise_mm=0.1)
    seen = np.array([errors.measured(number, STRAIGHT.tolist()) for number in range(500)])
    vectors = rotations.vector_deg(seen[..., :3, :3])
    np.testing.assert_allclose(vectors.std(axis=0), 0.5, rtol=0.15)
    np.testing.assert_allclose(seen[..., :3, 3].std(axis=0), 0.1, rtol=0.15)
    assert errors.measured(3, STRAIGHT.tolist()) == seen[3].tolist()
    assert errors._replace(seed=1).measured(3, STRAIGHT.tolist()) != seen[3].tolist()


def test_fake_tracker_reports_poses_with_errors():
    errors = ToolErrors(10.0, 5.0, 0.5, 0.1, seed=3)
    device = Polaris(lambda: 0.0, errors=errors)
    device.take({"poses": STRAIGHT.tolist()})
    assert device._frame() == (0, errors.measured(0, STRAIGHT.tolist()))


def test_unmodified_client_calibrates_the_fake_tracker(tmp_path):
    """modsoft-calibrate rest in a process of its own, on the tracker of the rig."""
    (tmp_path / "robot.toml").write_text(robot_file.text_of("pneumatic-3"))
    tools = [option for path in write_tool_files(tmp_path, 4) for option in ("--tool", path.name)]
    fake = ["--link", str(tmp_path / "ttyPolaris"), "--unpaced", "--errors", "10", "5", "0.5", "0.1", "3"]
    child = Child("modsoft.hil.polaris", fake, lambda line: None)
    try:
        child.wait_ready()
        child.send({"poses": bent_poses(straight()).tolist()})
        command = [Path(sys.executable).parent / "modsoft-calibrate", "rest", "--yes", "--tracker-port", "ttyPolaris"]
        done = subprocess.run([*command, *tools], cwd=tmp_path, capture_output=True, text=True, check=False)
    finally:
        child.stop()
    assert done.returncode == 0, done.stderr
    calibration = file.read(tmp_path / "robot.calibration.toml")
    assert calibration.modules[2].device == "Polaris Spectra Rev 009, serial number P7-00000"
    mounting = Mounting(calibration, 3).in_ends
    for tool in range(1, 4):
        expected = np.array(ToolErrors(10.0, 5.0, seed=3).mounted(tool, np.eye(4).tolist()))
        assert rotations.angle_deg(expected[:3, :3].T @ mounting[tool, :3, :3]) < 0.4  # four times that of 100 frames
