"""The report's tables, each from the records alone. A mark that is missed is given back beside the lines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from modsoft.runtime.choices import CORRECTIONS
from modsoft.study import paper
from modsoft.study.cells import Cell, cell, mark, pick, ratio, table
from modsoft.study.measurements import CONTROL, COVERED, ESTIMATION, TIP_DISTANCE, TIP_TILT, Record
from modsoft.study.perturbations import WORDS
from modsoft.study.plan import MAIN, SPLITS, TASKS

NETWORK_WORDS = {"module-lstm": "four LSTM", "lstm": "LSTM", "bilstm": "biLSTM"}
SPLIT_WORDS = {"blocks": "contiguous blocks", "shuffled": "shuffled windows"}
CORRECTION_WORDS = {"none": "network alone", "integral": "with correction"}


class Told(NamedTuple):
    """lines of Markdown; missed: the cells that miss their mark; met: how many do not."""

    lines: list[str]
    missed: list[str]
    met: int


def estimation(records: Sequence[Record]) -> Told:
    """Table 1."""
    lines: list[str] = []
    missed: list[str] = []
    met = 0
    of_table = pick(records, table="1", quantity=ESTIMATION)
    ours = pick(of_table, source="study")
    for network, data in dict.fromkeys((record["network"], record["data"]) for record in ours):
        theirs = pick(of_table, source="paper", network=network)
        splits = [split for split in SPLITS if pick(ours, network=network, data=data, split=split)]
        heads = ["module", "paper"]
        for split in splits:
            heads += [SPLIT_WORDS[split], "ratio"]
        judged = (network, data) == MAIN and "blocks" in splits
        rows = []
        for module in modules_of(theirs):
            known = cell(theirs, module=module)
            row: list[object] = [module, known]
            for split in splits:
                found = cell(ours, network=network, data=data, split=split, module=module)
                row += [found, ratio(found, known)]
            if judged and known:
                found = cell(ours, network=network, data=data, split="blocks", module=module)
                met, words = _judge(f"Table 1, module {module}", found, mark(known, None, False), missed, met)
                row += words
            rows.append(row)
        lines += [f"**{NETWORK_WORDS[network]}, {data} data**", ""]
        lines += table(heads + (["mark", "met"] if judged else []), rows)
    return Told(lines, missed, met)


def control(records: Sequence[Record], number: str, modules: int) -> Told:
    """Table 2 or 3: a table for each network, task and way of counting task B."""
    lines: list[str] = []
    missed: list[str] = []
    met = 0
    of_table = pick(records, table=number, quantity=CONTROL, modules=modules)
    ours = pick(of_table, source="study")
    for network, data in dict.fromkeys((record["network"], record["data"]) for record in ours):
        lines += [f"### {NETWORK_WORDS[network]}, trained on {data} data, {modules} modules", ""]
        for task in TASKS:
            for skip in (paper.JUMP_STEPS, 0) if task == "B" else (0,):
                here = {"task": task, "skip_first": skip}
                theirs = pick(of_table, source="paper", network=network, **here)
                floors = pick(of_table, source="floor", **here)
                # over all of task B's steps, the paper has no numbers of its own
                judged = (network, data) == MAIN and (task != "B" or skip > 0)
                counted = f", without the first {skip} steps" if skip else ", all steps" if task == "B" else ""
                name = f"task {task}{counted}"
                rows = []
                for module in range(1, modules + 1):
                    known, floor = cell(theirs, module=module), cell(floors, module=module)
                    row: list[object] = [module, known]
                    for correction in CORRECTIONS:
                        found = cell(ours, network=network, data=data, correction=correction, module=module, **here)
                        row += [found, ratio(found, known)]
                        if judged and known:
                            limit = mark(known, floor, correction != "none")
                            where = f"Table {number}, {name}, module {module}, {CORRECTION_WORDS[correction]}"
                            met, words = _judge(where, found, limit, missed, met)
                            row += words
                    row.append(f"{floor.mean:.2f}" if floor else "")
                    rows.append(row)
                heads = ["module", "paper"]
                for correction in CORRECTIONS:
                    heads += [CORRECTION_WORDS[correction], "ratio"] + (["mark", "met"] if judged else [])
                lines += [f"**{name}**", "", *table([*heads, "floor"], rows)]
    return Told(lines, missed, met)


def _judge(where: str, found: Cell | None, limit: float, missed: list[str], met: int) -> tuple[int, list[str]]:
    """Whether a cell meets its mark; what does not is added to `missed`."""
    if found and found.mean <= limit:
        return met + 1, [f"{limit:.2f}", "yes"]
    missed.append(f"{where}: {found.mean if found else float('nan'):.2f}, mark {limit:.2f}")
    return met, [f"{limit:.2f}", "**no**"]


def end_effector(records: Sequence[Record]) -> list[str]:
    """Tasks B and C as the paper's supplement means them: a tip that stays where it is, or as it points."""
    of_table = [record for record in pick(records, table="end") if record["modules"] in (4, 6)]
    rows = []
    for quantity, task, skip in ((TIP_DISTANCE, "B", paper.JUMP_STEPS), (TIP_TILT, "C", 0)):
        for modules in (4, 6):
            here = pick(of_table, quantity=quantity, task=task, skip_first=skip, modules=modules)
            floor = cell(here, source="floor")
            ours = pick(here, source="study")
            for network, data in dict.fromkeys((record["network"], record["data"]) for record in ours):
                of_network = pick(ours, network=network, data=data)
                found = [cell(of_network, correction=correction) for correction in CORRECTIONS]
                best = f"{floor.mean:.2f} ± {floor.std:.2f}" if floor and floor.std is not None else ""
                rows.append([f"{task}: {quantity}", modules, f"{NETWORK_WORDS[network]}, {data}", *found, best])
    return table(["task", "modules", "controller", *CORRECTION_WORDS.values(), "best actions known"], rows)


def module_numbers(records: Sequence[Record]) -> list[str]:
    """The same model on robots of other lengths: the mean over the modules, and the worst of them."""
    network, data = MAIN
    ours = pick(records, source="study", quantity=CONTROL, network=network, data=data, split="blocks")
    ours = [record for record in ours if record["table"] in ("2", "3", "modules")]
    rows = []
    for modules in sorted({record["modules"] for record in ours}):
        row: list[object] = [modules]
        for correction in CORRECTIONS:
            for task in TASKS:
                skip = paper.JUMP_STEPS if task == "B" else 0
                here = pick(ours, modules=modules, task=task, correction=correction, skip_first=skip)
                row.append(_mean_and_worst(here))
        rows.append(row)
    heads = ["modules"] + [f"{task}, {CORRECTION_WORDS[each]}" for each in CORRECTIONS for task in TASKS]
    return table(heads, rows)


def robustness(records: Sequence[Record], modules: int) -> list[str]:
    """What a bad tracker and another robot cost: the mean over the modules, and the worst of them."""
    network, data = MAIN
    ours = pick(records, source="study", quantity=CONTROL, network=network, data=data, modules=modules)
    rows = []
    for disturbance, words in WORDS.items():
        row: list[object] = [words]
        for correction in CORRECTIONS:
            for task in TASKS:
                skip = paper.JUMP_STEPS if task == "B" else 0
                key = {"disturbance": disturbance, "task": task, "correction": correction, "skip_first": skip}
                row.append(_mean_and_worst(pick(ours, **key)))
        rows.append(row)
    heads = ["disturbed by"] + [f"{task}, {CORRECTION_WORDS[each]}" for each in CORRECTIONS for task in TASKS]
    return table(heads, rows)


def _mean_and_worst(records: Sequence[Record]) -> str:
    cells = [found for module in modules_of(records) if (found := cell(records, module=module))]
    if not cells:
        return ""
    means = [each.mean for each in cells]
    return f"{sum(means) / len(means):.2f} (worst {max(means):.2f})"


def covered(records: Sequence[Record]) -> list[str]:
    """Figure 4 as numbers."""
    of_table = pick(records, table="coverage", quantity=COVERED)
    rows = []
    for data in dict.fromkeys(record["data"] for record in of_table):
        here = pick(of_table, data=data)
        rows.append([data, *(f"{record['mean']:.4g}" for record in here)])
    return table(["data", *(f"module {module}" for module in modules_of(of_table))], rows)


def modules_of(records: Sequence[Record]) -> list[int]:
    return sorted({record["module"] for record in records if record["module"] is not None})
