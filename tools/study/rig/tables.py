"""The tables of the report on the rig, each from the records alone."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from modsoft.runtime.choices import CORRECTIONS
from modsoft.study.cells import Cell, cell, pick, ratio, table
from modsoft.study.results import ANGLE, ESTIMATION, Record
from modsoft.study.rig.plan import MODULES, NOISE_DEG, TASKS, name_of
from modsoft.study.tables import CORRECTION_LABELS, SPLIT_LABELS, Comparison, modules_of

TARGETS = {"none": 1.0, "integral": 0.5}  # largest error over the paper's, for the smallest noise


def estimation(records: Sequence[Record]) -> list[str]:
    """Estimation errors beside the paper's."""
    of_table = pick(records, table="estimation", quantity=ESTIMATION)
    theirs, ours = pick(of_table, source="paper"), pick(of_table, source="stepped rig")
    columns = [(noise, split) for noise in NOISE_DEG for split in SPLIT_LABELS]
    heads = ["module", "paper (shuffled windows)"]
    for noise, split in columns:
        heads += [f"noise {noise:g}°, {SPLIT_LABELS[split]}", "ratio"]
    rows = []
    for module in modules_of(theirs):
        known = cell(theirs, module=module)
        row: list[object] = [module, known]
        for noise, split in columns:
            error = cell(ours, data=name_of(noise), split=split, module=module)
            row += [error, ratio(error, known)]
        rows.append(row)
    return table(heads, rows)


def control(records: Sequence[Record], noise_deg: float) -> Comparison:
    """Table 4 at one noise of the tracker: a table for each robot and task."""
    comparison, has_target = Comparison(), noise_deg == NOISE_DEG[0]
    heads = ["module", "paper"]
    for correction in CORRECTIONS:
        heads += [CORRECTION_LABELS[correction], "ratio"] + (["target", "met"] if has_target else [])
    for modules, task in itertools.product(MODULES, TASKS):
        rows = []
        for module in range(1, modules + 1):
            known, errors = cells_of(records, noise_deg, task, modules, module)
            row: list[object] = [module, known]
            for correction, error in errors.items():
                row += [error, ratio(error, known)]
                if has_target and known:
                    where = f"{task} on {modules} modules, module {module}, {CORRECTION_LABELS[correction]}"
                    row += comparison.target_columns(where, error, TARGETS[correction] * known.mean)
            rows.append(row)
        comparison.lines += [f"**`{task}` on {modules} modules, noise {noise_deg:g}°**", "", *table(heads, rows)]
    return comparison


def cells_of(
    records: Sequence[Record], noise_deg: float, task: str, modules: int, module: int
) -> tuple[Cell | None, dict[str, Cell | None]]:
    """The paper's error, and ours by the correction."""
    of_module = pick(records, table="4", quantity=ANGLE, task=task, modules=modules, module=module)
    ours = pick(of_module, data=name_of(noise_deg))
    return cell(of_module, source="paper"), {each: cell(ours, correction=each) for each in CORRECTIONS}
