"""The stage of the closed-loop runs: exported models on simulated robots, in batches, each run stored as an .npz."""

from __future__ import annotations

import functools
import itertools
import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from modsoft.runtime import robot as robot_file
from modsoft.runtime.arrays import Array
from modsoft.runtime.control import correction as corrections
from modsoft.runtime.control.model import Model
from modsoft.runtime.control.tasks import task
from modsoft.runtime.errors import ModelError
from modsoft.runtime.files import written
from modsoft.study import perturbations, stages
from modsoft.study.paths import NOT_READABLE, Folder
from modsoft.study.plan import Plan, Run
from modsoft.study.scheduler import AddProgress, Stage
from modsoft.training import made_from
from modsoft.training.simulation.fleet import simulated
from modsoft.training.simulation.parameters import Perturbation
from modsoft.training.simulation.rollout import ControllerSetup, Rollout, rollout

BATCH_SIZE = 16  # robots: two blocks of the kernel's widest vectors
# The code that a run depends on, with all that these modules import.
MODULES = [
    "modsoft.runtime.control.model",
    "modsoft.runtime.control.tasks",
    "modsoft.training.simulation.rollout",
    "modsoft.training.simulation.fleet",
    "modsoft.study.perturbations",
]
STEP_S = 4e-3  # estimated seconds for a control step of one robot of four modules on one core


class StoredRun(NamedTuple):
    """A run as stored in the folder."""

    rollout: Rollout
    desired: Array  # (K, N, 3)


def rollout_stage(plan: Plan, folder: Folder, jobs: int) -> Stage:
    """runs/*.npz. A run is made again when its model or anything else that it depends on has changed."""
    models = {run.model for run in plan.runs}
    sha256 = {model: stages.onnx_sha256(folder, model) if folder.onnx(model).is_file() else "" for model in models}
    missing = [run for run in plan.runs if stored_identity(folder.run(run)) != identity(plan, run, sha256[run.model])]
    batches = [
        tuple(runs[first : first + BATCH_SIZE])
        for runs in _by_robot(missing)
        for first in range(0, len(runs), BATCH_SIZE)
    ]
    return Stage("rollout", batches, partial(_rollout, plan, folder), partial(rollout_s, plan))


def rollout_s(plan: Plan, batch: Sequence[Run]) -> float:
    """Estimated seconds on one core; fewer than eight robots take as long as eight, a vector of the kernel."""
    return (plan.steps or 250) * STEP_S * batch[0].modules / 4 * max(8, len(batch))


def _by_robot(runs: Sequence[Run]) -> list[list[Run]]:
    """The runs grouped by their simulated robot: those of a group can run in one fleet."""

    def robot_of(run: Run) -> tuple[int, str]:
        return run.modules, repr(perturbations.robot_properties(run.perturbation, run.modules, run.model.seed))

    return [list(group) for _, group in itertools.groupby(sorted(runs, key=robot_of), key=robot_of)]


def identity(plan: Plan, run: Run, model_sha256: str) -> dict[str, Any]:
    """What the numbers of a run depend on."""
    return {
        "model": run.model.name,
        "model_sha256": model_sha256,
        "task": run.task,
        "modules": run.modules,
        "correction": run.correction,
        "perturbation": run.perturbation,
        "seed": run.model.seed,
        "steps": len(desired_of(plan, run.task, run.modules)),
        "code_sha256": code_sha256(),
    }


@functools.cache
def code_sha256() -> str:
    """Digest of the source code that a run depends on, the compiled kernel's included."""
    return made_from.digest({}, modules=MODULES)


def desired_of(plan: Plan, name: str, modules: int) -> Array:
    """The desired configurations (K, N, 3) of a task, as many steps as the plan has."""
    return task(name, "spatial", modules)[: plan.steps]


def _rollout(plan: Plan, folder: Folder, batch: tuple[Run, ...], add_progress: AddProgress) -> None:
    first = batch[0]
    robot = robot_file.load(f"cable-{first.modules}")
    models = {run.model: Model.load(folder.onnx(run.model)) for run in batch}
    for each in models.values():
        each.check(robot)
    setups = [
        ControllerSetup(
            robot,
            models[run.model].actuate,
            models[run.model].history,
            desired_of(plan, run.task, run.modules),
            corrections.by_name(run.correction, run.modules),
            perturbations.measurement(run.perturbation, run.modules, run.model.seed),
        )
        for run in batch
    ]
    properties = perturbations.robot_properties(first.perturbation, first.modules, first.model.seed)
    simulator = simulated(robot, len(batch), perturbation=Perturbation(**properties))
    sha256 = {model: stages.onnx_sha256(folder, model) for model in models}
    for run, setup, motion in zip(batch, setups, rollout(simulator, setups).robots(), strict=True):
        if not np.isfinite(motion.configuration).all():
            raise ModelError(f"{run.name}: the simulated robot diverged; expected finite configurations")
        store(folder.run(run), identity(plan, run, sha256[run.model]), motion, setup.desired)


def store(path: Path, depends_on: dict[str, Any], motion: Rollout, desired: Array) -> None:
    """Writes a run: configuration (K + 1, N, 3), actions (K, N, A), positions (K + 1, N, 3), m, directors
    (K + 1, N, 3, 3), desired (K, N, 3), meta (JSON)."""
    with written(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, meta=json.dumps(depends_on, sort_keys=True), desired=desired, **motion._asdict())


def read(path: Path) -> StoredRun:
    """Reads a run; `ModelError` if the file cannot be read."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return StoredRun(Rollout(*(file[name] for name in Rollout._fields)), file["desired"])
    except NOT_READABLE as error:
        raise ModelError(f"{path}: no readable run ({error}); delete it and run the study again") from error


def stored_identity(path: Path) -> dict[str, Any] | None:
    """What a stored run depends on; None if the file is missing or damaged, so that it is made again."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return json.loads(str(file["meta"]))
    except NOT_READABLE:
        return None
