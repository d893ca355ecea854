"""modsoft-hil and the folder that it writes."""

import click
import pytest

from modsoft.hil import cli, report, rig
from modsoft.runtime.errors import OutputError, UsageError


class Interrupted:
    """A rig that ends with Ctrl-C after it has written all that a rig writes."""

    def __init__(self, robot_file, folder, board):
        self.folder, self.runs = folder, folder / "runs"

    def __enter__(self):
        (self.folder / "board.jsonl").write_text("new")
        return self

    def __exit__(self, *error):
        pass

    def run(self, *order):
        (self.runs / "1-down").mkdir(parents=True)
        for name in ("run.jsonl", "meta.json"):
            (self.runs / "1-down" / name).write_text("new")

    def wait(self, timeout_s, progress):
        raise KeyboardInterrupt

    def run_folder(self):
        return next(self.runs.glob("*"), None)


@pytest.fixture
def order(tmp_path, model_file, monkeypatch):
    """order() runs the command into tmp_path / "out"; the rig that it starts is interrupted."""
    monkeypatch.setattr(rig, "Rig", Interrupted)

    def run():
        arguments = {"--robot": "pneumatic-3", "--model": model_file, "--task": "down", "--report": tmp_path / "out"}
        told = [str(part) for pair in [*arguments.items(), ("--board", "native")] for part in pair]
        return cli.cli.main(told, standalone_mode=False)

    return run


def test_a_report_is_never_overwritten(tmp_path, order):
    (tmp_path / "out").mkdir()
    for name in (report.FINISHED, "run.jsonl"):
        (tmp_path / "out" / name).write_text("old")
    with pytest.raises(UsageError, match="holds the report of a run already; give another --report"):
        order()
    assert {path.name: path.read_text() for path in (tmp_path / "out").iterdir()} == {
        report.FINISHED: "old",
        "run.jsonl": "old",
    }


def test_an_interrupted_run_leaves_its_own_traces_and_no_report(tmp_path, order):
    """And what an earlier interrupted one left is gone; what is none of its own stays."""
    (tmp_path / "out" / "runs" / "0-down").mkdir(parents=True)
    for name in ("plant.jsonl", "report.md", "mine.txt", "runs/0-down/run.jsonl"):
        (tmp_path / "out" / name).write_text("old")
    with pytest.raises((KeyboardInterrupt, click.Abort)):
        order()
    assert {path.name: path.read_text() for path in (tmp_path / "out").iterdir()} == {
        "board.jsonl": "new",
        "run.jsonl": "new",
        "meta.json": "new",
        "mine.txt": "old",
    }


def test_a_folder_that_cannot_be_made_is_told(tmp_path, order):
    (tmp_path / "out").symlink_to("/proc/none")
    with pytest.raises(OutputError, match="out: cannot be written"):
        order()


def test_the_help_says_what_becomes_of_the_folder(capsys):
    cli.cli.main(["--help"], standalone_mode=False)
    told = " ".join(capsys.readouterr().out.split())
    assert "one that holds a report already is refused" in told
    assert "interrupted leaves its traces there and no report; the next one into the folder replaces them" in told
