"""modsoft-hil and the folder that it writes."""

import re
import subprocess
import sys
from pathlib import Path

import click
import pytest

from modsoft.hil import cli, report_folder, rig
from modsoft.runtime import robot as robot_file
from modsoft.runtime.errors import InUse, OutputError, UsageError


class Interrupted:
    """A rig that is interrupted by Ctrl-C after it has written its files."""

    def __init__(self, robot_file, folder, board, pull_downs, errors):
        self.folder, self.runs = folder, folder / "runtime-log-1"
        self.errors = errors

    def __enter__(self):
        (self.folder / "board.jsonl").write_text("new")
        return self

    def __exit__(self, *error):
        pass

    def calibrate(self):
        (self.folder / "calibration.toml").write_text(str(tuple(self.errors)))

    def run(self, *options):
        (self.runs / "1-down").mkdir(parents=True)
        for name in ("run.jsonl", "meta.json"):
            (self.runs / "1-down" / name).write_text("new")

    def wait(self, timeout_s, progress):
        raise KeyboardInterrupt

    def run_folder(self):
        return next(self.runs.glob("*"), None)


@pytest.fixture
def run_command(tmp_path, model_file, monkeypatch):
    """run_command() runs the command with --report tmp_path / "out"; its rig is interrupted."""
    monkeypatch.setattr(rig, "Rig", Interrupted)

    def run(*more):
        arguments = {"--robot": "pneumatic-3", "--model": model_file, "--task": "down", "--report": tmp_path / "out"}
        options = [str(part) for pair in [*arguments.items(), ("--board", "native")] for part in pair]
        return cli.cli.main([*options, *more], standalone_mode=False)

    return run


def texts(folder):
    return {str(path.relative_to(folder)): path.read_text() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    ("files", "says"),
    [
        (["report.json", "run.jsonl"], "holds the report of a run already; give another --report"),
        (["runs/20260101T090000Z-pneumatic-3/run.jsonl"], r"files that modsoft-hil did not write \(such as runs\)"),
        (["run.jsonl", "meta.json", "robot.toml"], "give a new or empty folder"),
        (["angles.png"], "give a new or empty folder"),
        (["robot.toml", "model.onnx"], "give a new or empty folder"),
        ([".modsoft-hil", "run.jsonl"], "give a new or empty folder"),
    ],
)
def test_other_files_and_finished_reports_are_kept(files, says, tmp_path, run_command):
    before = {name: "old" for name in files}
    for name in files:
        (tmp_path / "out" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "out" / name).write_text("old")
    with pytest.raises(UsageError, match=says):
        run_command()
    assert texts(tmp_path / "out") == before


def test_next_run_replaces_the_traces_of_an_interrupted_one(tmp_path, run_command):
    """Other files of the folder are kept."""
    for _ in range(2):
        with pytest.raises((KeyboardInterrupt, click.Abort)):
            run_command()
        own = {name: "new" for name in ("board.jsonl", "run.jsonl", "meta.json")}
        own[".modsoft-hil"] = report_folder.MARKER_TEXT
        assert texts(tmp_path / "out") == own
        (tmp_path / "out" / "plant.jsonl").write_text("of the interrupted run")
        (tmp_path / "out" / "runtime-log-0" / "1-down").mkdir(parents=True)
    for name in ("mine.txt", "runs/1-down/run.jsonl"):
        (tmp_path / "out" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "out" / name).write_text("mine")
    with pytest.raises((KeyboardInterrupt, click.Abort)):
        run_command()
    assert texts(tmp_path / "out") == {**own, "mine.txt": "mine", "runs/1-down/run.jsonl": "mine"}


@pytest.mark.parametrize(
    ("options", "calibrated"),
    [
        (["--mounting-error", "10", "5", "--noise-deg", "0.5"], "(10.0, 5.0, 0.5, 0.0, 0)"),
        (["--mounting-error", "0", "5", "--noise-mm", "0.1", "--seed", "3"], "(0.0, 5.0, 0.0, 0.1, 3)"),
        (["--noise-deg", "0.5"], None),
    ],
)
def test_mounting_errors_are_calibrated_before_the_run(options, calibrated, tmp_path, run_command):
    with pytest.raises((KeyboardInterrupt, click.Abort)):
        run_command(*options)
    assert texts(tmp_path / "out").get("calibration.toml") == calibrated


def test_two_runs_do_not_share_a_folder(tmp_path, run_command):
    with report_folder.claimed(tmp_path / "out"), pytest.raises(InUse, match="another modsoft-hil works on it"):
        run_command()


def test_folder_that_cannot_be_made_is_refused(tmp_path, run_command):
    (tmp_path / "out").symlink_to("/proc/none")
    with pytest.raises(OutputError, match="out: no such folder can be made"):
        run_command()


def test_run_without_a_control_step_shows_only_its_cause(model_file, tmp_path):
    shipped = Path(robot_file.__file__).with_name("robots") / "pneumatic-3.toml"
    robot = tmp_path / "robot.toml"
    robot.write_text(shipped.read_text().replace("\nfull_scale_bar = 3.0", "\nfull_scale_bar = 2.0"))
    command = [Path(sys.executable).with_name("modsoft-hil"), "--robot", robot, "--model", model_file, "--task", "down"]
    done = subprocess.run(
        [*command, "--board", "native", "--report", tmp_path / "out"], capture_output=True, text=True, timeout=120
    )
    assert (done.returncode, done.stdout) == (76, "")
    message = r"no control step: modsoft-runtime: valve full scale: the board at .* has 3 bar, the robot file 2; .*\n"
    assert re.fullmatch(message + re.escape(f"{tmp_path / 'out' / 'report.md'}\n"), done.stderr), done.stderr


def test_help_describes_the_folder(capsys):
    cli.cli.main(["--help"], standalone_mode=False)
    text = " ".join(capsys.readouterr().out.split())
    assert "a folder with a report is refused" in text
    assert "interrupted run leaves its traces there and no report; the next run into this folder replaces them" in text
