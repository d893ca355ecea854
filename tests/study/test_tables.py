"""The report's tables and marks, from records alone."""

import numpy as np
import pytest

from modsoft.study import measurements, tables
from modsoft.study.cells import pick
from modsoft.study.measurements import CONTROL, TIP_DISTANCE, TIP_TILT, record
from modsoft.study.rollouts import Kept
from modsoft.training.simulation.rollout import Rollout

PAPER = list(measurements.of_the_paper())


def ours(share, corrected_share, floor=0.0):
    """Records of four modules of which every error is a share of the paper's, for three seeds, and a floor."""
    found = []
    for theirs in pick(PAPER, table="2", network="bilstm"):
        for seed in range(3):
            for correction, part in (("none", share), ("integral", corrected_share)):
                key = {**theirs, "source": "study", "data": "rich", "split": "blocks", "seed": seed}
                key |= {"correction": correction, "mean": part * theirs["mean"], "disturbance": "none"}
                found.append(record(**key))
        found.append(record(**{**theirs, "source": "floor", "network": None, "mean": floor * theirs["mean"]}))
    return PAPER + found


@pytest.mark.parametrize(
    ("shares", "missed"),
    [
        ((0.49, 0.09, 0.0), 0),
        ((0.51, 0.09, 0.0), 12),
        ((0.49, 0.11, 0.0), 12),
        ((0.49, 0.21, 0.2), 0),  # a floor above a tenth of the paper's
        ((0.51, 0.23, 0.2), 24),
    ],
)
def test_every_cell_that_misses_its_mark_is_named(shares, missed):
    told = tables.control(ours(*shares), "2", 4)
    assert (len(told.missed), told.met) == (missed, 24 - missed)
    assert len(set(told.missed)) == missed
    assert "\n".join(told.lines).count("**no**") == missed


def test_a_missing_run_misses_its_mark():
    records = [each for each in ours(0.1, 0.01) if (each["task"], each["correction"]) != ("C", "integral")]
    told = tables.control(records, "2", 4)
    assert len(told.missed) == 4
    assert all("task C" in line and "with correction" in line for line in told.missed)


def test_task_b_is_compared_without_its_jump_and_shown_with_it():
    lines = "\n".join(tables.control(ours(0.25, 0.05), "2", 4).lines)
    assert "| 4 | 1.92 ± 0.78 | 0.48 ± 0.78 (0.48 to 0.48) | 0.25 | 0.96 | yes |" in lines
    assert "task B, all steps" in lines
    assert "| 4 | 2.28 | 0.57 (0.57 to 0.57) | 0.25 |" in lines


def flown(tip_m, tip_direction, steps=20):
    """A robot of two modules that stands still."""
    configuration = np.tile([0.0, 0.0, 1.0], (steps + 1, 2, 1))
    positions = np.zeros((steps + 1, 2, 3))
    positions[:, 1] = tip_m
    directors = np.tile(np.eye(3), (steps + 1, 2, 1, 1))
    directors[:, 1, 2] = tip_direction
    desired = np.tile([0.6, 0.0, 0.8], (steps, 2, 1))
    return Kept(Rollout(configuration, np.zeros((steps, 2, 2)), positions, directors), desired)


def test_the_end_effector_is_measured_from_the_base_axis():
    kept = flown([0.003, 0.004, 0.09], [0.0, 0.6, 0.8])
    (told,) = pick(list(measurements.of_run("modules", {}, kept, "B")), quantity=TIP_DISTANCE, skip_first=5)
    assert told["mean"] == pytest.approx(5.0)  # 5 mm of 100
    (told,) = pick(list(measurements.of_run("modules", {}, kept, "C")), quantity=TIP_TILT)
    assert told["mean"] == pytest.approx(np.degrees(np.arcsin(0.6)))
    assert told["std"] == pytest.approx(0.0, abs=1e-9)


def test_the_control_error_is_the_distance_of_the_unit_vectors():
    (told,) = pick(list(measurements.of_run("2", {}, flown([0, 0, 0.1], [0, 0, 1]), "A")), quantity=CONTROL, module=2)
    assert told["mean"] == pytest.approx(100 * np.hypot(0.6, 0.2))
