"""`make demo`: which stages are repeated, which are skipped, and the summary."""

import importlib.util
import itertools
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from modsoft.training import made_from

ROOT = Path(__file__).parents[2]


@pytest.fixture
def demo(tmp_path, monkeypatch):
    """tools/demo.py, in an empty folder, with commands that are recorded and end with `exit_code`."""
    spec = importlib.util.spec_from_file_location("demo", ROOT / "tools" / "demo.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(__import__("sys").modules, "demo", module)  # dataclasses look their module up
    spec.loader.exec_module(module)
    monkeypatch.chdir(tmp_path)
    module.FOLDER.mkdir()
    Path("input.txt").write_text("1")
    module.ran = []

    def run(command):
        module.ran.append(command[0])
        Path(command[-1]).write_text(f"made by {command}")
        return module.exit_code

    module.exit_code = 0
    monkeypatch.setattr(module, "run", run)
    return module


def stage(demo, *options):
    command = ["tool", *options, "demo/result"]
    return demo.Stage("make it", command, demo.FOLDER / "result", [Path("input.txt")], "modsoft.training.made_from")


def test_finished_stage_is_not_repeated(demo):
    assert demo.make(stage(demo), "[1/1]") == 0
    assert demo.make(stage(demo), "[1/1]") == 0
    assert demo.ran == ["tool"]


@pytest.mark.parametrize("change", ["input", "command", "result lost"])
def test_stage_is_repeated_when_something_changed(demo, change):
    demo.make(stage(demo), "[1/1]")
    options = []
    match change:
        case "input":
            Path("input.txt").write_text("2")
        case "command":
            options = ["--more"]
        case "result lost":
            (demo.FOLDER / "result").unlink()
    demo.make(stage(demo, *options), "[1/1]")
    assert demo.ran == ["tool", "tool"]


def test_interrupted_stage_is_resumed(demo):
    demo.make(stage(demo), "[1/1]")
    (demo.FOLDER / "result").unlink()
    parts = demo.FOLDER / "result.parts"
    parts.mkdir()
    demo.make(stage(demo), "[1/1]")
    assert parts.is_dir()


def test_unfinished_files_of_another_command_are_deleted(demo):
    demo.make(stage(demo), "[1/1]")
    parts = demo.FOLDER / "result.parts"
    parts.mkdir()
    (demo.FOLDER / "result.resume").write_text("half a training")
    demo.make(stage(demo, "--more"), "[1/1]")
    assert not parts.exists()
    assert not (demo.FOLDER / "result.resume").exists()


@pytest.mark.parametrize("name", ["result", "result.parts"])
def test_files_of_the_user_are_kept(demo, name, capsys):
    (demo.FOLDER / name).write_text("mine")
    assert demo.make(stage(demo), "[1/1]") == 2
    assert capsys.readouterr().err == f"demo: demo/{name}: not made by the demo; move it elsewhere\n"
    assert (demo.FOLDER / name).read_text() == "mine"
    assert demo.ran == []


def test_files_with_similar_names_are_kept(demo):
    demo.make(stage(demo), "[1/1]")
    (demo.FOLDER / "result.old").write_text("mine")
    demo.make(stage(demo, "--more"), "[1/1]")
    assert (demo.FOLDER / "result.old").read_text() == "mine"


def test_only_a_report_of_the_rig_is_replaced(demo, monkeypatch, capsys):
    """The demo changes to its own folder first; here it stays in this one."""
    monkeypatch.setattr(demo, "ROOT", Path.cwd())
    monkeypatch.setattr(demo, "STAGES", [])
    demo.REPORT.mkdir()
    (demo.REPORT / "report.json").write_text("mine")
    assert demo.main() == 2
    assert "demo/report" in capsys.readouterr().err
    assert (demo.REPORT / "report.json").read_text() == "mine"
    (demo.REPORT / ".modsoft-hil").write_text(demo.report_folder.MARKER_TEXT)
    demo.report_folder.drop_report(demo.REPORT)
    assert not (demo.REPORT / "report.json").exists()


def test_failed_stage_is_repeated(demo):
    demo.exit_code = 65
    assert demo.make(stage(demo), "[1/1]") == 65
    demo.exit_code = 0
    (demo.FOLDER / "result").unlink()
    assert demo.make(stage(demo), "[1/1]") == 0
    assert demo.ran == ["tool", "tool"]


def test_training_that_missed_its_target_stops_the_demo_and_starts_again(demo):
    demo.exit_code = 77
    assert demo.make(stage(demo), "[1/1]") == 77
    demo.exit_code = 0
    (demo.FOLDER / "result.resume").write_text("of the first training")
    assert demo.make(stage(demo), "[1/1]") == 0
    assert demo.ran == ["tool", "tool"]
    assert not (demo.FOLDER / "result.resume").exists()


def test_each_stage_reads_the_result_of_the_one_before(demo):
    for before, after in itertools.pairwise(demo.STAGES):
        assert before.output in after.inputs
        assert str(before.output) in after.command
    assert str(demo.STAGES[-1].output) in demo.RUN
    for path in [path for each in demo.STAGES for path in each.inputs]:
        assert path.parent == demo.FOLDER or (ROOT / path).is_file(), path


def test_each_stage_names_a_module_of_its_command(demo):
    scripts = {script.name: script.module for script in entry_points(group="console_scripts")}
    for each in demo.STAGES:
        assert each.module in made_from.sources(scripts[each.command[0]])


def test_summary_has_the_figures_of_the_run(demo):
    spread = {"p50": 0.2, "p99": 1.5, "max": 2.0}
    figures = {
        "ticks": 200,
        "missed_ticks": 0,
        "held_ticks": 1,
        "lateness_ms": spread,
        "acknowledged_ms": None,
        "tracking_error_deg": {"mean": [0.5, 1.25], "std": [0.1, 0.2]},
    }
    report = {"figures": figures, "about": {"board": "a board"}, "outcome": "failed", "reason": "held ticks 1"}
    text = "\n".join(demo.summary(report))
    assert "module 2  1.25° ± 0.20°" in text
    assert "median 0.2, 99 % 1.5, largest 2.0 ms" in text
    assert "failed: held ticks 1" in text
