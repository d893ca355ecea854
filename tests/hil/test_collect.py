"""Collection through the real loop, firmware and tracker, on the stepped rig with a robot without dynamics."""

import json
import shutil
import signal

import h5py
import numpy as np
import pytest
from rigid_arm import RigidArm
from tools_at_rest import calibrated

from modsoft.hil import collect as rig_collect
from modsoft.hil.collect import collect_on_rig
from modsoft.hil.tool_errors import ToolErrors
from modsoft.runtime import robot as robot_file
from modsoft.runtime.calibration import file
from modsoft.runtime.calibration.use import UsedCalibration
from modsoft.runtime.control.actuation import pressures_bar
from modsoft.runtime.control.features import angle_between_deg, from_poses
from modsoft.runtime.devices import Devices
from modsoft.runtime.errors import LostInRun, ModelError, OutputError
from modsoft.runtime.stop import Interrupted, Paused, StopKey
from modsoft.training.data import dataset, measure, recording
from modsoft.training.data.actions import draw_actions

ROBOT = robot_file.load("pneumatic-3")
STEPS, REST = 6, 3  # control steps of an episode, and before each


@pytest.fixture(autouse=True)
def short_rest(monkeypatch):
    monkeypatch.setattr(recording, "REST_S", 0.0)


def collect(out, samples=2 * STEPS, **options):
    return collect_on_rig(ROBOT, out, samples, steps=STEPS, arm=RigidArm(3), **options)


def interrupting(monkeypatch, tick, act):
    """Calls act(devices) when the control step of this number has been logged; later steps are not disturbed."""
    done = []

    def observed(self, samples, record, add=measure.Progress.add):
        add(self, samples, record)
        if getattr(record, "tick", None) == tick and not done:
            done.append(True)
            act(self.devices)

    def drive(self, *arguments, drive=Devices.drive, **options):
        measure.Progress.devices = self
        drive(self, *arguments, **options)

    monkeypatch.setattr(measure.Progress, "add", observed)
    monkeypatch.setattr(Devices, "drive", drive)


def planned(episode):
    seed = np.random.SeedSequence(0, spawn_key=(episode, 0))
    return draw_actions(ROBOT, "staged", STEPS, np.random.default_rng(seed))


def run_folders(out):
    return sorted(out.with_name(f"{out.name}.runs").glob("*/run.jsonl"))


def test_data_set_holds_what_the_board_applied_and_the_robot_did(tmp_path):
    header, samples = collect(tmp_path / "d.h5")
    data = dataset.read(tmp_path / "d.h5")
    assert (samples, data.samples, header.episodes) == (2 * STEPS, 2 * STEPS, 2)
    assert data.action.shape == (2, STEPS, 3, 1)
    for episode in range(2):
        np.testing.assert_allclose(data.action[episode], planned(episode), atol=2e-4)  # the board's resolution: 10 Pa
        assert np.abs(data.action[episode] - planned(episode)).max() > 0.0
        arm = RigidArm(3)
        for step in range(STEPS):
            arm.set_pressures(pressures_bar(ROBOT, data.action[episode, step]))
            off_deg = angle_between_deg(data.configuration[episode, step + 1], arm.configuration)
            assert off_deg.max() < 0.1
    assert np.abs(data.configuration[:, 0, :, 0]).max() < 1e-3  # at rest


def test_data_set_holds_raw_poses_measured_times_and_its_clock(tmp_path):
    collect(tmp_path / "d.h5", errors=ToolErrors(noise_deg=0.1, noise_mm=0.1))
    data = dataset.read(tmp_path / "d.h5")
    assert data.generation["source"] == "rig"
    assert data.generation["clock"] == "emulated"
    assert data.generation["tool_errors"]["noise_deg"] == 0.1
    assert data.generation["module_length_m"] == pytest.approx(0.05, abs=0.001)
    with h5py.File(tmp_path / "d.h5") as file:
        poses, time_s = file["poses"][:], file["time_s"][:]
    np.testing.assert_allclose(from_poses(poses[0, 3]), data.configuration[0, 3], atol=1e-8)
    assert np.diff(time_s, axis=1) == pytest.approx(0.4, abs=0.02)
    assert np.ptp(np.diff(time_s, axis=1)) > 0.0  # measured, not counted
    assert time_s[1, 0] - time_s[0, -1] == pytest.approx(REST * 0.4, abs=0.02)


def test_configurations_are_corrected_by_the_calibration_and_poses_are_raw(tmp_path):
    errors = ToolErrors(mounting_deg=10.0, mounting_mm=5.0)
    calibration, _ = calibrated(errors)
    used = UsedCalibration(tmp_path / "robot.calibration.toml", file.text_of(calibration), calibration, 3)
    collect(tmp_path / "d.h5", samples=STEPS, errors=errors, calibration=used)
    data, arm = dataset.read(tmp_path / "d.h5"), RigidArm(3)
    with h5py.File(tmp_path / "d.h5") as file_of_data:
        raw = from_poses(file_of_data["poses"][0, -1])
    arm.set_pressures(pressures_bar(ROBOT, data.action[0, -1]))
    assert angle_between_deg(data.configuration[0, -1], arm.configuration).max() < 0.2
    assert angle_between_deg(raw, arm.configuration).max() > 2.0
    folder = run_folders(tmp_path / "d.h5")[0].parent
    assert (folder / "calibration.toml").read_text() == used.text
    assert json.loads((folder / "meta.json").read_text())["calibration"] == str(used)


def test_same_collection_is_the_same_bit_for_bit(tmp_path):
    collect(tmp_path / "a.h5", errors=ToolErrors(noise_deg=0.1))
    collect(tmp_path / "b.h5", errors=ToolErrors(noise_deg=0.1))
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()


def test_interrupted_collection_continues_after_its_last_sample(tmp_path, monkeypatch):
    interrupting(monkeypatch, REST + 4, lambda devices: devices.stop.request(Interrupted(signal.SIGINT)))
    with pytest.raises(Interrupted):
        collect(tmp_path / "d.h5")
    assert not (tmp_path / "d.h5").exists()
    _, samples = collect(tmp_path / "d.h5")
    data = dataset.read(tmp_path / "d.h5")
    assert samples == data.samples == 4 + 2 * STEPS  # four steps were over, and whole episodes follow
    assert data.recorded[0].tolist() == [True] * 4 + [False] * 2
    np.testing.assert_allclose(data.action[0, :4], planned(0)[:4], atol=2e-4)
    np.testing.assert_allclose(data.action[1], planned(1), atol=2e-4)
    assert len(run_folders(tmp_path / "d.h5")) == 2


def test_held_frame_is_a_gap(tmp_path, monkeypatch):
    def hide(devices):
        frame = devices.frames.latest()
        devices.frames.put = lambda frame: (
            None if devices.now() < until_s else type(devices.frames).put(devices.frames, frame)
        )
        until_s = frame.monotonic_s + 0.45

    interrupting(monkeypatch, REST + 2, hide)
    _, samples = collect(tmp_path / "d.h5", samples=STEPS)
    data = dataset.read(tmp_path / "d.h5")
    assert samples == data.samples == 2 * STEPS - 2
    assert data.recorded[0].tolist() == [True, True, False, False, True, True]
    assert np.isnan(data.configuration[0, 3]).all()


def test_pause_vents_and_the_pause_key_goes_on(tmp_path, monkeypatch):
    highest = []

    class Keys:
        """The operator's, who presses the pause key again as soon as the collection waits for it."""

        def __init__(self, stop, pausable=False):
            self.stop = stop

        def __enter__(self):
            self.stop.request(Paused("paused"))

        def __exit__(self, *_):
            pass

    original = measure.Devices.wait_for_resume

    def waiting(self):
        highest.append(max(self.board.applied_bar))
        with monkeypatch.context() as patch:
            patch.setattr("modsoft.runtime.devices.Keys", Keys)
            original(self)

    monkeypatch.setattr(measure.Devices, "wait_for_resume", waiting)
    interrupting(monkeypatch, REST + 4, lambda devices: devices.stop.request(Paused("paused")))
    _, samples = collect(tmp_path / "d.h5")
    assert highest == [0.0]
    assert samples == 4 + 2 * STEPS
    assert len(run_folders(tmp_path / "d.h5")) == 2
    meta = json.loads(run_folders(tmp_path / "d.h5")[0].with_name("meta.json").read_text())
    assert (meta["reason"], meta["exit_code"], meta["vented"]) == ("paused", 0, True)


def test_stop_request_during_a_pause_leaves():
    devices = Devices(ROBOT, None)
    devices.stop.request(Paused("paused"))
    devices.stop.request(StopKey("stop key pressed"))
    with pytest.raises(StopKey):
        devices.wait_for_resume()


def test_signal_after_a_pause_reaches_the_next_request():
    devices = Devices(ROBOT, None, wait=lambda seconds: devices.signals._on_signal(signal.SIGTERM, None))
    devices.signals.hold()
    devices.stop.request(Paused("paused"))
    with pytest.raises(Interrupted):
        devices.wait_for_resume()


def test_full_disk_vents_and_loses_no_sample_before_it(tmp_path, monkeypatch):
    def fill(devices):
        def full(file, data):
            raise OSError(28, "No space left on device")

        writer = RunLog.latest._writer
        while writer._done < writer._queued:  # its thread is as slow as this machine, the clock of the rig is not
            pass
        writer._write = full

    class RunLog(measure.RunLog):
        def __init__(self, *arguments, **options):
            super().__init__(*arguments, **options)
            RunLog.latest = self

    monkeypatch.setattr(measure, "RunLog", RunLog)
    with monkeypatch.context() as patch:
        interrupting(patch, REST + 3, fill)
        with pytest.raises(OutputError, match=r"No space left on device.*; make room, then run the same command again"):
            collect(tmp_path / "d.h5")
    monkeypatch.undo()
    monkeypatch.setattr(recording, "REST_S", 0.0)
    _, samples = collect(tmp_path / "d.h5", samples=3)
    assert samples == 3  # no run was needed


def test_another_collection_is_refused(tmp_path):
    collect(tmp_path / "d.h5", samples=STEPS)
    with pytest.raises(ModelError, match="begun with seed 0, expected 1"):
        collect(tmp_path / "d.h5", samples=STEPS, seed=1)
    shutil.rmtree(tmp_path / "d.h5.runs")
    with pytest.raises(ModelError, match=r"exists already, without its d.h5.runs; give another --out"):
        collect(tmp_path / "d.h5", samples=STEPS)


def test_more_samples_extend_a_finished_data_set(tmp_path):
    collect(tmp_path / "d.h5", samples=STEPS)
    first = dataset.read(tmp_path / "d.h5")
    _, samples = collect(tmp_path / "d.h5", samples=STEPS + 1)
    assert samples == 2 * STEPS
    np.testing.assert_array_equal(dataset.read(tmp_path / "d.h5").action[0], first.action[0])


def test_data_set_is_made_again_from_the_runs(tmp_path, monkeypatch):
    collect(tmp_path / "d.h5", samples=STEPS)
    before = (tmp_path / "d.h5").read_bytes()
    (tmp_path / "d.h5").unlink()
    monkeypatch.setattr(rig_collect, "SteppedRig", None)  # no device is opened
    collect(tmp_path / "d.h5", samples=STEPS)
    assert (tmp_path / "d.h5").read_bytes() == before


def test_run_without_a_sample_ends_the_collection(tmp_path, monkeypatch):
    monkeypatch.setattr(recording, "PERIOD_TOLERANCE", -1.0)
    with pytest.raises(LostInRun, match="a whole run without one sample"):
        collect(tmp_path / "d.h5")
