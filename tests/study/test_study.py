"""The study in short form: what it leaves, that it goes on where it was, and whose its numbers are."""

import json
import os
import shutil
import signal
import time

import numpy as np
import pytest
import torch

from modsoft.runtime.errors import ModelError, OutputError
from modsoft.study import figures, measurements, oracle, plan, rollouts, stages
from modsoft.study.cells import pick
from modsoft.study.paths import Folder
from modsoft.training import checkpoint, made_from

pytestmark = pytest.mark.slow

PLAN = plan.quick()
MAIN = next(model for model in PLAN.models if (model.network, model.data) == plan.MAIN)
LSTM = next(model for model in PLAN.models if model.network == "lstm" and model.split == "blocks")


def records_of(study):
    return json.loads((study / "results.json").read_text())["records"]


def made_once(study):
    """When each file was written that no later run has to write."""
    parts = ("data", "models", "estimates", "runs", "floors")
    return {path: path.stat().st_mtime_ns for part in parts for path in (study / part).iterdir()}


def test_it_leaves_the_report_every_run_and_every_picture(made_study):
    folder = Folder(made_study)
    assert all(folder.run(run).is_file() for run in PLAN.runs)
    assert not list(made_study.rglob("*.tmp")) + list(made_study.rglob("*.resume"))
    for name in figures.CAPTIONS:
        assert (folder.figures / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert f"(figures/{name}.png)" in folder.report.read_text()
    for title in ("Table 1", "Table 2", "Table 3", "Missed", "Other numbers of modules", "Robustness"):
        assert title in folder.report.read_text()


def test_the_same_command_again_makes_nothing_again(study, ended):
    before, results = made_once(study), (study / "results.json").read_bytes()
    code, _, error = ended("study", "--quick", "--jobs", "2", "--out", study)
    assert code == 0, error
    assert made_once(study) == before
    assert (study / "results.json").read_bytes() == results


def test_killed_while_it_trains_it_goes_on_to_the_same_models(study, evaluate, ended):
    folder = Folder(study)
    wanted = {model: checkpoint.load(folder.checkpoint(model))["weights"] for model in PLAN.models}
    shutil.rmtree(study / "models")
    training = ("study", "--quick", "--jobs", "2", "--only", "train", "--out", study)
    process = evaluate(*training)
    while not (study / "models").is_dir() or not list((study / "models").glob("*.pt")):
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.02)  # of another process
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    assert not all(folder.checkpoint(model).is_file() for model in PLAN.models)

    code, _, error = ended(*training)
    assert code == 0, error
    for model, weights in wanted.items():
        found = checkpoint.load(folder.checkpoint(model))["weights"]
        assert all(torch.equal(found[name], weights[name]) for name in weights), model.name


def test_a_model_of_other_settings_is_refused_in_one_line(study, ended):
    folder = Folder(study)
    shutil.copy(folder.checkpoint(LSTM), folder.checkpoint(MAIN))
    code, _, error = ended("study", "--quick", "--jobs", "1", "--only", "train", "--out", study)
    assert code == ModelError.exit_code
    assert f"{MAIN.name}.pt" in error.splitlines()[-1]
    assert "Traceback" not in error


def test_runs_of_a_model_that_changed_and_damaged_ones_are_flown_again(study):
    folder = Folder(study)
    assert not rollouts.rolling_out(PLAN, folder, 1).items
    shutil.copy(folder.onnx(LSTM), folder.onnx(MAIN))
    other = next(run for run in PLAN.runs if run.model not in (MAIN, LSTM))
    folder.run(other).write_bytes(folder.run(other).read_bytes()[:1000])
    again = {run for batch in rollouts.rolling_out(PLAN, folder, 1).items for run in batch}
    assert again == {run for run in PLAN.runs if run.model == MAIN} | {other}


def test_code_of_a_run_includes_tables_and_kernel():
    names = made_from.sources(*rollouts.MODULES)
    assert {"modsoft.runtime.control.task_tables", "modsoft.training.simulation/fleet.c"} <= set(names)


def test_an_error_of_control_is_the_distance_at_the_start_of_each_step(made_study):
    run = plan.Run(MAIN, "B", 6, "integral")
    with np.load(Folder(made_study).run(run)) as file:
        off = np.sqrt(((file["configuration"][:-1] - file["desired"]) ** 2).sum(-1)) * 100
    key = {"source": "study", "network": "bilstm", "data": "rich", "task": "B", "correction": "integral"}
    for skip in (0, 5):
        found = pick(records_of(made_study), table="3", skip_first=skip, **key)
        assert [record["module"] for record in found] == [1, 2, 3, 4, 5, 6]
        np.testing.assert_allclose([record["mean"] for record in found], off[skip:].mean(0))
        np.testing.assert_allclose([record["std"] for record in found], off[skip:].std(0))


def test_a_run_is_what_a_robot_does_under_its_actions(made_study):
    kept = rollouts.read(Folder(made_study).run(plan.Run(LSTM, "C", 4, "none")))
    again = oracle.replay(4, kept.flight.actions)
    for name, values in kept.flight._asdict().items():
        np.testing.assert_array_equal(getattr(again, name), values, err_msg=name)


def test_disturbances_and_the_correction_change_what_the_robot_does(made_study):
    folder = Folder(made_study)
    clean = rollouts.read(folder.run(plan.Run(MAIN, "C", 4, "none"))).flight.configuration
    others = [plan.Run(MAIN, "C", 4, "integral")]
    others += [plan.Run(MAIN, "C", 4, "none", each) for each in plan.DISTURBANCES]
    for run in others:
        assert np.abs(rollouts.read(folder.run(run)).flight.configuration - clean).max() > 1e-6, run.name


def test_estimation_errors_are_those_that_training_found_on_what_it_left_out(made_study):
    folder = Folder(made_study)
    for model in PLAN.models:
        said = checkpoint.load(folder.checkpoint(model))["provenance"]
        key = {"table": "1", "source": "study", "network": model.network, "data": model.data, "split": model.split}
        found = pick(records_of(made_study), **key)
        if model.data == "paper":
            np.testing.assert_allclose([each["mean"] for each in found], said["errors_percent"], atol=1e-4)
            np.testing.assert_allclose([each["std"] for each in found], said["errors_std_percent"], atol=1e-4)
        else:
            assert len(found) == 4


def test_every_number_of_the_paper_stands_in_the_results(made_study):
    theirs = pick(records_of(made_study), source="paper")
    assert len(pick(theirs, table="1")) == 12
    assert len(pick(theirs, table="2")) == 6 * 4 + 4  # and task B over all steps
    assert len(pick(theirs, table="3")) == 3 * 6
    (tip,) = pick(theirs, table="3", task="B", module=6)
    assert (tip["mean"], tip["skip_first"]) == (1.80, 5)


def test_the_report_is_made_of_the_results_alone(made_study, tmp_path, ended):
    shutil.copy(made_study / "results.json", tmp_path)
    (tmp_path / "notes.md").write_text("## What was tried\n\nTwice as much.\n")
    code, _, error = ended("report", tmp_path)
    assert code == 0, error
    without = (made_study / "report.md").read_text()
    noted = (tmp_path / "report.md").read_text()
    assert noted.replace("## What was tried\n\nTwice as much.\n\n", "") == without
    assert noted != without


def test_published_are_report_results_and_figures(made_study, tmp_path, ended):
    code, _, error = ended("report", made_study, "--to", tmp_path / "docs")
    assert code == 0, error
    copied = {str(path.relative_to(tmp_path / "docs")) for path in (tmp_path / "docs").rglob("*") if path.is_file()}
    assert copied == {"report.md", "results.json", *(f"figures/{name}.png" for name in figures.CAPTIONS)}
    assert (tmp_path / "docs/report.md").read_bytes() == (made_study / "report.md").read_bytes()


def test_a_folder_without_results_is_told_what_makes_them(tmp_path, ended):
    code, _, error = ended("report", tmp_path)
    assert (code, len(error.splitlines())) == (ModelError.exit_code, 1)
    assert "modsoft-evaluate study" in error


def test_the_short_form_and_the_whole_study_are_not_mixed_in_one_folder(study, ended):
    code, _, error = ended("study", "--jobs", "1", "--only", "collect", "--out", study)
    assert code == ModelError.exit_code
    assert "asked for" in error.splitlines()[-1]
    assert "Traceback" not in error


def test_a_folder_that_cannot_be_made_is_told_in_one_line(tmp_path, ended):
    (tmp_path / "file").write_text("")
    code, _, error = ended("study", "--quick", "--out", tmp_path / "file/study")
    assert (code, len(error.splitlines())) == (OutputError.exit_code, 1)


def test_results_of_another_version_are_refused(made_study, tmp_path):
    found = json.loads((made_study / "results.json").read_text())
    del found["records"][0]["skip_first"]
    (tmp_path / "results.json").write_text(json.dumps(found))
    with pytest.raises(ModelError, match="skip_first"):
        measurements.load(tmp_path / "results.json")


def test_what_is_left_costs_time_and_what_is_there_hardly_any(made_study, tmp_path):
    Folder(tmp_path).make()
    begun, done = (
        sum(
            make(PLAN, Folder(out), 2).expected_s(2)
            for make in (stages.collecting, stages.training, stages.exporting, stages.estimating, rollouts.rolling_out)
        )
        for out in (tmp_path, made_study)
    )
    assert done < 0.2 * begun
