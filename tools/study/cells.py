"""Cells of the report's tables: records selected by their fields, combined over the seeds, and their targets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from modsoft.study.results import Record

NETWORK_TARGET = 0.5  # of the network alone, as a fraction of the paper's error
# With the correction, as fractions of the paper's and of the oracle error; the larger of both is the target.
CORRECTED_TARGET, ORACLE_TARGET = 0.1, 1.1


class Cell(NamedTuple):
    """One error over the seeds: mean, smallest and largest mean of a seed, and mean of their standard deviations."""

    mean: float
    least: float
    most: float
    std: float | None
    seeds: int

    def __str__(self) -> str:
        deviation = "" if self.std is None else f" ± {self.std:.2f}"
        spread = f" ({self.least:.2f} to {self.most:.2f})" if self.seeds > 1 else ""
        return f"{self.mean:.2f}{deviation}{spread}"


def pick(records: Sequence[Record], **fields: Any) -> list[Record]:
    """The records whose fields have all these values."""
    return [each for each in records if all(getattr(each, name) == value for name, value in fields.items())]


def cell(records: Sequence[Record], **fields: Any) -> Cell | None:
    """The cell of the records with these fields, over all their seeds; None if there are no such records.

    Raises ValueError if two records have the same seed: they belong to different cells.
    """
    selected = pick(records, **fields)
    if not selected:
        return None
    if len({each.seed for each in selected}) != len(selected):
        raise ValueError(f"{len(selected)} records for {fields}, expected one for each seed")
    means = [each.mean for each in selected]
    stds = [each.std for each in selected if each.std is not None]
    return Cell(float(np.mean(means)), min(means), max(means), float(np.mean(stds)) if stds else None, len(selected))


def ratio(ours: Cell | None, theirs: Cell | None) -> str:
    """Our error over the paper's; empty if one is missing."""
    return f"{ours.mean / theirs.mean:.2f}" if ours and theirs else ""


def target(paper: Cell, oracle: Cell | None, corrected: bool) -> float:
    """The target of a cell: the largest mean error that meets it, in the unit of the paper's."""
    if not corrected:
        return NETWORK_TARGET * paper.mean
    return max(CORRECTED_TARGET * paper.mean, ORACLE_TARGET * oracle.mean if oracle else 0.0)


def table(heads: Sequence[str], rows: Sequence[Sequence[Any]]) -> list[str]:
    """Lines of a Markdown table: the first column aligned left, the others right."""
    lines = ["| " + " | ".join(heads) + " |", "| --- |" + " ---: |" * (len(heads) - 1)]
    texts = [["" if value is None else str(value) for value in row] for row in rows]
    return [*lines, *("| " + " | ".join(row) + " |" for row in texts), ""]
