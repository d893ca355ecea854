"""The report's tables and targets, from records alone."""

import msgspec
import numpy as np
import pytest

from modsoft.study import measurements, tables
from modsoft.study.cells import pick
from modsoft.study.results import CONTROL, TIP_DISTANCE, TIP_TILT
from modsoft.study.rollouts import StoredRun
from modsoft.training.simulation.rollout import Rollout

PAPER = list(measurements.of_the_paper())
STUDY = {"source": "study", "data": "rich", "split": "blocks", "perturbation": "none"}


def scaled(alone, corrected, oracle=0.0):
    """Records of four modules and three seeds whose errors, and oracle errors, are multiples of the paper's."""
    records = []
    for theirs in pick(PAPER, table="2", network="bilstm"):
        for seed in range(3):
            for correction, factor in (("none", alone), ("integral", corrected)):
                fields = {**STUDY, "seed": seed, "correction": correction, "mean": factor * theirs.mean}
                records.append(msgspec.structs.replace(theirs, **fields))
        fields = {"source": "oracle", "network": None, "mean": oracle * theirs.mean}
        records.append(msgspec.structs.replace(theirs, **fields))
    return PAPER + records


@pytest.mark.parametrize(
    ("factors", "missed"),
    [
        ((0.49, 0.09, 0.0), 0),
        ((0.51, 0.09, 0.0), 12),
        ((0.49, 0.11, 0.0), 12),
        ((0.49, 0.21, 0.2), 0),  # an oracle error above a tenth of the paper's
        ((0.51, 0.23, 0.2), 24),
    ],
)
def test_every_missed_target_is_listed(factors, missed):
    comparison = tables.control(scaled(*factors), "2", 4)
    assert (len(comparison.missed), comparison.met) == (missed, 24 - missed)
    assert len(set(comparison.missed)) == missed
    assert "\n".join(comparison.lines).count("**no**") == missed


def test_missing_run_misses_its_target():
    records = [each for each in scaled(0.1, 0.01) if (each.task, each.correction) != ("C", "integral")]
    comparison = tables.control(records, "2", 4)
    assert len(comparison.missed) == 4
    assert all("task C" in line and "with correction" in line for line in comparison.missed)


def test_task_b_is_compared_without_its_jump_and_shown_with_all_steps():
    lines = "\n".join(tables.control(scaled(0.25, 0.05), "2", 4).lines)
    assert "| 4 | 1.92 ± 0.78 | 0.48 ± 0.78 (0.48 to 0.48) | 0.25 | 0.96 | yes |" in lines
    assert "task B, all steps" in lines
    assert "| 4 | 2.28 | 0.57 (0.57 to 0.57) | 0.25 |" in lines


def resting(tip_m, tip_direction, steps=20):
    """A run of a robot of two modules that does not move."""
    configuration = np.tile([0.0, 0.0, 1.0], (steps + 1, 2, 1))
    positions = np.zeros((steps + 1, 2, 3))
    positions[:, 1] = tip_m
    directors = np.tile(np.eye(3), (steps + 1, 2, 1, 1))
    directors[:, 1, 2] = tip_direction
    desired = np.tile([0.6, 0.0, 0.8], (steps, 2, 1))
    return StoredRun(Rollout(configuration, np.zeros((steps, 2, 2)), positions, directors), desired)


def measured(run, task, **fields):
    """The one record of a run that has these fields."""
    (record,) = pick(list(measurements.of_run("modules", {"source": "study", "modules": 2}, run, task)), **fields)
    return record


def test_end_effector_is_measured_from_the_base_axis():
    run = resting([0.003, 0.004, 0.09], [0.0, 0.6, 0.8])
    assert measured(run, "B", quantity=TIP_DISTANCE, skipped_steps=5).mean == pytest.approx(5.0)  # 5 mm of 100
    tilt = measured(run, "C", quantity=TIP_TILT)
    assert tilt.mean == pytest.approx(np.degrees(np.arcsin(0.6)))
    assert tilt.std == pytest.approx(0.0, abs=1e-9)


def test_control_error_is_the_distance_of_the_unit_vectors():
    error = measured(resting([0, 0, 0.1], [0, 0, 1]), "A", quantity=CONTROL, module=2)
    assert error.mean == pytest.approx(100 * np.hypot(0.6, 0.2))
