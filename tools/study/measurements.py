"""The records of results.json, measured from the files of a study's folder."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from importlib.metadata import version
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from modsoft.runtime import robot as robot_file
from modsoft.runtime.arrays import Array
from modsoft.runtime.control.features import angle_between_deg
from modsoft.runtime.files import written
from modsoft.study import paper, rollouts, stages
from modsoft.study.paths import Folder
from modsoft.study.plan import Plan, Run
from modsoft.study.results import (
    CONTROL,
    CONTROL_TABLES,
    COVERED,
    ESTIMATION,
    TIP_DISTANCE,
    TIP_TILT,
    About,
    Data,
    Model,
    Record,
    Results,
    Settings,
    dumped,
    record,
)
from modsoft.study.rollouts import StoredRun
from modsoft.training import checkpoint as checkpoints
from modsoft.training.data import coverage
from modsoft.training.simulation.parameters import plant_of
from modsoft.training.simulation.rollout import configuration_errors_percent

Fields = dict[str, Any]  # fields of a Record that several records share


def measure(plan: Plan, folder: Folder) -> None:
    """Writes results.json; `ModelError` where a file of the plan is missing."""
    results = Results(about(plan, folder), list(records(plan, folder)))
    with written(folder.results) as temporary:
        temporary.write_text(dumped(results), encoding="utf-8")


def about(plan: Plan, folder: Folder) -> About:
    """What was trained on what, and how long it took."""
    models = []
    for model in plan.models:
        provenance = checkpoints.load(folder.checkpoint(model))["provenance"]
        # Not those of the plan: their precision depends on the machine, which may not be the one of the training.
        settings = msgspec.convert(provenance, Settings)
        models.append(msgspec.convert({**provenance, "name": model.name, "settings": settings}, Model))
    return About(
        code_version=version("modsoft"),
        seeds=plan.seeds,
        steps=plan.steps,
        data=[msgspec.convert(asdict(data), Data) for data in plan.data],
        mixes={name: list(names) for name, names in plan.mixes.items()},
        models=models,
    )


def records(plan: Plan, folder: Folder) -> Iterator[Record]:
    """Every record of results.json."""
    yield from of_the_paper()
    for model in plan.models:
        errors = stages.estimation_errors(folder, model)  # (W, N, A)
        fields = {"table": "1", "source": "study", "modules": errors.shape[1]}
        fields |= {"network": model.network, "data": model.data, "split": model.split, "seed": model.seed}
        yield from by_module(ESTIMATION, fields, np.moveaxis(errors, 1, 0).reshape(errors.shape[1], -1).T)
    for run in plan.runs:
        yield from of_run(table_of(run), fields_of(run), rollouts.read(folder.run(run)), run.task)
    for task, modules in plan.oracle_errors:
        fields = {"source": "oracle", "task": task, "modules": modules, "seed": 0}
        table = CONTROL_TABLES.get(modules, "modules")
        yield from of_run(table, fields, rollouts.read(folder.oracle_error(task, modules)), task)
    yield from of_coverage(folder)


def table_of(run: Run) -> str:
    """The table that a run belongs to."""
    return "robustness" if run.perturbation != "none" else CONTROL_TABLES.get(run.modules, "modules")


def fields_of(run: Run) -> Fields:
    """The fields that identify a run."""
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
        "perturbation": run.perturbation,
    }


def of_run(table: str, fields: Fields, stored: StoredRun, task: str) -> Iterator[Record]:
    """The errors of every module, and of the tip in the tasks that hold it (B: its position, C: its orientation).

    Task B is measured twice: over all steps, and without its jump from rest as in the paper.
    """
    errors = configuration_errors_percent(stored.rollout.configuration, stored.desired)
    for skip in sorted({0, paper.skipped_steps(task)}):
        counted = {**fields, "skipped_steps": skip}
        yield from by_module(CONTROL, {"table": table, **counted}, errors[skip:])
        if task != "A" and table != "robustness":
            quantity, values = (TIP_DISTANCE, tip_distance_percent) if task == "B" else (TIP_TILT, tip_tilt_deg)
            of_steps = values(stored)[: len(stored.desired)][skip:]
            mean, std = float(of_steps.mean()), float(of_steps.std())
            yield record(quantity, table="end-effector", **counted, mean=mean, std=std)


def tip_distance_percent(stored: StoredRun) -> Array:
    """Distance of the tip from the base's axis, % of the robot's length at rest, at every step (K + 1,)."""
    positions = stored.rollout.positions
    length_m = plant_of(robot_file.load("cable-4")).module_length_m * positions.shape[1]
    return 100.0 * np.linalg.norm(positions[:, -1, :2], axis=-1) / length_m


def tip_tilt_deg(stored: StoredRun) -> Array:
    """Angle between the tip's tangent and the base's axis, degrees, at every step (K + 1,)."""
    return angle_between_deg(stored.rollout.directors[:, -1, 2], np.array([0.0, 0.0, 1.0]))


def by_module(quantity: str, fields: Fields, values: NDArray[np.floating]) -> Iterator[Record]:
    """A record for each column of values (samples, N)."""
    for module, column in enumerate(values.T, start=1):
        yield record(quantity, **fields, module=module, mean=float(column.mean()), std=float(column.std()))


def of_coverage(folder: Folder) -> Iterator[Record]:
    """Figure 4 as numbers."""
    paths = [folder.data("paper"), folder.data("traditional")]
    for each in coverage.compare(paths):
        fields = {"table": "coverage", "source": "study", "modules": len(each.covered)}
        for module, value in enumerate(each.covered, start=1):
            yield record(COVERED, **fields, data=each.name.removesuffix(".h5"), module=module, mean=float(value))


def of_the_paper() -> Iterator[Record]:
    """The paper's Tables 1 to 3."""

    def row(quantity: str, means: list[float], stds: list[float] | None, **fields: Any) -> Iterator[Record]:
        for module, mean in enumerate(means, start=1):
            std = None if stds is None else stds[module - 1]
            yield record(quantity, source="paper", modules=len(means), **fields, module=module, mean=mean, std=std)

    def control(table: str, network: str, task: str, skip: int, means: Any, stds: Any = None) -> Iterator[Record]:
        fields = {"network": network, "task": task, "correction": "none", "skipped_steps": skip}
        yield from row(CONTROL, means, stds, table=table, **fields)

    for network, (means, stds) in paper.TABLE_1.items():
        yield from row(ESTIMATION, means, stds, table="1", network=network, split="shuffled")
    for (network, task), (means, stds) in paper.TABLE_2.items():
        yield from control("2", network, task, paper.skipped_steps(task), means, stds)
    yield from control("2", "bilstm", "B", 0, paper.TABLE_2_B_ALL_STEPS)
    for task, means in paper.TABLE_3.items():
        yield from control("3", "bilstm", task, paper.skipped_steps(task), means)
