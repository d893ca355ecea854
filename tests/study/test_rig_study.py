"""A miniature study on the rig: its files, how it resumes, and the origin of its numbers."""

import json
import shutil

import numpy as np
import pytest
from rigid_arm import RigidArm

from modsoft.hil.stepped import SteppedRig
from modsoft.runtime import robot as robot_file
from modsoft.runtime.calibration import file
from modsoft.runtime.control.features import bending_error_deg
from modsoft.runtime.errors import ModelError
from modsoft.study import results
from modsoft.study.cells import pick
from modsoft.study.paths import Folder
from modsoft.study.rig import bench, figures, plan, runs, stages
from modsoft.training.data import dataset

pytestmark = pytest.mark.slow

PLAN = plan.quick()
PARTS = ("calibrations", "data", "models", "estimates", "runs")


@pytest.fixture(scope="module")
def shared_rig_study(tmp_path_factory, run_evaluate):
    """The folder of a miniature study on the rig. Tests do not change it."""
    folder = tmp_path_factory.mktemp("shared") / "rig"
    code, _, error = run_evaluate("rig", "--quick", "--jobs", "1", "--out", folder)
    assert code == 0, error
    return folder


@pytest.fixture
def rig_study(shared_rig_study, tmp_path):
    """A copy that tests may change."""
    shutil.copytree(shared_rig_study, tmp_path / "rig")
    return tmp_path / "rig"


def modification_times(folder):
    """Of the files that a second run does not write again."""
    return {path: path.stat().st_mtime_ns for part in PARTS for path in (folder / part).iterdir()}


def test_study_writes_report_figures_and_records(shared_rig_study):
    folder = Folder(shared_rig_study)
    assert "robot of these experiments is simulated" in folder.report.read_text()
    for name in figures.CAPTIONS:
        assert (folder.figures / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    records = results.load(folder.results).records
    assert len(pick(records, table="4", source="stepped rig")) == 2 * 2 * 2 * (3 + 2)  # noises, tasks, corrections
    assert len(pick(records, table="estimation", source="stepped rig")) == 2 * 2 * 3
    assert not list(shared_rig_study.rglob("*.tmp"))


def test_error_of_a_run_is_that_of_the_true_angle(shared_rig_study):
    folder, run = Folder(shared_rig_study), PLAN.runs[0]
    stored = runs.read(folder.run(run))
    of_run = pick(results.load(folder.results).records, task=run.task, modules=run.modules, correction=run.correction)
    means = [each.mean for each in pick(of_run, data=run.model.data, source="stepped rig")]
    np.testing.assert_allclose(means, bending_error_deg(stored.true_configuration, stored.desired).mean(axis=0))
    measured_deg = bending_error_deg(stored.measured, stored.desired).mean(axis=0)
    assert not np.allclose(means, measured_deg), "with noise the measured error is another one"


def test_mounting_errors_are_calibrated_away(shared_rig_study):
    folder = Folder(shared_rig_study)
    for modules in plan.MODULES:
        path = stages.calibration_file(folder, stages.Tracked(plan.NOISE_DEG[0], modules))
        turned_deg = [np.linalg.norm(each.rotation_deg) for each in file.read(path).modules]
        assert max(turned_deg) > 1.0, "the tools are mounted with errors"
    for run in PLAN.runs:
        stored = runs.read(folder.run(run))
        off_deg = bending_error_deg(stored.measured, stored.true_configuration)
        assert np.max(off_deg) < 6.0 * np.sqrt(2.0) * PLAN.noise_deg[run.model.data]


def test_second_run_repeats_no_stage_and_makes_what_is_missing(rig_study, run_evaluate):
    before, first = modification_times(rig_study), (rig_study / "results.json").read_bytes()
    missing = Folder(rig_study).run(PLAN.runs[3])
    missing.unlink()
    code, _, error = run_evaluate("rig", "--quick", "--jobs", "1", "--out", rig_study)
    assert code == 0, error
    after = modification_times(rig_study)
    assert {path for path in before if after[path] != before[path]} == {missing}
    assert (rig_study / "results.json").read_bytes() == first


def test_data_are_those_of_the_rig(shared_rig_study):
    for data in PLAN.data:
        read = dataset.read(Folder(shared_rig_study).data(data.name))
        assert (read.generation["source"], read.generation["clock"]) == ("rig", "emulated")
        assert read.generation["tool_errors"] == bench.errors(PLAN.noise_deg[data.name])._asdict()
        assert read.samples == data.samples


def test_data_of_other_settings_are_refused(rig_study):
    folder = Folder(rig_study)
    shutil.copy(folder.data(PLAN.data[0].name), folder.data(PLAN.data[1].name))
    with pytest.raises(ModelError, match="begun with seed 0, expected 1"):
        stages.collect_stage(PLAN, folder, 1).run(1)


def test_report_of_the_rig_is_published_from_its_results(shared_rig_study, tmp_path, run_evaluate):
    code, _, error = run_evaluate("report", shared_rig_study, "--to", tmp_path / "docs")
    assert code == 0, error
    assert (tmp_path / "docs" / "report.md").read_text() == Folder(shared_rig_study).report.read_text()
    assert json.loads((tmp_path / "docs" / "results.json").read_text())["records"]


def test_each_run_has_its_own_noise_and_the_same_mounting(monkeypatch):
    robot = robot_file.load("pneumatic-3")
    arm = RigidArm(3)
    arm.reset = lambda: None
    monkeypatch.setattr(bench, "robot_and_arm", lambda modules: (robot, arm))

    def poses(number, noise_deg=0.5):
        with bench.rig(3, noise_deg, number) as rig:
            assert isinstance(rig, SteppedRig)
            return rig.frames.latest().poses

    np.testing.assert_array_equal(poses(1), poses(1))
    assert not np.allclose(poses(1), poses(2))
    np.testing.assert_allclose(poses(1, 0.0), poses(2, 0.0), atol=0.5)  # mm; position noise alone
