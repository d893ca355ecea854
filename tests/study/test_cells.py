"""Cells of records and their targets."""

import pytest

from modsoft.study.cells import cell, pick, ratio, target
from modsoft.study.results import CONTROL, record


def error(seed, mean, **fields):
    values = {"table": "2", "source": "study", "modules": 4, "mean": mean, "std": 0.5 * mean}
    return record(CONTROL, seed=seed, **values | fields)


def test_cell_has_mean_and_spread_over_the_seeds():
    combined = cell([error(0, 1.0), error(1, 2.0), error(2, 6.0)], table="2")
    assert (combined.mean, combined.least, combined.most, combined.std, combined.seeds) == (3.0, 1.0, 6.0, 1.5, 3)
    assert str(combined) == "3.00 ± 1.50 (1.00 to 6.00)"
    assert str(cell([error(0, 1.0)])) == "1.00 ± 0.50"
    assert cell([error(0, 1.0)], table="3") is None


def test_numbers_of_different_cells_are_not_averaged():
    with pytest.raises(ValueError, match="one for each seed"):
        cell([error(0, 1.0, task="A"), error(0, 2.0, task="B")], table="2")


def test_records_are_selected_by_all_given_fields():
    records = [error(0, 1.0, task="A"), error(0, 2.0, task="B"), error(1, 3.0, task="B")]
    assert [each.mean for each in pick(records, task="B", seed=1)] == [3.0]


def test_target_is_half_of_the_paper_alone_and_a_tenth_or_the_oracle_error_with_correction():
    theirs, low, high = cell([error(0, 2.0)]), cell([error(0, 0.1)]), cell([error(0, 0.5)])
    assert target(theirs, high, corrected=False) == 1.0
    assert target(theirs, None, corrected=True) == pytest.approx(0.2)
    assert target(theirs, low, corrected=True) == pytest.approx(0.2)
    assert target(theirs, high, corrected=True) == pytest.approx(0.55)


def test_ratio_is_empty_if_one_error_is_missing():
    assert ratio(cell([error(0, 1.0)]), cell([error(0, 4.0)])) == "0.25"
    assert ratio(cell([error(0, 1.0)]), None) == ""
