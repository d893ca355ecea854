"""The report of the study on the rig, from records alone."""

import itertools

import msgspec
import pytest

from modsoft.study.cells import pick
from modsoft.study.results import About, Results
from modsoft.study.rig import figures, measurements, plan, report, tables

PAPER = list(measurements.of_the_paper())
CELLS = 10  # modules of both robots in both tasks


def scaled(alone, corrected, source="stepped rig"):
    """Records of two runs of every cell at both noises, whose errors are multiples of the paper's."""
    records = []
    of_cells = pick(PAPER, table="4")
    for theirs, noise_deg, number in itertools.product(of_cells, plan.NOISE_DEG, range(2)):
        for correction, factor in (("none", alone), ("integral", corrected)):
            fields = {"source": source, "data": plan.name_of(noise_deg), "split": "blocks", "seed": number}
            mean = factor * theirs.mean
            records.append(msgspec.structs.replace(theirs, correction=correction, mean=mean, **fields))
    return PAPER + records


@pytest.mark.parametrize(
    ("factors", "missed"), [((1.0, 0.5), 0), ((1.01, 0.5), CELLS), ((1.0, 0.51), CELLS), ((1.01, 0.51), 2 * CELLS)]
)
def test_every_missed_target_of_the_smallest_noise_is_listed(factors, missed):
    comparison = tables.control(scaled(*factors), plan.NOISE_DEG[0])
    assert (len(comparison.missed), comparison.met) == (missed, 2 * CELLS - missed)
    assert "\n".join(comparison.lines).count("**no**") == missed


def test_larger_noise_has_figures_and_no_targets():
    comparison = tables.control(scaled(9.0, 9.0), plan.NOISE_DEG[1])
    assert (comparison.missed, comparison.met) == ([], 0)
    assert "| 2 | 4.26 ± 2.80 | 38.34 ± 2.80 (38.34 to 38.34) | 9.00 |" in "\n".join(comparison.lines)


def lines(records, steps=None):
    about = About("0.1.0", [0], steps, [], {}, [])
    return "\n".join(report.lines(Results(about, records), "a note"))


def test_report_says_that_the_robot_is_simulated_and_shows_every_table_and_figure():
    text = lines(scaled(0.5, 0.1))
    assert "**The robot of these experiments is simulated.**" in text
    assert "20 of 20 targets are met." in text
    assert "## Missed targets" not in text
    assert "a note" in text
    assert "All runs are stepped." in text
    assert "32.4°" in text
    for modules, task, noise in itertools.product((3, 2), ("edge", "down"), ("0.1", "0.5")):
        assert f"**`{task}` on {modules} modules, noise {noise}°**" in text
    for name in figures.CAPTIONS:
        assert f"(figures/{name}.png)" in text


def test_report_lists_missed_targets_and_runs_in_real_time():
    text = lines(scaled(0.5, 0.6, "real-time rig"), steps=4)
    assert "10 of 20 targets are met; the others are listed" in text
    assert "- edge on 3 modules, module 1, with correction: 0.35, target 0.29" in text
    assert "`edge` on 3 modules, `down` on 3 modules, `edge` on 2 modules, `down` on 2 modules." in text
    assert "no valid numbers" in text


def test_full_study_has_three_runs_of_each_cell_and_one_in_real_time_of_each_task_and_robot():
    full = plan.full()
    assert len(full.runs) == 2 * 2 * 2 * 2 * 3
    assert len({run.name for run in full.runs}) == len(full.runs)
    real = [run for run in full.runs if run.clock == plan.REAL_TIME]
    assert sorted((run.task, run.modules) for run in real) == [("down", 2), ("down", 3), ("edge", 2), ("edge", 3)]
    assert {(run.model.data, run.correction) for run in real} == {("noise-0.1", "integral")}
    assert [data.samples for data in full.data] == [15_000, 15_000]
    assert not [run for run in plan.quick().runs if run.clock == plan.REAL_TIME]
