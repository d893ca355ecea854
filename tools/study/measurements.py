"""results.json: every number of the report, as a flat list of records, out of what lies in the folder.

A record has all of `KEYS`; what does not apply is None. source: ours (`study`), the paper's (`paper`), or the best
actions known (`floor`). mean and std are over the steps of a task or the windows of a test part, of one module and one
seed; std is None where the paper gives none.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.control.features import angle_between_deg
from modsoft.runtime.errors import ModelError
from modsoft.runtime.files import read_text, written
from modsoft.study import paper, rollouts, stages
from modsoft.study.paths import Folder
from modsoft.study.plan import Plan, Run
from modsoft.study.results import KEYS, Results
from modsoft.study.rollouts import Kept
from modsoft.training import checkpoint as checkpoints
from modsoft.training.data import coverage
from modsoft.training.simulation.parameters import CABLE
from modsoft.training.simulation.rollout import configuration_errors_percent

ESTIMATION, CONTROL = "actuation estimation error, % of the range", "configuration error, % of the unit vector"
TIP_DISTANCE, TIP_TILT = "distance of the tip from the axis, % of the robot's length", "tilt of the tip, degrees"
COVERED = "space covered by the module's end, cm³"

Record = dict[str, Any]


def measure(plan: Plan, folder: Folder) -> None:
    """Writes results.json; `ModelError` where anything of the plan is missing."""
    found = {"about": about(plan, folder), "records": list(records(plan, folder))}
    with written(folder.results) as temporary:
        temporary.write_text(dumped(found), encoding="utf-8")


def dumped(found: dict[str, Any]) -> str:
    """JSON with a record a line, so that two results can be compared line by line."""
    lines = ",\n  ".join(json.dumps(record, ensure_ascii=False) for record in found["records"])
    head = json.dumps(found["about"], indent=1, ensure_ascii=False)
    return f'{{"about": {head},\n "records": [\n  {lines}\n ]}}\n'


def load(path: Path) -> dict[str, Any]:
    """results.json as it was written; `ModelError` for any other file."""
    if not path.is_file():
        raise ModelError(f"no results {path}; modsoft-evaluate study --out {path.parent} makes them")
    try:
        found = msgspec.json.decode(read_text(path))
        msgspec.convert(found, Results)
    except (msgspec.MsgspecError, RecursionError) as error:
        raise ModelError(f"{path}: not the results of this version ({error}); measure again") from error
    return found


def about(plan: Plan, folder: Folder) -> dict[str, Any]:
    """What was trained on what, and how long it took."""
    models = []
    for model in plan.models:
        said = checkpoints.load(folder.checkpoint(model))["provenance"]
        kept = {key: said.get(key) for key in ("iterations_done", "seconds", "samples", "windows", "data_sha256")}
        models.append({"model": model.name, "settings": asdict(stages.settings_of(plan, model)), **kept})
    return {
        "code_version": version("modsoft"),
        "seeds": plan.seeds,
        "steps": plan.steps,
        "data": [asdict(data) for data in plan.data],
        "mixes": plan.mixes,
        "models": models,
    }


def record(**given: Any) -> Record:
    return {**dict.fromkeys(KEYS), **given}


def records(plan: Plan, folder: Folder) -> Iterator[Record]:
    yield from of_the_paper()
    for model in plan.models:
        with np.load(folder.estimate(model), allow_pickle=False) as file:
            errors = file["error_percent"]  # (W, N, A)
        key = {"table": "1", "quantity": ESTIMATION, "source": "study", "modules": errors.shape[1]}
        key |= {"network": model.network, "data": model.data, "split": model.split, "seed": model.seed}
        yield from by_module(key, np.moveaxis(errors, 1, 0).reshape(errors.shape[1], -1).T)
    for run in plan.runs:
        yield from of_run(table_of(run), run_key(run), rollouts.read(folder.run(run)), run.task)
    for task, modules in plan.oracle_errors:
        key = {"source": "floor", "task": task, "modules": modules, "seed": 0}
        table = {4: "2", 6: "3"}.get(modules, "modules")
        yield from of_run(table, key, rollouts.read(folder.oracle_error(task, modules)), task)
    yield from of_coverage(folder)


def table_of(run: Run) -> str:
    if run.disturbance != "none":
        return "robustness"
    return {4: "2", 6: "3"}.get(run.modules, "modules")


def run_key(run: Run) -> Record:
    model = run.model
    return {
        "source": "study",
        "network": model.network,
        "data": model.data,
        "split": model.split,
        "seed": model.seed,
        "task": run.task,
        "modules": run.modules,
        "correction": run.correction,
        "disturbance": run.disturbance,
    }


def of_run(table: str, key: Record, kept: Kept, task: str) -> Iterator[Record]:
    """The errors of every module, and of the end effector in the tasks that hold it (B: its place, C: its
    orientation). Task B without its jump from rest too, as the paper has it."""
    errors = configuration_errors_percent(kept.flight.configuration, kept.desired)
    for skip in (0, paper.JUMP_STEPS) if task == "B" else (0,):
        told = {**key, "skip_first": skip}
        yield from by_module({"table": table, "quantity": CONTROL, **told}, errors[skip:])
        if task != "A" and table != "robustness":
            quantity, values = (TIP_DISTANCE, tip_distance_percent) if task == "B" else (TIP_TILT, tip_tilt_deg)
            of_steps = values(kept)[: len(kept.desired)][skip:]
            yield record(table="end", quantity=quantity, **told, mean=float(of_steps.mean()), std=float(of_steps.std()))


def tip_distance_percent(kept: Kept) -> Array:
    """Distance of the tip from the base's axis, % of the robot's length at rest, at every step (K + 1,)."""
    positions = kept.flight.positions
    return 100.0 * np.linalg.norm(positions[:, -1, :2], axis=-1) / (positions.shape[1] * CABLE.module_length_m)


def tip_tilt_deg(kept: Kept) -> Array:
    """Angle between the tip's tangent and the base's axis, degrees, at every step (K + 1,)."""
    return angle_between_deg(kept.flight.directors[:, -1, 2], np.array([0.0, 0.0, 1.0]))


def by_module(key: Record, values: Array) -> Iterator[Record]:
    """A record for each column of values (samples, N)."""
    for module, column in enumerate(values.T, start=1):
        yield record(**key, module=module, mean=float(column.mean()), std=float(column.std()))


def of_coverage(folder: Folder) -> Iterator[Record]:
    """Figure 4 as numbers."""
    paths = [folder.data("paper"), folder.data("traditional")]
    for each in coverage.compare(paths):
        key = {"table": "coverage", "quantity": COVERED, "source": "study", "modules": len(each.covered)}
        for module, value in enumerate(each.covered, start=1):
            yield record(**key, data=each.name.removesuffix(".h5"), module=module, mean=float(value))


def of_the_paper() -> Iterator[Record]:
    def row(key: Record, means: list[float], stds: list[float] | None) -> Iterator[Record]:
        for module, mean in enumerate(means, start=1):
            std = None if stds is None else stds[module - 1]
            yield record(source="paper", modules=len(means), **key, module=module, mean=mean, std=std)

    for network, (means, stds) in paper.TABLE_1.items():
        key = {"table": "1", "quantity": ESTIMATION, "network": network, "split": "shuffled"}
        yield from row(key, means, stds)
    for (network, task), (means, stds) in paper.TABLE_2.items():
        key = {"table": "2", "quantity": CONTROL, "network": network, "task": task, "correction": "none"}
        yield from row({**key, "skip_first": paper.JUMP_STEPS if task == "B" else 0}, means, stds)
    key = {"quantity": CONTROL, "network": "bilstm", "correction": "none"}
    yield from row({"table": "2", "task": "B", "skip_first": 0, **key}, paper.TABLE_2_B_ALL_STEPS, None)
    for task, means in paper.TABLE_3.items():
        skip = paper.JUMP_STEPS if task == "B" else 0
        yield from row({"table": "3", "task": task, "skip_first": skip, **key}, means, None)
