"""How records become cells and marks."""

import pytest

from modsoft.study.cells import cell, mark, pick, ratio
from modsoft.study.measurements import record


def error(seed, mean, **more):
    return record(table="2", seed=seed, mean=mean, std=0.5 * mean, **more)


def test_a_cell_tells_mean_and_spread_over_the_seeds():
    found = cell([error(0, 1.0), error(1, 2.0), error(2, 6.0)], table="2")
    assert (found.mean, found.least, found.most, found.std, found.seeds) == (3.0, 1.0, 6.0, 1.5, 3)
    assert str(found) == "3.00 ± 1.50 (1.00 to 6.00)"
    assert str(cell([error(0, 1.0)])) == "1.00 ± 0.50"
    assert cell([error(0, 1.0)], table="3") is None


def test_numbers_of_different_cells_are_never_averaged():
    with pytest.raises(ValueError, match="one a seed"):
        cell([error(0, 1.0, task="A"), error(0, 2.0, task="B")], table="2")


def test_records_are_picked_by_every_key():
    records = [error(0, 1.0, task="A"), error(0, 2.0, task="B"), error(1, 3.0, task="B")]
    assert [each["mean"] for each in pick(records, task="B", seed=1)] == [3.0]


def test_the_mark_is_half_alone_and_a_tenth_or_the_floor_with_correction():
    theirs, low, high = cell([error(0, 2.0)]), cell([error(0, 0.1)]), cell([error(0, 0.5)])
    assert mark(theirs, high, corrected=False) == 1.0
    assert mark(theirs, None, corrected=True) == pytest.approx(0.2)
    assert mark(theirs, low, corrected=True) == pytest.approx(0.2)
    assert mark(theirs, high, corrected=True) == pytest.approx(0.55)


def test_the_ratio_is_empty_where_one_is_missing():
    assert ratio(cell([error(0, 1.0)]), cell([error(0, 4.0)])) == "0.25"
    assert ratio(cell([error(0, 1.0)]), None) == ""
