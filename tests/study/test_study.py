"""A miniature study: its files, how it resumes, and the origin of its numbers."""

import json
import os
import shutil
import signal
import time

import numpy as np
import pytest
import torch

from modsoft.runtime.errors import ModelError, OutputError
from modsoft.study import figures, measurements, oracle, plan, results, rollouts, stages
from modsoft.study.cells import pick
from modsoft.study.paths import Folder
from modsoft.training import checkpoint, made_from
from modsoft.training.settings import PRECISIONS

pytestmark = pytest.mark.slow

PLAN = plan.quick()
MAIN = next(model for model in PLAN.models if (model.network, model.data) == plan.MAIN)
LSTM = next(model for model in PLAN.models if model.network == "lstm" and model.split == "blocks")


def records_of(study):
    return results.load(study / "results.json").records


def modification_times(study):
    """Of the files that a second run does not write again."""
    parts = ("data", "models", "estimates", "runs", "oracle")
    return {path: path.stat().st_mtime_ns for part in parts for path in (study / part).iterdir()}


def test_study_writes_the_report_every_run_and_every_figure(shared_study):
    folder = Folder(shared_study)
    assert all(folder.run(run).is_file() for run in PLAN.runs)
    assert not list(shared_study.rglob("*.tmp")) + list(shared_study.rglob("*.resume"))
    for name in figures.CAPTIONS:
        assert (folder.figures / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert f"(figures/{name}.png)" in folder.report.read_text()
    for title in ("Table 1", "Table 2", "Table 3", "Missed targets", "Other numbers of modules", "Robustness"):
        assert title in folder.report.read_text()


def test_second_run_repeats_no_stage(study, run_evaluate):
    before, first = modification_times(study), (study / "results.json").read_bytes()
    code, _, error = run_evaluate("study", "--quick", "--jobs", "2", "--out", study)
    assert code == 0, error
    assert modification_times(study) == before
    assert (study / "results.json").read_bytes() == first


def test_study_killed_in_training_resumes_to_the_same_models(study, start_evaluate, run_evaluate):
    folder = Folder(study)
    expected = {model: checkpoint.load(folder.checkpoint(model))["weights"] for model in PLAN.models}
    shutil.rmtree(study / "models")
    training = ("study", "--quick", "--jobs", "2", "--only", "train", "--out", study)
    process = start_evaluate(*training)
    while not (study / "models").is_dir() or not list((study / "models").glob("*.pt")):
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.02)  # of another process
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    assert not all(folder.checkpoint(model).is_file() for model in PLAN.models)

    code, _, error = run_evaluate(*training)
    assert code == 0, error
    for model, weights in expected.items():
        resumed = checkpoint.load(folder.checkpoint(model))["weights"]
        assert all(torch.equal(resumed[name], weights[name]) for name in weights), model.name


def test_model_with_other_settings_is_refused_in_one_line(study, run_evaluate):
    folder = Folder(study)
    shutil.copy(folder.checkpoint(LSTM), folder.checkpoint(MAIN))
    code, _, error = run_evaluate("study", "--quick", "--jobs", "1", "--only", "train", "--out", study)
    assert code == ModelError.exit_code
    assert f"{MAIN.name}.pt" in error.splitlines()[-1]
    assert "Traceback" not in error


def test_runs_of_a_changed_model_and_damaged_runs_are_repeated(study):
    folder = Folder(study)
    assert not rollouts.rollout_stage(PLAN, folder, 1).items
    shutil.copy(folder.onnx(LSTM), folder.onnx(MAIN))
    other = next(run for run in PLAN.runs if run.model not in (MAIN, LSTM))
    folder.run(other).write_bytes(folder.run(other).read_bytes()[:1000])
    again = {run for batch in rollouts.rollout_stage(PLAN, folder, 1).items for run in batch}
    assert again == {run for run in PLAN.runs if run.model == MAIN} | {other}


def test_code_of_a_run_includes_tables_and_kernel():
    names = made_from.sources(*rollouts.MODULES)
    assert {"modsoft.runtime.control.task_tables", "modsoft.training.simulation/fleet.c"} <= set(names)


def test_control_error_is_the_distance_at_the_start_of_each_step(shared_study):
    run = plan.Run(MAIN, "B", 6, "integral")
    with np.load(Folder(shared_study).run(run)) as file:
        error = np.sqrt(((file["configuration"][:-1] - file["desired"]) ** 2).sum(-1)) * 100
    fields = {"source": "study", "network": "bilstm", "data": "rich", "task": "B", "correction": "integral"}
    for skip in (0, 5):
        records = pick(records_of(shared_study), table="3", skipped_steps=skip, **fields)
        assert [record.module for record in records] == [1, 2, 3, 4, 5, 6]
        np.testing.assert_allclose([record.mean for record in records], error[skip:].mean(0))
        np.testing.assert_allclose([record.std for record in records], error[skip:].std(0))


def test_stored_run_is_the_motion_under_its_actions(shared_study):
    stored = rollouts.read(Folder(shared_study).run(plan.Run(LSTM, "C", 4, "none"))).rollout
    replayed = oracle.replay(4, stored.actions)
    for name, values in stored._asdict().items():
        np.testing.assert_array_equal(getattr(replayed, name), values, err_msg=name)


def test_perturbations_and_the_correction_change_the_motion(shared_study):
    folder = Folder(shared_study)
    unperturbed = rollouts.read(folder.run(plan.Run(MAIN, "C", 4, "none"))).rollout.configuration
    others = [plan.Run(MAIN, "C", 4, "integral")]
    others += [plan.Run(MAIN, "C", 4, "none", each) for each in plan.PERTURBATIONS]
    for run in others:
        assert np.abs(rollouts.read(folder.run(run)).rollout.configuration - unperturbed).max() > 1e-6, run.name


def test_estimation_errors_are_those_of_the_test_part_of_training(shared_study):
    folder = Folder(shared_study)
    for model in PLAN.models:
        provenance = checkpoint.load(folder.checkpoint(model))["provenance"]
        fields = {"table": "1", "source": "study", "network": model.network, "data": model.data, "split": model.split}
        records = pick(records_of(shared_study), **fields)
        if model.data == "paper":
            np.testing.assert_allclose([each.mean for each in records], provenance["errors_percent"], atol=1e-4)
            np.testing.assert_allclose([each.std for each in records], provenance["errors_std_percent"], atol=1e-4)
        else:
            assert len(records) == 4


def test_results_state_the_settings_of_the_training(shared_study, monkeypatch):
    trained = results.load(shared_study / "results.json").about.models[0].settings
    other = next(precision for precision in PRECISIONS if precision != trained.precision)
    monkeypatch.setattr(stages, "fastest_precision", lambda: other)  # measured on another machine
    assert measurements.about(PLAN, Folder(shared_study)).models[0].settings == trained


def test_every_number_of_the_paper_is_in_the_results(shared_study):
    theirs = pick(records_of(shared_study), source="paper")
    assert len(pick(theirs, table="1")) == 12
    assert len(pick(theirs, table="2")) == 6 * 4 + 4  # and task B over all steps
    assert len(pick(theirs, table="3")) == 3 * 6
    (tip,) = pick(theirs, table="3", task="B", module=6)
    assert (tip.mean, tip.skipped_steps) == (1.80, 5)


def test_report_is_made_from_the_results_alone(shared_study, tmp_path, run_evaluate):
    shutil.copy(shared_study / "results.json", tmp_path)
    (tmp_path / "notes.md").write_text("## Conclusions\n\nTwice as good.\n")
    code, _, error = run_evaluate("report", tmp_path)
    assert code == 0, error
    without = (shared_study / "report.md").read_text()
    noted = (tmp_path / "report.md").read_text()
    assert noted.replace("## Conclusions\n\nTwice as good.\n\n", "") == without
    assert noted != without


def test_report_results_and_figures_are_published(shared_study, tmp_path, run_evaluate):
    code, _, error = run_evaluate("report", shared_study, "--to", tmp_path / "docs")
    assert code == 0, error
    copied = {str(path.relative_to(tmp_path / "docs")) for path in (tmp_path / "docs").rglob("*") if path.is_file()}
    assert copied == {"report.md", "results.json", *(f"figures/{name}.png" for name in figures.CAPTIONS)}
    assert (tmp_path / "docs/report.md").read_bytes() == (shared_study / "report.md").read_bytes()


def test_missing_results_are_refused_with_the_command_that_makes_them(tmp_path, run_evaluate):
    code, _, error = run_evaluate("report", tmp_path)
    assert (code, len(error.splitlines())) == (ModelError.exit_code, 1)
    assert "modsoft-evaluate study" in error


def test_miniature_and_full_study_are_not_mixed_in_one_folder(study, run_evaluate):
    code, _, error = run_evaluate("study", "--jobs", "1", "--only", "collect", "--out", study)
    assert code == ModelError.exit_code
    assert "expected" in error.splitlines()[-1]
    assert "Traceback" not in error


def test_folder_that_cannot_be_made_is_refused_in_one_line(tmp_path, run_evaluate):
    (tmp_path / "file").write_text("")
    code, _, error = run_evaluate("study", "--quick", "--out", tmp_path / "file/study")
    assert (code, len(error.splitlines())) == (OutputError.exit_code, 1)


def test_results_of_another_version_are_refused(shared_study, tmp_path):
    content = json.loads((shared_study / "results.json").read_text())
    del content["records"][0]["quantity"]
    (tmp_path / "results.json").write_text(json.dumps(content))
    with pytest.raises(ModelError, match="quantity"):
        results.load(tmp_path / "results.json")


def test_estimated_time_is_that_of_the_remaining_files(shared_study, tmp_path):
    Folder(tmp_path).make()
    makers = (
        stages.collect_stage,
        stages.train_stage,
        stages.export_stage,
        stages.estimate_stage,
        rollouts.rollout_stage,
    )
    new, complete = (
        sum(make(PLAN, Folder(out), 2).expected_s(2) for make in makers) for out in (tmp_path, shared_study)
    )
    assert complete < 0.2 * new
