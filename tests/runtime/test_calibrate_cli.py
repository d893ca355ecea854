"""`modsoft-calibrate`: the file, the backup and the picture that it writes, and what it refuses in one line."""

import json
import sys
import threading

import numpy as np
import pytest
from click.testing import CliRunner
from tools_at_rest import ERRORS, Tracker, straight, write_tool_files

from modsoft.hil.tool_errors import ToolErrors
from modsoft.runtime import robot as robot_file
from modsoft.runtime.calibration import commands, file
from modsoft.runtime.calibration.cli import cli
from modsoft.runtime.errors import DeviceAbsent, ModelError, Tripped, UsageError


class Source:
    """The frames of a `Tracker`, as fast as they are read."""

    device = "Polaris Spectra Rev 009, serial number P7-00123"

    def __init__(self, tracker):
        self.tracker, self.closed = tracker, threading.Event()

    def read(self):
        self.closed.wait(0.0005)
        self.tracker.wait(0.0)
        return self.tracker.frames.latest()

    def close(self):
        self.closed.set()


class Bench:
    """A folder with a robot file and its tools, and the tracker in front of the robot."""

    def __init__(self, folder, monkeypatch):
        self.folder, self.source = folder, None
        self.tracker = Tracker(ERRORS)
        self.set_modules(3)
        monkeypatch.chdir(folder)
        monkeypatch.setattr(commands, "open_source", self.open)

    def set_modules(self, modules):
        text = robot_file.text_of(f"pneumatic-{modules}").replace(f'name = "pneumatic-{modules}"', 'name = "arm"')
        paths = [str(path.name) for path in write_tool_files(self.folder, modules + 1)]
        text = text.replace("tools = []", f"tools = {paths}").replace("'", '"').replace('port = ""', 'port = "x"', 1)
        (self.folder / "robot.toml").write_text(text)
        self.tracker.bends = lambda at_s: straight(modules)

    def open(self, robot, port, tools):
        self.source = Source(self.tracker)
        return self.source

    def run(self, *arguments, text=None):
        """The output of the command; raises its error."""
        done = CliRunner().invoke(cli, [*arguments, "--frames", "20"], input=text)
        if done.exception is not None and not isinstance(done.exception, SystemExit):
            raise done.exception
        return done.output

    @property
    def calibration(self):
        return file.read(self.folder / "robot.calibration.toml")


@pytest.fixture
def bench(tmp_path, monkeypatch):
    return Bench(tmp_path, monkeypatch)


def refusal(call, kind):
    with pytest.raises(kind) as raised:
        call()
    assert "\n" not in str(raised.value)
    return str(raised.value)


def test_rest_writes_calibration_and_picture_beside_the_robot_file(bench):
    output = bench.run("rest", "--yes")
    calibration = bench.calibration
    assert (calibration.robot, len(calibration.modules)) == ("arm", 3)
    assert [entry.tool for entry in calibration.modules] == ["module-1.rom", "module-2.rom", "module-3.rom"]
    assert calibration.base.device == "Polaris Spectra Rev 009, serial number P7-00123"
    file.check(calibration, robot_file.load("robot.toml"), file.sha256_of(write_tool_files(bench.folder, 4)), "c")
    assert (bench.folder / "robot.calibration.png").read_bytes().startswith(b"\x89PNG")
    assert output.splitlines()[0].startswith("base: mounted 0.0 degrees and 0.0 mm off, noise 0.")
    assert output.splitlines()[-2:] == ["wrote robot.calibration.toml", "wrote robot.calibration.png"]
    assert bench.source.closed.is_set()


def test_next_calibration_keeps_the_one_before(bench):
    bench.run("rest", "--yes")
    before = bench.calibration
    bench.run("rest", "--yes")
    assert file.parse((bench.folder / "robot.calibration.toml.backup").read_text(), "backup") == before


def test_added_module_alone_is_calibrated(bench):
    bench.set_modules(2)
    bench.run("rest", "--yes")
    before = bench.calibration
    bench.set_modules(3)
    bench.run("rest", "--yes", "--module", "3")
    assert bench.calibration.modules[:2] == before.modules
    assert len(bench.calibration.modules) == 3


def test_single_module_needs_the_calibration_of_the_others(bench):
    assert "run modsoft-calibrate rest" in refusal(lambda: bench.run("rest", "--yes", "--module", "3"), ModelError)
    bench.run("rest", "--yes")
    (bench.folder / "module-1.rom").write_bytes(b"another")
    message = refusal(lambda: bench.run("rest", "--yes", "--module", "3"), ModelError)
    assert "found another tool definition file for the module 1" in message
    assert bench.run("rest", "--yes", "--module", "1")
    assert "expected 1 to 3" in refusal(lambda: bench.run("rest", "--yes", "--module", "4"), UsageError)


def test_noise_is_measured_without_and_stored_with_a_calibration(bench):
    output = bench.run("noise", "--yes")
    assert "not stored: no calibration robot.calibration.toml; run modsoft-calibrate rest" in output
    assert not (bench.folder / "robot.calibration.toml").exists()
    bench.run("rest", "--yes")
    before = bench.calibration
    bench.tracker.errors = ERRORS._replace(noise_deg=0.1)
    bench.run("noise", "--yes")
    assert bench.calibration.modules[0].rotation_deg == before.modules[0].rotation_deg
    assert bench.calibration.modules[0].noise_deg == pytest.approx(0.1, rel=0.5)


def test_damaged_calibration_is_replaced_and_kept_as_backup(bench):
    (bench.folder / "robot.calibration.toml").write_text("schema = 7\n")
    assert "replaced: robot.calibration.toml: found a calibration of schema 7" in bench.run("rest", "--yes")
    assert len(bench.calibration.modules) == 3
    assert (bench.folder / "robot.calibration.toml.backup").read_text() == "schema = 7\n"


def test_measuring_asks_for_enter(bench):
    assert "does it hang straight and still? Press Enter" in bench.run("rest", text="\n")
    assert len(bench.calibration.modules) == 3
    assert "--yes" in refusal(lambda: bench.run("rest", text=""), UsageError)


@pytest.mark.parametrize(
    ("change", "bends", "kind", "message"),
    [
        (lambda number, poses: {"valid": np.arange(4) != 2}, None, DeviceAbsent, "tool hidden (module 2)"),
        (None, lambda at_s: [[0.0, 4.0 * np.sin(7.0 * at_s), 0.0]] * 3, Tripped, "moves"),
        (None, lambda at_s: [[0.0, 20.0, 0.0]] * 3, Tripped, "hang straight"),
    ],
    ids=["hidden", "moving", "bent"],
)
def test_refused_measurement_leaves_the_calibration(change, bends, kind, message, bench, monkeypatch):
    monkeypatch.setattr("modsoft.runtime.calibration.measure.PATIENCE_S", 0.1)
    bench.run("rest", "--yes")
    before = {path.name: path.read_bytes() for path in bench.folder.iterdir()}
    bench.tracker.change, bench.tracker.bends = change or bench.tracker.change, bends or bench.tracker.bends
    assert message in refusal(lambda: bench.run("rest", "--yes"), kind)
    assert {path.name: path.read_bytes() for path in bench.folder.iterdir()} == before


@pytest.mark.parametrize("option", ["--calibration", "--picture"])
@pytest.mark.parametrize("name", ["robot.toml", "module-1.rom"])
def test_input_files_are_not_replaced(option, name, bench):
    message = refusal(lambda: bench.run("rest", "--yes", option, name), UsageError)
    assert "which would be replaced" in message
    assert robot_file.load("robot.toml").name == "arm"


def bend(at_s):
    """Bends in the plane, as by hand."""
    return [[0.0, 30.0 * np.sin(at_s + module), 0.0] for module in range(3)]


def test_base_stores_the_frame_that_bends_show(bench):
    assert "run modsoft-calibrate rest" in refusal(lambda: bench.run("base", "--yes"), ModelError)
    bench.run("rest", "--yes")
    before = bench.calibration
    assert "expected at least 10 in its plane" in refusal(lambda: bench.run("base", "--yes"), Tripped)
    assert bench.calibration == before
    bench.tracker.bends = bend
    output = bench.run("base", "--yes", "--frames", "200")
    assert output.splitlines()[-1] == "wrote robot.calibration.toml"
    assert "the base's tool is turned by 0." in output
    assert bench.calibration.base.rotation_date != ""
    assert bench.calibration.modules == before.modules


def test_base_uses_the_frames_of_a_run(bench):
    bench.run("rest", "--yes")
    bench.tracker.bends = bend
    lines = []
    for tick in range(60):
        bench.tracker.wait(0.0)
        frame = bench.tracker.frames.latest()
        pose = {"poses": frame.poses.tolist(), "valid": [tick != 7, True, True, True], "quality": [0.1] * 4}
        lines.append(json.dumps({"tick": tick, "frame": {"number": tick, "mono_ns": tick * 10**8, **pose}}))
    run = bench.folder / "runs" / "1"
    run.mkdir(parents=True)
    (run / "run.jsonl").write_text("\n".join(lines[:10]) + "\n")
    assert "found 9 valid frames, expected at least 20" in refusal(
        lambda: bench.run("base", "--run", str(run)), ModelError
    )
    (run / "run.jsonl").write_text("\n".join(lines) + "\n")
    assert bench.run("base", "--run", str(run)).startswith("59 frames: the base's tool is turned by 0.")
    assert bench.calibration.base.rotation_date != ""


def test_picture_and_calibration_need_two_names(bench):
    assert "found one name" in refusal(lambda: bench.run("rest", "--yes", "--calibration", "c.png"), UsageError)


def test_picture_without_matplotlib_is_one_line(bench, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert "no picture: " in (output := bench.run("rest", "--yes"))
    assert "pip install 'modsoft[plot]'" in output
    assert not (bench.folder / "robot.calibration.png").exists()
    assert len(bench.calibration.modules) == 3


def test_wired_tools_have_no_definition_files(bench):
    text = (bench.folder / "robot.toml").read_text().replace('type = "polaris"', 'type = "aurora"')
    (bench.folder / "robot.toml").write_text(text)
    bench.tracker.errors = ToolErrors()
    bench.run("rest", "--yes")
    assert [entry.tool_sha256 for entry in bench.calibration.modules] == ["", "", ""]
