"""No command replaces its input: every console script that writes a file, and every file that it reads."""

import sys

import numpy as np
import pytest

from modsoft.export import cli as export_cli
from modsoft.runtime import robot as robot_file
from modsoft.runtime.errors import UsageError
from modsoft.study import report
from modsoft.study.paths import Folder
from modsoft.training import collect_cli, simulate_cli, train_cli

SIMULATE, COLLECT, TRAIN, EXPORT = simulate_cli.main, collect_cli.main, train_cli.main, export_cli.main
META = """
robot = "robot.toml"
history = 3
label = "base -1, tip +1"
features = "states and actions by time step, then label"
"""


@pytest.fixture
def lab(tmp_path, monkeypatch):
    """A folder with one file of each kind that a command reads."""
    (tmp_path / "robot.toml").write_text(robot_file.text_of("pneumatic-2"))
    np.save(tmp_path / "a.npy", np.zeros((1, 2, 1)))
    for name in ("d.h5", "m.pt", "m.pt.resume"):
        (tmp_path / name).write_bytes(b"data")
    (tmp_path / "meta.toml").write_text(META)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("main", "arguments", "input_file"),
    [
        (SIMULATE, ["--robot", "robot.toml", "--actions", "a.npy", "--out", "OUT"], "a.npy"),
        (SIMULATE, ["--robot", "robot.toml", "--actions", "a.npy", "--out", "OUT"], "robot.toml"),
        (COLLECT, ["--robot", "robot.toml", "--out", "OUT"], "robot.toml"),
        (COLLECT, ["plot", "other.h5", "d.h5", "--out", "OUT"], "d.h5"),
        (TRAIN, ["other.h5", "d.h5", "--out", "OUT"], "d.h5"),
        (TRAIN, ["m.pt.resume", "--out", "m.pt"], "m.pt.resume"),
        (EXPORT, ["m.pt", "--out", "OUT"], "m.pt"),
        (EXPORT, ["m.pt", "--meta", "meta.toml", "--out", "OUT"], "meta.toml"),
        (EXPORT, ["m.pt", "--meta", "meta.toml", "--out", "OUT"], "robot.toml"),
    ],
)
@pytest.mark.parametrize("by", ["name", "link"])
def test_command_refuses_to_replace_its_input(lab, monkeypatch, capsys, main, arguments, input_file, by):
    out = input_file
    if by == "link" and "OUT" in arguments:
        (lab / "link").symlink_to(input_file)
        out = "link"
    before = {path.name: path.read_bytes() for path in lab.iterdir()}
    monkeypatch.setattr(sys, "argv", ["command", *(out if each == "OUT" else each for each in arguments)])
    with pytest.raises(SystemExit) as ended:
        main()
    error = capsys.readouterr().err
    assert (ended.value.code, len(error.splitlines())) == (2, 1), error
    assert "which would be replaced" in error
    assert {path.name: path.read_bytes() for path in lab.iterdir()} == before


def test_study_refuses_to_replace_its_notes_by_its_report(tmp_path):
    folder = Folder(tmp_path)
    folder.notes.write_text("mine")
    folder.report.symlink_to(folder.notes)
    with pytest.raises(UsageError, match="the same file as the input"):
        report.write(folder)
    assert folder.notes.read_text() == "mine"
