"""Every closed-loop run of the study: exported models on simulated robots, many at once, each kept as an .npz."""

from __future__ import annotations

import functools
import itertools
import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from modsoft.runtime import robot as robots
from modsoft.runtime.arrays import Array
from modsoft.runtime.control import correction as corrections
from modsoft.runtime.control.model import Model
from modsoft.runtime.control.tasks import task
from modsoft.runtime.errors import ModelError
from modsoft.runtime.files import written
from modsoft.study import perturbations, stages
from modsoft.study.paths import NOT_READABLE, Folder
from modsoft.study.plan import Plan, Run
from modsoft.study.scheduler import Stage, Told
from modsoft.training import made_from
from modsoft.training.simulation.fleet import simulated
from modsoft.training.simulation.rollout import ControllerSetup, Rollout, rollout

TOGETHER = 16  # robots of a batch: two blocks of the kernel's widest vectors
# What makes a run, beside the model; the modules that these import count too.
MODULES = [
    "modsoft.runtime.control.model",
    "modsoft.runtime.control.tasks",
    "modsoft.training.simulation.rollout",
    "modsoft.training.simulation.fleet",
    "modsoft.study.perturbations",
]
STEP_S = 4e-3  # of one core, for a control step of one robot of four modules, about


class Kept(NamedTuple):
    """A run as it lies in the folder."""

    flight: Rollout
    desired: Array  # (K, N, 3)


def rolling_out(plan: Plan, folder: Folder, jobs: int) -> Stage:
    """runs/*.npz. A run is made again when its model changed, or anything else that shapes it."""
    models = {run.model for run in plan.runs}
    seals = {model: stages.seal(folder, model) if folder.onnx(model).is_file() else "" for model in models}
    missing = [run for run in plan.runs if meta(folder.run(run)) != identity(plan, run, seals[run.model])]
    batches = [
        tuple(batch)
        for alike in _alike(missing)
        for batch in (alike[first : first + TOGETHER] for first in range(0, len(alike), TOGETHER))
    ]
    return Stage("rollout", batches, partial(_rollout, plan, folder), partial(rollout_s, plan))


def rollout_s(plan: Plan, batch: Sequence[Run]) -> float:
    return (plan.steps or 250) * STEP_S * batch[0].modules / 4 * max(8, len(batch))


def _alike(runs: Sequence[Run]) -> list[list[Run]]:
    """Runs that can share a fleet: as many modules, the same plant."""

    def of_fleet(run: Run) -> tuple[int, str]:
        return run.modules, repr(perturbations.plant(run.disturbance, run.modules, run.model.seed))

    return [list(group) for _, group in itertools.groupby(sorted(runs, key=of_fleet), key=of_fleet)]


def identity(plan: Plan, run: Run, seal: str) -> dict[str, Any]:
    """All that the numbers of a run depend on, as plain values."""
    return {
        "model": run.model.name,
        "model_sha256": seal,
        "task": run.task,
        "modules": run.modules,
        "correction": run.correction,
        "disturbance": run.disturbance,
        "seed": run.model.seed,
        "steps": len(desired_of(plan, run.task, run.modules)),
        "code_sha256": code_sha256(),
    }


@functools.cache
def code_sha256() -> str:
    """Digest of the source code that shapes a run, the compiled kernel's included."""
    return made_from.digest({}, modules=MODULES)


def desired_of(plan: Plan, name: str, modules: int) -> Array:
    """The task (K, N, 3), cut where the plan has shorter ones."""
    return task(name, "cable", modules)[: plan.steps]


def _rollout(plan: Plan, folder: Folder, batch: tuple[Run, ...], told: Told) -> None:
    first = batch[0]
    robot = robots.load(f"cable-{first.modules}")
    models = {run.model: Model.load(folder.onnx(run.model)) for run in batch}
    for each in models.values():
        each.check(robot)
    pilots = [
        ControllerSetup(
            robot,
            models[run.model].actuate,
            models[run.model].history,
            desired_of(plan, run.task, run.modules),
            corrections.by_name(run.correction, run.modules),
            perturbations.measure(run.disturbance, run.modules, run.model.seed),
        )
        for run in batch
    ]
    variant = perturbations.plant(first.disturbance, first.modules, first.model.seed)
    flown = simulated("cable", first.modules, len(batch), **variant)
    seals = {model: stages.seal(folder, model) for model in models}
    for run, pilot, flight in zip(batch, pilots, rollout(flown, pilots).robots(), strict=True):
        if not np.isfinite(flight.configuration).all():
            raise ModelError(f"{run.name}: the simulated robot flew apart; no number is made of this run")
        keep(folder.run(run), identity(plan, run, seals[run.model]), flight, pilot.desired)


def keep(path: Path, about: dict[str, Any], flight: Rollout, desired: Array) -> None:
    """Writes a run: configuration (K + 1, N, 3), actions (K, N, A), positions (K + 1, N, 3), m, directors
    (K + 1, N, 3, 3), desired (K, N, 3), meta (JSON)."""
    with written(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, meta=json.dumps(about, sort_keys=True), desired=desired, **flight._asdict())


def read(path: Path) -> Kept:
    """A run by its file; `ModelError` where there is none that can be read."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return Kept(Rollout(*(file[name] for name in Rollout._fields)), file["desired"])
    except NOT_READABLE as error:
        raise ModelError(f"{path}: no run that can be read ({error}); delete it and run again") from error


def meta(path: Path) -> dict[str, Any] | None:
    """What a run says of itself; None where there is none, or a damaged one, which is made again."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return json.loads(str(file["meta"]))
    except NOT_READABLE:
        return None
