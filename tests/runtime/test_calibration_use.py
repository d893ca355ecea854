"""The calibration that a run uses: chosen, checked, applied to every frame, reported and stored with the log."""

import dataclasses
from pathlib import Path

import msgspec
import numpy as np
import pytest
from tools_at_rest import DATE, ERRORS, Tracker, bent_poses, calibrated, of_modules
from virtual_loop import World

from modsoft.runtime import devices, log
from modsoft.runtime import robot as robot_file
from modsoft.runtime.calibration import file, rotations
from modsoft.runtime.calibration.use import UsedCalibration, used_by
from modsoft.runtime.control.features import from_poses
from modsoft.runtime.errors import DeviceAbsent, ModelError, Tripped, UsageError
from modsoft.runtime.safety import FrameValidator

ROBOT = of_modules(3)


@pytest.fixture
def folder(tmp_path):
    """A robot file with tool definition files, and its calibration."""
    (tmp_path / "robot.toml").touch()
    for path in tools(tmp_path):
        path.write_bytes(path.name.encode())
    calibration, _ = calibrated()
    entries = [calibration.base, *calibration.modules]
    hashes = file.sha256_of(tools(tmp_path))
    entries = [msgspec.structs.replace(entry, tool_sha256=each) for entry, each in zip(entries, hashes, strict=True)]
    calibration = msgspec.structs.replace(calibration, base=entries[0], modules=tuple(entries[1:]))
    file.write(tmp_path / "robot.calibration.toml", calibration)
    return tmp_path


def tools(folder, modules=3):
    return [folder / "base.rom", *(folder / f"module-{number}.rom" for number in range(1, modules + 1))]


def used(folder, robot=ROBOT, port="/dev/tracker", paths=None, **options):
    return used_by(robot, folder / "robot.toml", port, tools(folder) if paths is None else paths, **options)


def replaying(robot=ROBOT):
    table = robot.to_dict()
    table["tracker"]["source"] = "replay"
    return robot_file.from_dict(table)


def test_file_beside_the_robot_file_is_used(folder):
    calibration = used(folder)
    assert calibration.path == folder / "robot.calibration.toml"
    assert calibration.text == calibration.path.read_text()
    assert str(calibration).startswith(f"calibration {calibration.path} of 2026-11-28: noise of the tools at most 0.5")


def test_without_a_file_there_is_no_calibration(tmp_path):
    assert used(tmp_path, paths=[]) is None
    assert used(tmp_path, replaying()) is None


def test_file_of_the_option_has_precedence_and_must_exist(folder):
    other = folder / "other.toml"
    with pytest.raises(ModelError, match="run modsoft-calibrate rest"):
        used(folder, option=other)
    other.write_bytes((folder / "robot.calibration.toml").read_bytes())
    assert used(folder, option=other).path == other
    assert used(folder, option=Path("none")) is None


def test_calibration_of_another_robot_or_of_other_tools_is_refused(folder):
    with pytest.raises(ModelError, match="found the calibration of robot 'arm', expected that of 'other'"):
        used(folder, of_modules(3, "other"))
    (folder / "module-2.rom").write_bytes(b"another tool")
    with pytest.raises(ModelError, match="run modsoft-calibrate rest --module 2"):
        used(folder)


def test_missing_tool_files_are_reported_as_without_a_calibration(folder):
    with pytest.raises(UsageError, match="0 tool definition files, the robot needs 4"):
        used(folder, paths=[])
    (folder / "module-1.rom").unlink()
    with pytest.raises(DeviceAbsent, match="does not exist"):
        used(folder)


def test_shorter_robot_uses_the_first_entries(folder):
    assert len(used(folder, of_modules(2), paths=tools(folder, 2)).mounting.in_ends) == 3


def test_recorded_frames_are_corrected_by_the_calibration_of_their_run(folder):
    run = folder / "runs" / "1"
    run.mkdir(parents=True)
    assert used(folder, replaying(), str(run), []) is None
    (run / "calibration.toml").write_bytes((folder / "robot.calibration.toml").read_bytes())
    for port in (run, run / "run.jsonl"):
        assert used(folder, replaying(), str(port), []).path == run / "calibration.toml"


# ---- In a run


def at_rest(calibration, errors=ERRORS, moved=None, **options):
    """`Devices` whose tracker sees the robot at rest; `moved`: tool and rotation vector since the calibration."""

    def change(number, poses):
        if moved is not None:
            poses[moved[0], :3, :3] = poses[moved[0], :3, :3] @ rotations.matrix(np.array(moved[1]))
        return {"poses": poses}

    tracker = Tracker(errors, change=change, **options)
    use = UsedCalibration("c", "", calibration, 3)
    tracker.wait(0.0)
    return devices.Devices(ROBOT, tracker.frames, None, tracker.now, tracker.wait, use)


def test_rest_is_straight_after_calibration():
    rig = at_rest(calibrated()[0])
    configuration = rig.rest(rig.validator())
    np.testing.assert_allclose(configuration, [[0.0, 0.0, 1.0]] * 3, atol=0.04)  # noise of 0.5 degree


@pytest.mark.parametrize("tool", [0, 1, 2, 3])
@pytest.mark.parametrize("turn", [(8.0, 0.0, 0.0), (0.0, -8.0, 0.0), (0.0, 0.0, 8.0)])
def test_tool_that_moved_since_the_calibration_is_refused(tool, turn):
    rig = at_rest(calibrated()[0], moved=(tool, turn))
    with pytest.raises(Tripped, match=rf"module {max(tool, 1)} hangs [6789] degrees from where it hung .* on {DATE}"):
        rig.rest(rig.validator())


def test_small_motion_of_a_tool_is_not_refused():
    rig = at_rest(calibrated()[0], moved=(2, (2.0, 0.0, 0.0)))
    rig.rest(rig.validator())


def test_without_calibration_mounting_is_not_checked():
    tracker = Tracker()
    tracker.wait(0.0)
    rig = devices.Devices(ROBOT, tracker.frames, None, tracker.now, tracker.wait)
    raw = rig.rest(rig.validator())
    np.testing.assert_array_equal(raw, from_poses(tracker.frames.latest().poses))


def test_loop_uses_corrected_poses_and_logs_raw_ones():
    calibration, _ = calibrated(ERRORS._replace(noise_deg=0.0, noise_mm=0.0))
    mounting = UsedCalibration("c", "", calibration, 3).mounting
    world = World(steps=3)
    poses = np.array(
        ERRORS._replace(noise_deg=0.0, noise_mm=0.0).measured(0, bent_poses([[0.0, 5.0, 0.0]] * 3).tolist())
    )
    whole = world.frame
    world.frame = lambda: dataclasses.replace(whole(), poses=poses)
    world.loop = dataclasses.replace(world.loop, validator=FrameValidator(world.robot, mounting.corrected))
    world.run()
    for record in world.ticks:
        np.testing.assert_array_equal(record.frame.poses, poses)
        expected = [[np.sin(np.radians(5.0)), 0.0, np.cos(np.radians(5.0))]] * 3
        np.testing.assert_allclose(record.configuration, expected, atol=1e-5)


def test_calibration_is_stored_with_the_run(tmp_path):
    text = file.text_of(calibrated()[0])
    stored = log.RunLog(tmp_path, "arm", "", {}, calibration=text)
    assert (stored.folder / "calibration.toml").read_text() == text
    assert not (log.RunLog(tmp_path, "arm", "", {}).folder / "calibration.toml").exists()
