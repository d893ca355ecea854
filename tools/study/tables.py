"""The report's tables, each from the records alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from modsoft.runtime.choices import CORRECTIONS
from modsoft.study import paper
from modsoft.study.cells import Cell, cell, pick, ratio, table, target
from modsoft.study.perturbations import LABELS as PERTURBATION_LABELS
from modsoft.study.plan import MAIN, SPLITS, TASKS
from modsoft.study.results import CONTROL, COVERED, ESTIMATION, TIP_DISTANCE, TIP_TILT, UNITS, Record

NETWORK_LABELS = {"module-lstm": "four LSTM", "lstm": "LSTM", "bilstm": "biLSTM"}
SPLIT_LABELS = {"blocks": "contiguous blocks", "shuffled": "shuffled windows"}
CORRECTION_LABELS = {"none": "network alone", "integral": "with correction"}


@dataclass
class Comparison:
    """A comparison with the paper. lines: Markdown; missed: a line for each missed target; met: number of met ones."""

    lines: list[str] = field(default_factory=list)
    missed: list[str] = field(default_factory=list)
    met: int = 0

    def target_columns(self, where: str, error: Cell | None, limit: float) -> list[str]:
        """The columns "target" and "met" of a cell, which is counted as met or missed. A missing error misses it."""
        if error and error.mean <= limit:
            self.met += 1
            return [f"{limit:.2f}", "yes"]
        self.missed.append(f"{where}: {error.mean if error else float('nan'):.2f}, target {limit:.2f}")
        return [f"{limit:.2f}", "**no**"]


def estimation(records: Sequence[Record]) -> Comparison:
    """Table 1."""
    comparison = Comparison()
    of_table = pick(records, table="1", quantity=ESTIMATION)
    ours = pick(of_table, source="study")
    for network, data in networks_and_data(ours):
        theirs = pick(of_table, source="paper", network=network)
        splits = [split for split in SPLITS if pick(ours, network=network, data=data, split=split)]
        heads = ["module", "paper"]
        for split in splits:
            heads += [SPLIT_LABELS[split], "ratio"]
        has_target = (network, data) == MAIN and "blocks" in splits
        rows = []
        for module in modules_of(theirs):
            known = cell(theirs, module=module)
            cells = {split: cell(ours, network=network, data=data, split=split, module=module) for split in splits}
            row: list[object] = [module, known]
            for each in cells.values():
                row += [each, ratio(each, known)]
            if has_target and known:
                limit = target(known, None, False)
                row += comparison.target_columns(f"Table 1, module {module}", cells["blocks"], limit)
            rows.append(row)
        comparison.lines += [f"**{NETWORK_LABELS[network]}, {data} data**", ""]
        comparison.lines += table(heads + (["target", "met"] if has_target else []), rows)
    return comparison


def control(records: Sequence[Record], number: str, modules: int) -> Comparison:
    """Table 2 or 3: a table for each network and task; two for task B, without its first steps and with all."""
    comparison = Comparison()
    of_table = pick(records, table=number, quantity=CONTROL, modules=modules)
    for network, data in networks_and_data(pick(of_table, source="study")):
        comparison.lines += [f"### {NETWORK_LABELS[network]}, trained on {data} data, {modules} modules", ""]
        for task in TASKS:
            for skip in sorted({paper.skipped_steps(task), 0}, reverse=True):
                of_task = pick(of_table, task=task, skipped_steps=skip)
                # Task B over all its steps is not in the paper's tables, so it has no target.
                has_target = (network, data) == MAIN and skip == paper.skipped_steps(task)
                steps = f", without the first {skip} steps" if skip else ", all steps" if task == "B" else ""
                where = f"Table {number}, task {task}{steps}"
                rows = _task_table(comparison, of_task, network, data, modules, where, has_target)
                comparison.lines += [f"**task {task}{steps}**", "", *rows]
    return comparison


def _task_table(
    comparison: Comparison,
    records: Sequence[Record],
    network: str,
    data: str,
    modules: int,
    where: str,
    has_target: bool,
) -> list[str]:
    """The table of a task, a row for each module. records: of the task; where: names the table in missed targets."""
    theirs = pick(records, source="paper", network=network)
    rows = []
    for module in range(1, modules + 1):
        known, oracle = cell(theirs, module=module), cell(records, source="oracle", module=module)
        ours = pick(records, source="study", network=network, data=data, module=module)
        row: list[object] = [module, known]
        for correction in CORRECTIONS:
            error = cell(ours, correction=correction)
            row += [error, ratio(error, known)]
            if has_target and known:
                place = f"{where}, module {module}, {CORRECTION_LABELS[correction]}"
                row += comparison.target_columns(place, error, target(known, oracle, correction != "none"))
        row.append(f"{oracle.mean:.2f}" if oracle else "")
        rows.append(row)
    heads = ["module", "paper"]
    for correction in CORRECTIONS:
        heads += [CORRECTION_LABELS[correction], "ratio"] + (["target", "met"] if has_target else [])
    return table([*heads, "oracle error"], rows)


def end_effector(records: Sequence[Record]) -> list[str]:
    """Tasks B and C as in the paper's supplement: a tip that holds its position or its orientation."""
    of_table = [each for each in pick(records, table="end-effector") if each.modules in (4, 6)]
    rows = []
    for quantity, task in ((TIP_DISTANCE, "B"), (TIP_TILT, "C")):
        for modules in (4, 6):
            skip = paper.skipped_steps(task)
            of_task = pick(of_table, quantity=quantity, task=task, skipped_steps=skip, modules=modules)
            oracle = cell(of_task, source="oracle")
            best = f"{oracle.mean:.2f} ± {oracle.std:.2f}" if oracle and oracle.std is not None else ""
            ours = pick(of_task, source="study")
            for network, data in networks_and_data(ours):
                of_network = pick(ours, network=network, data=data)
                errors = [cell(of_network, correction=correction) for correction in CORRECTIONS]
                name = f"{task}: {quantity}, {UNITS[quantity]}"
                rows.append([name, modules, f"{NETWORK_LABELS[network]}, {data}", *errors, best])
    return table(["task", "modules", "controller", *CORRECTION_LABELS.values(), "oracle"], rows)


def module_numbers(records: Sequence[Record]) -> list[str]:
    """The same model on robots of other numbers of modules: mean over the modules, and the worst module."""
    network, data = MAIN
    ours = pick(records, source="study", quantity=CONTROL, network=network, data=data, split="blocks")
    ours = [each for each in ours if each.table in ("2", "3", "modules")]
    numbers = sorted({each.modules for each in ours})
    return _means_and_worst("modules", {str(number): pick(ours, modules=number) for number in numbers})


def robustness(records: Sequence[Record], modules: int) -> list[str]:
    """The effect of a perturbed tracker or robot: mean over the modules, and the worst module."""
    network, data = MAIN
    ours = pick(records, source="study", quantity=CONTROL, network=network, data=data, modules=modules)
    rows = {label: pick(ours, perturbation=perturbation) for perturbation, label in PERTURBATION_LABELS.items()}
    return _means_and_worst("perturbation", rows)


def _means_and_worst(head: str, rows: dict[str, list[Record]]) -> list[str]:
    """A table with a column for each task without and with correction; rows: records by the label of their row."""
    columns = [(correction, task) for correction in CORRECTIONS for task in TASKS]
    texts = []
    for label, records in rows.items():
        row: list[object] = [label]
        for correction, task in columns:
            skip = paper.skipped_steps(task)
            selected = pick(records, task=task, correction=correction, skipped_steps=skip)
            row.append(_mean_and_worst(selected))
        texts.append(row)
    return table([head, *(f"{task}, {CORRECTION_LABELS[correction]}" for correction, task in columns)], texts)


def _mean_and_worst(records: Sequence[Record]) -> str:
    means = [each.mean for module in modules_of(records) if (each := cell(records, module=module))]
    return f"{sum(means) / len(means):.2f} (worst {max(means):.2f})" if means else ""


def covered(records: Sequence[Record]) -> list[str]:
    """Figure 4 as numbers."""
    of_table = pick(records, table="coverage", quantity=COVERED)
    rows = []
    for data in dict.fromkeys(each.data for each in of_table):
        rows.append([data, *(f"{each.mean:.4g}" for each in pick(of_table, data=data))])
    return table([f"data ({UNITS[COVERED]})", *(f"module {module}" for module in modules_of(of_table))], rows)


def networks_and_data(records: Sequence[Record]) -> list[tuple[str, str]]:
    """The pairs of network and data, in the order of the records."""
    return list(dict.fromkeys((str(each.network), str(each.data)) for each in records))


def modules_of(records: Sequence[Record]) -> list[int]:
    """The module numbers of the records, sorted."""
    return sorted({each.module for each in records if each.module is not None})
