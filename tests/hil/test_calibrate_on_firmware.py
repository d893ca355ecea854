"""Calibrations that open valves on the compiled firmware. Rows 56 to 61 of the failure matrix have more."""

import contextlib
import json

import pytest
from stepped_calibration import CONFIRMED, SteppedCalibration, pulse_s

from modsoft.runtime import robot as robot_file
from modsoft.runtime.calibration import cli, procedure
from modsoft.runtime.errors import LostInRun, Tripped


def test_missing_sensor_does_not_trip_the_firmware(tmp_path):
    with SteppedCalibration() as rig:
        rig.pneumatics.unconnected.add(1)
        result = rig.channels(tmp_path, (1,))
        assert rig.vented == (0.0, CONFIRMED)
    assert [line for line in result.lines if "its input A1 measures no pressure" in line]


def test_run_with_too_many_invalid_frames_is_not_evaluated(tmp_path):
    with SteppedCalibration() as rig:
        device = rig.tracker.device
        for number in range(3):
            rig.at(pulse_s(0) + 1.2 * number, lambda: device.take({"hide": [2]}))
            rig.at(pulse_s(0) + 1.2 * number + 1.0, lambda: device.take({"hide": []}))
        with pytest.raises(LostInRun, match=r"only \d+ of \d+ steps were measured"):
            rig.channels(tmp_path, (0,))
        assert rig.vented == (0.0, CONFIRMED)


def test_valve_that_is_open_before_arming_is_named(tmp_path):
    with SteppedCalibration() as rig:
        rig.pneumatics.stuck_bar[2] = 0.15
        rig.wait(1.0)
        with pytest.raises(Tripped, match=r"did not arm: the sensors measure channel 2: 0\.1\d+ bar"):
            rig.channels(tmp_path)
        assert max(rig.emulated.duties()) == 0.0


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda p: p.dead.add(2), r"LEAK.* \(channel 0 was tested: channel 2 was set to 0\.08 bar and its sensor m"),
        (lambda p: setattr(p, "full_scale_bar", 1.0), r"LEAK.* every sensor measures 0\.3\d times the pressure"),
    ],
    ids=["dead", "full scale"],
)
def test_fault_that_the_firmware_vents_for_is_named(tmp_path, change, line):
    with SteppedCalibration() as rig:
        change(rig.pneumatics)
        with pytest.raises(Tripped, match=line):
            rig.valves(tmp_path)
        assert rig.vented == (0.0, CONFIRMED)


def test_command_arms_measures_and_vents(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robot.toml").write_text(robot_file.text_of("pneumatic-3"))
    with SteppedCalibration() as rig:
        monkeypatch.setattr(procedure, "opened", lambda setup: contextlib.nullcontext((rig.devices, None)))
        rig.devices.open_board = lambda setup, exits: None
        arguments = ["channels", "--yes", "--channels", "1", "--port", rig.emulated.port, "--tracker-port", "none"]
        with rig.reported(), pytest.raises(Tripped, match=r"no channel for module 1 at 180 degrees; module 2 at 180"):
            cli.cli.main(arguments, standalone_mode=False)
        assert rig.vented == (0.0, CONFIRMED)
    [folder] = (tmp_path / "runs").iterdir()
    assert folder.name.endswith("pneumatic-3-channels")
    meta = json.loads((folder / "meta.json").read_text())
    assert (meta["exit_code"], meta["vented"], meta["task"], meta["channels"]) == (
        0,
        True,
        "calibration of channels",
        [1],
    )
