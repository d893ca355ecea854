"""Data, models, ONNX files and their estimation errors: every file made once, by the parts that a user would call.

`collect` and `train` go on where they were killed, and refuse what is there of another recipe or other settings.
"""

from __future__ import annotations

import hashlib
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modsoft.runtime import robot as robots
from modsoft.runtime.control import model_file
from modsoft.runtime.errors import ModelError
from modsoft.runtime.files import written
from modsoft.study.paths import NOT_READABLE, Folder
from modsoft.study.plan import Data, Model, Plan
from modsoft.study.scheduler import Stage, Told
from modsoft.training import checkpoint as checkpoints
from modsoft.training import train
from modsoft.training.data import dataset
from modsoft.training.data.collect import collect
from modsoft.training.simulation import simulators

# About what a core does in a second, for the time that is left: windows trained on (batch 128), samples simulated.
TRAINED_PER_S = {"bilstm": 2000.0, "lstm": 6000.0, "module-lstm": 2500.0}
SIMULATED_PER_S = 350.0
EXPORT_S, ESTIMATE_S = 15.0, 15.0
THERE_S = 1.0  # to prove that what is there is what was asked for


def collecting(plan: Plan, folder: Folder, jobs: int) -> Stage:
    """data/*.h5. One data set after the other, each dealt out to the processes by the collection itself."""
    return Stage("collect", plan.data, partial(_collect, folder, jobs), partial(collect_s, folder), alone=True)


def collect_s(folder: Folder, data: Data) -> float:
    return THERE_S if folder.data(data.name).is_file() else data.samples / SIMULATED_PER_S


def _collect(folder: Folder, jobs: int, data: Data, told: Told) -> None:
    robot, before = robots.load(data.robot), 0

    def progress(done: int, samples: int) -> None:
        nonlocal before
        told((done - before) / samples)
        before = done

    out = folder.data(data.name)
    collect(robot, out, data.samples, data.strategy, data.seed, data.steps, jobs, simulators.fastest(robot), progress)


def training(plan: Plan, folder: Folder, jobs: int) -> Stage:
    """models/*.pt."""
    return Stage("train", plan.models, partial(_train, plan, folder), partial(train_s, plan, folder))


def train_s(plan: Plan, folder: Folder, model: Model) -> float:
    if folder.checkpoint(model).is_file():
        return THERE_S
    settings = settings_of(plan, model)
    return settings.iterations * settings.batch / TRAINED_PER_S[model.network]


def settings_of(plan: Plan, model: Model) -> train.Settings:
    given = plan.settings.get((model.network, model.data), {})
    asked = {"network": model.network, "split": model.split, "seed": model.seed, "precision": train.fastest_precision()}
    return train.Settings(**train.BY_KIND["cable"] | asked | given)


def _train(plan: Plan, folder: Folder, model: Model, told: Told) -> None:
    share = None

    def progress(now: train.Progress) -> None:
        nonlocal share
        if share is not None:  # what an earlier run did does not count into the rate
            told(now.share - share)
        share = now.share

    data = [dataset.read(folder.data(name)) for name in plan.mixes[model.data]]
    train.train(data, folder.checkpoint(model), settings_of(plan, model), progress)


def exporting(plan: Plan, folder: Folder, jobs: int) -> Stage:
    """models/*.onnx of all models that control; made again where the checkpoint is younger."""
    flown = {run.model for run in plan.runs}
    missing = [each for each in plan.models if each in flown and _older(folder.onnx(each), folder.checkpoint(each))]
    return Stage("export", missing, partial(_export, folder), lambda model: EXPORT_S)


def _older(made: Path, source: Path) -> bool:
    """Whether `made` has to be made (again) from `source`."""
    return not (made.is_file() and source.is_file() and made.stat().st_mtime_ns >= source.stat().st_mtime_ns)


def _export(folder: Folder, model: Model, told: Told) -> None:
    from modsoft.export.write import export

    export(folder.checkpoint(model), folder.onnx(model))


def seal(folder: Folder, model: Model) -> str:
    """SHA-256 of the exported model, by which a run knows whose it is."""
    return hashlib.sha256(model_file.read(folder.onnx(model))).hexdigest()


def estimating(plan: Plan, folder: Folder, jobs: int) -> Stage:
    """estimates/*.npz: the errors of Table 1. All models are tried on the test part of the same data, the paper's, so
    that they can be compared; for one trained on those data the part is the one that its training left out."""
    missing = [each for each in plan.models if _older(folder.estimate(each), folder.checkpoint(each))]
    return Stage("estimate", missing, partial(_estimate, plan, folder), lambda model: ESTIMATE_S)


def _estimate(plan: Plan, folder: Folder, model: Model, told: Told) -> None:
    checkpoint = checkpoints.load(folder.checkpoint(model))
    provenance: dict[str, Any] = checkpoint["provenance"]
    (name,) = plan.mixes["paper"]
    data = dataset.read(folder.data(name))
    if model.data == "paper" and provenance["data_sha256"] != data.sha256():
        raise ModelError(f"{folder.checkpoint(model)}: trained on other data than {folder.data(name)}; delete one")
    _, _, test = dataset.split(data, checkpoint["network"]["history"], model.split, model.seed)
    errors = train.estimation_errors(checkpoints.network_of(checkpoint), test).numpy()
    with written(folder.estimate(model)) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, error_percent=errors)


def estimated(folder: Folder, model: Model) -> NDArray[np.float32]:
    """Errors of estimation (W, N, A), % of the actuation range; `ModelError` where there are none to be read."""
    path = folder.estimate(model)
    try:
        with np.load(path, allow_pickle=False) as file:
            return file["error_percent"]
    except NOT_READABLE as error:
        raise ModelError(f"{path}: no estimation errors that can be read ({error}); delete it and go on") from error
