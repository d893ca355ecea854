"""What a cell of the report's tables is made of: records picked by their keys, seeds put together, marks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from modsoft.study.measurements import Record

ALONE_SHARE = 0.5  # of the paper's error: the mark of the network alone
CORRECTED_SHARE, OVER_FLOOR = 0.1, 1.1  # of the paper's, or over the floor where that is higher: with correction


class Cell(NamedTuple):
    """One error over the seeds: their mean, the smallest and the largest, and the mean of what it spreads by itself."""

    mean: float
    least: float
    most: float
    std: float | None
    seeds: int

    def __str__(self) -> str:
        own = "" if self.std is None else f" ± {self.std:.2f}"
        over = f" ({self.least:.2f} to {self.most:.2f})" if self.seeds > 1 else ""
        return f"{self.mean:.2f}{own}{over}"


def pick(records: Sequence[Record], **where: Any) -> list[Record]:
    """The records that have all these values."""
    return [record for record in records if all(record[key] == value for key, value in where.items())]


def cell(records: Sequence[Record], **where: Any) -> Cell | None:
    """The one cell of these keys, over whatever seeds there are; None where there is nothing.

    ValueError where the keys leave two numbers of one seed: a table would otherwise mix what does not belong together.
    """
    found = pick(records, **where)
    if not found:
        return None
    if len({record["seed"] for record in found}) != len(found):
        raise ValueError(f"{len(found)} records for {where}, expected one a seed")
    means = [record["mean"] for record in found]
    stds = [record["std"] for record in found if record["std"] is not None]
    return Cell(float(np.mean(means)), min(means), max(means), float(np.mean(stds)) if stds else None, len(found))


def ratio(ours: Cell | None, theirs: Cell | None) -> str:
    """Ours over the paper's."""
    return f"{ours.mean / theirs.mean:.2f}" if ours and theirs else ""


def mark(paper: Cell, floor: Cell | None, corrected: bool) -> float:
    """The largest mean that meets the mark of a cell, in the paper's unit."""
    if not corrected:
        return ALONE_SHARE * paper.mean
    return max(CORRECTED_SHARE * paper.mean, OVER_FLOOR * floor.mean if floor else 0.0)


def table(heads: Sequence[str], rows: Sequence[Sequence[Any]]) -> list[str]:
    """Lines of a table in Markdown: the first column to the left, the others to the right."""
    lines = ["| " + " | ".join(heads) + " |", "| --- |" + " ---: |" * (len(heads) - 1)]
    shown = [["" if value is None else str(value) for value in row] for row in rows]
    return [*lines, *("| " + " | ".join(row) + " |" for row in shown), ""]
