"""`make demo`: what is made again and what is not, and the short report."""

import ast
import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def demo(tmp_path, monkeypatch):
    """tools/demo.py, in an empty folder, with commands that are recorded and end as told."""
    spec = importlib.util.spec_from_file_location("demo", ROOT / "tools" / "demo.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(__import__("sys").modules, "demo", module)  # dataclasses look their module up
    spec.loader.exec_module(module)
    monkeypatch.chdir(tmp_path)
    module.FOLDER.mkdir()
    module.ran = []

    def run(command):
        module.ran.append(command[0])
        Path(command[-1]).write_text(f"made by {command}")
        return module.exit_code

    module.exit_code = 0
    monkeypatch.setattr(module, "run", run)
    return module


def stage(demo, *options):
    return demo.Stage("make it", ["tool", *options, "demo/result"], demo.FOLDER / "result", ["input.*"])


def test_a_stage_is_made_once(demo):
    assert demo.make(stage(demo), "[1/1]") == 0
    assert demo.make(stage(demo), "[1/1]") == 0
    assert demo.ran == ["tool"]


@pytest.mark.parametrize("change", ["input", "command", "result lost"])
def test_a_stage_is_made_again_when_something_changed(demo, change):
    Path("input.txt").write_text("1")
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


def test_an_interrupted_stage_goes_on_with_what_it_left(demo):
    demo.make(stage(demo), "[1/1]")
    (demo.FOLDER / "result").unlink()
    parts = demo.FOLDER / "result.parts"
    parts.mkdir()
    demo.make(stage(demo), "[1/1]")
    assert parts.is_dir()


def test_leftovers_of_another_order_are_cleared_away(demo):
    demo.make(stage(demo), "[1/1]")
    parts = demo.FOLDER / "result.parts"
    parts.mkdir()
    (demo.FOLDER / "result.resume").write_text("half a training")
    demo.make(stage(demo, "--more"), "[1/1]")
    assert not parts.exists()
    assert not (demo.FOLDER / "result.resume").exists()


@pytest.mark.parametrize("name", ["result", "result.parts"])
def test_files_that_the_demo_did_not_make_stay(demo, name, capsys):
    (demo.FOLDER / name).write_text("mine")
    assert demo.make(stage(demo), "[1/1]") == 2
    assert capsys.readouterr().err == f"demo: demo/{name}: not made by the demo; move it elsewhere\n"
    assert (demo.FOLDER / name).read_text() == "mine"
    assert demo.ran == []


def test_another_order_leaves_files_with_similar_names(demo):
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


def test_a_failed_stage_is_made_again(demo):
    demo.exit_code = 65
    assert demo.make(stage(demo), "[1/1]") == 65
    demo.exit_code = 0
    (demo.FOLDER / "result").unlink()
    assert demo.make(stage(demo), "[1/1]") == 0
    assert demo.ran == ["tool", "tool"]


def test_a_network_that_has_not_learned_enough_is_never_exported_and_trained_from_the_start_again(demo):
    demo.exit_code = 77
    assert demo.make(stage(demo), "[1/1]") == 77
    demo.exit_code = 0
    (demo.FOLDER / "result.resume").write_text("of the first training")
    assert demo.make(stage(demo), "[1/1]") == 0
    assert demo.ran == ["tool", "tool"]
    assert not (demo.FOLDER / "result.resume").exists()


def test_the_stages_hang_together(demo):
    """What a stage makes is what the next one depends on, and the files of the project that they name exist."""
    for before, after in zip(demo.STAGES, demo.STAGES[1:], strict=False):
        assert str(before.makes) in after.depends_on
        assert str(before.makes) in after.command
    assert str(demo.STAGES[-1].makes) in demo.RUN
    for pattern in [pattern for each in demo.STAGES for pattern in each.depends_on]:
        assert pattern.startswith("demo/") or list(ROOT.glob(pattern)), pattern


# What a stage runs, and what of that shapes no result: messages, the command line, who works where.
ENTRIES = {
    "modsoft-collect": "training/data/collect.py",
    "modsoft-train": "training/train.py",
    "modsoft-export": "export/write.py",
}
SHAPELESS = {
    *(f"runtime/{name}.py" for name in ("errors", "entry_point", "validation_messages", "files", "locks")),
    "training/data/workers.py",
    "training/data/coverage.py",
}


def imported(path, found):
    """Files of the project that `path` imports, wherever in it, and those that they import."""
    found.add(str(path))
    for node in ast.walk(ast.parse((ROOT / path).read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("modsoft."):
            folder = Path(*node.module.split(".")[1:])
            names = [folder.with_suffix(".py"), *(folder / f"{alias.name}.py" for alias in node.names)]
            for name in names:
                if (ROOT / name).is_file() and str(name) not in found | SHAPELESS:
                    imported(name, found)
    return found


def test_a_stage_depends_on_all_code_that_it_runs(demo):
    for each in demo.STAGES:
        named = {str(path.relative_to(ROOT)) for pattern in each.depends_on for path in ROOT.glob(pattern)}
        needed = imported(Path(ENTRIES[each.command[0]]), set())
        assert needed - named == set(), each.title


def test_the_short_report_says_what_is_asked(demo):
    spread = {"p50": 0.2, "p99": 1.5, "max": 2.0}
    figures = {
        "ticks": 200,
        "missed_ticks": 0,
        "held_ticks": 1,
        "lateness_ms": spread,
        "acknowledged_ms": None,
        "tracking_error_deg": {"mean": [0.5, 1.25], "std": [0.1, 0.2]},
    }
    report = {"figures": figures, "about": {"board": "a board"}, "verdict": "failed", "reason": "held ticks 1"}
    text = "\n".join(demo.summary(report))
    assert "module 2  1.25° ± 0.20°" in text
    assert "median 0.2, 99 % 1.5, largest 2.0 ms" in text
    assert "failed: held ticks 1" in text
