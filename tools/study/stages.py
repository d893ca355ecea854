"""The stages that make data sets, models, ONNX files and estimation errors, with the functions of the commands.

Each file is made once. `collect` and `train` resume where they were killed, and refuse an existing file that was made
with other settings.
"""

from __future__ import annotations

import hashlib
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modsoft.runtime import robot as robot_file
from modsoft.runtime.control import model_file
from modsoft.runtime.errors import ModelError
from modsoft.runtime.files import written
from modsoft.study.paths import NOT_READABLE, Folder
from modsoft.study.plan import Data, Model, Plan
from modsoft.study.scheduler import AddProgress, Stage
from modsoft.training import checkpoint as checkpoints
from modsoft.training import fit, train
from modsoft.training.data import dataset
from modsoft.training.data.collect import collect
from modsoft.training.settings import BY_DRIVE, Settings, fastest_precision
from modsoft.training.simulation import simulators

# Estimates for the remaining time: windows trained (batch 128) and samples simulated in a second of one core.
WINDOWS_PER_S = {"bilstm": 2000.0, "lstm": 6000.0, "module-lstm": 2500.0}
SAMPLES_PER_S = 350.0
EXPORT_S, ESTIMATE_S = 15.0, 15.0
CHECK_S = 1.0  # to check an existing file


def collect_stage(plan: Plan, folder: Folder, jobs: int) -> Stage:
    """data/*.h5, one data set after the other; each collection uses all processes itself."""
    return Stage("collect", plan.data, partial(_collect, folder, jobs), partial(collect_s, folder), alone=True)


def collect_s(folder: Folder, data: Data) -> float:
    return CHECK_S if folder.data(data.name).is_file() else data.samples / SAMPLES_PER_S


def _collect(folder: Folder, jobs: int, data: Data, add_progress: AddProgress) -> None:
    robot, before = robot_file.load(data.robot), 0

    def progress(done: int, samples: int) -> None:
        nonlocal before
        add_progress((done - before) / samples)
        before = done

    out = folder.data(data.name)
    collect(robot, out, data.samples, data.strategy, data.seed, data.steps, jobs, simulators.fastest(robot), progress)


def train_stage(plan: Plan, folder: Folder, jobs: int) -> Stage:
    """models/*.pt."""
    return Stage("train", plan.models, partial(_train, plan, folder), partial(train_s, plan, folder))


def train_s(plan: Plan, folder: Folder, model: Model) -> float:
    if folder.checkpoint(model).is_file():
        return CHECK_S
    settings = settings_of(plan, model)
    return settings.iterations * settings.batch / WINDOWS_PER_S[model.network]


def settings_of(plan: Plan, model: Model) -> Settings:
    """The settings that a model is trained with: the plan's, else those of the kind of robot."""
    of_plan = plan.settings.get((model.network, model.data), {})
    of_model = {"network": model.network, "split": model.split, "seed": model.seed}
    precision = {"precision": fastest_precision()}
    return Settings(**BY_DRIVE[plan.drive] | of_model | precision | of_plan)


def _train(plan: Plan, folder: Folder, model: Model, add_progress: AddProgress) -> None:
    before = None

    def progress(now: fit.Progress) -> None:
        nonlocal before
        if before is not None:  # the iterations of an earlier, killed run do not count
            add_progress(now.progress - before)
        before = now.progress

    data = [dataset.read(folder.data(name)) for name in plan.mixes[model.data]]
    train.train(data, folder.checkpoint(model), settings_of(plan, model), progress)


def export_stage(plan: Plan, folder: Folder, jobs: int) -> Stage:
    """models/*.onnx of all models that control a robot; exported again where the checkpoint is newer."""
    controllers = {run.model for run in plan.runs}
    models = [each for each in plan.models if each in controllers]
    missing = [each for each in models if _outdated(folder.onnx(each), folder.checkpoint(each))]
    return Stage("export", missing, partial(_export, folder), lambda model: EXPORT_S)


def _outdated(path: Path, source: Path) -> bool:
    """Whether `path` is missing or older than the `source` that it is made from."""
    return not (path.is_file() and source.is_file() and path.stat().st_mtime_ns >= source.stat().st_mtime_ns)


def _export(folder: Folder, model: Model, add_progress: AddProgress) -> None:
    from modsoft.export.write import export

    export(folder.checkpoint(model), folder.onnx(model))


def onnx_sha256(folder: Folder, model: Model) -> str:
    """SHA-256 of the exported model, which identifies the model of a run."""
    return hashlib.sha256(model_file.read(folder.onnx(model))).hexdigest()


def estimate_stage(plan: Plan, folder: Folder, jobs: int) -> Stage:
    """estimates/*.npz: the errors of Table 1.

    All models are tested on the test part of the same data, the plan's `test_mix`, so that they can be compared. Models
    trained on these data did not see that part in training.
    """
    missing = [each for each in plan.models if _outdated(folder.estimate(each), folder.checkpoint(each))]
    return Stage("estimate", missing, partial(_estimate, plan, folder), lambda model: ESTIMATE_S)


def _estimate(plan: Plan, folder: Folder, model: Model, add_progress: AddProgress) -> None:
    checkpoint = checkpoints.load(folder.checkpoint(model))
    provenance: dict[str, Any] = checkpoint["provenance"]
    mix = plan.test_mix or model.data
    (name,) = plan.mixes[mix]
    data = dataset.read(folder.data(name))
    if model.data == mix and provenance["data_sha256"] != data.sha256():
        raise ModelError(f"{folder.checkpoint(model)}: trained on other data than {folder.data(name)}; delete one")
    _, _, test = dataset.split(data, checkpoint["network"]["history"], model.split, model.seed)
    errors = fit.estimation_errors(checkpoints.network_of(checkpoint), test).numpy()
    with written(folder.estimate(model)) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, error_percent=errors)


def estimation_errors(folder: Folder, model: Model) -> NDArray[np.float32]:
    """Errors of estimation (W, N, A), % of the actuation range; `ModelError` if the file cannot be read."""
    path = folder.estimate(model)
    try:
        with np.load(path, allow_pickle=False) as file:
            return file["error_percent"]
    except NOT_READABLE as error:
        raise ModelError(f"{path}: no readable estimation errors ({error}); delete it and run the study") from error
