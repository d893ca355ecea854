"""Data, models, ONNX files and their estimation errors: every file made once, by the parts that a user would call.

`collect` and `train` go on where they were killed, and refuse what is there of another recipe or other settings.
"""

from __future__ import annotations

import hashlib
from functools import partial
from typing import Any

import numpy as np

from modsoft.runtime import artefact
from modsoft.runtime import robot as robots
from modsoft.runtime.errors import ModelError
from modsoft.runtime.files import written
from modsoft.study import work
from modsoft.study.folder import Folder
from modsoft.study.plan import Data, Model, Plan
from modsoft.training import checkpoint as checkpoints
from modsoft.training import dataset, plants, train
from modsoft.training.collect import collect

# About what a core does in a second, for the time that is left: windows trained on (batch 128), samples simulated.
TRAINED_PER_S = {"bilstm": 2000.0, "lstm": 6000.0, "module-lstm": 2500.0}
SIMULATED_PER_S = 350.0
EXPORT_S, ESTIMATE_S = 15.0, 15.0


def collect_all(plan: Plan, folder: Folder, jobs: int) -> None:
    """data/*.h5. One data set after the other, each dealt out to the processes by the collection itself."""
    missing = [each for each in plan.data if not folder.data(each.name).is_file()]
    work.spread("collect", partial(_collect, folder, jobs), missing, collect_s, jobs=1)


def collect_s(data: Data) -> float:
    return data.samples / SIMULATED_PER_S


def _collect(folder: Folder, jobs: int, data: Data, told: work.Told) -> None:
    robot, before = robots.load(data.robot), 0

    def progress(done: int, samples: int) -> None:
        nonlocal before
        told((done - before) / samples)
        before = done

    out = folder.data(data.name)
    collect(robot, out, data.samples, data.strategy, data.seed, data.steps, jobs, plants.fastest(robot), progress)


def train_all(plan: Plan, folder: Folder, jobs: int) -> None:
    """models/*.pt. Those that are there are left to `train` too: it refuses one of other settings or data."""
    work.spread("train", partial(_train, plan, folder), plan.models, partial(train_s, plan, folder), jobs)


def train_s(plan: Plan, folder: Folder, model: Model) -> float:
    if folder.checkpoint(model).is_file():
        return 1.0
    settings = settings_of(plan, model)
    return settings.iterations * settings.batch / TRAINED_PER_S[model.network]


def settings_of(plan: Plan, model: Model) -> train.Settings:
    given = plan.settings.get((model.network, model.data), {})
    asked = {"network": model.network, "split": model.split, "seed": model.seed, **given}
    return train.Settings(**{**train.BY_KIND["cable"], **asked})


def _train(plan: Plan, folder: Folder, model: Model, told: work.Told) -> None:
    share = None

    def progress(now: train.Progress) -> None:
        nonlocal share
        if share is not None:  # what an earlier run did does not count into the rate
            told(now.share - share)
        share = now.share

    data = [dataset.read(folder.data(name)) for name in plan.mixes[model.data]]
    train.train(data[0], folder.checkpoint(model), settings_of(plan, model), progress)


def export_all(plan: Plan, folder: Folder, jobs: int) -> None:
    """models/*.onnx of all models that fly; made again where the checkpoint is younger."""
    flown = {run.model for run in plan.runs}
    missing = [model for model in plan.models if model in flown and not _is_exported(folder, model)]
    work.spread("export", partial(_export, folder), missing, lambda model: EXPORT_S, jobs)


def _is_exported(folder: Folder, model: Model) -> bool:
    out = folder.onnx(model)
    return out.is_file() and out.stat().st_mtime_ns >= folder.checkpoint(model).stat().st_mtime_ns


def _export(folder: Folder, model: Model, told: work.Told) -> None:
    from modsoft.export.write import export

    export(folder.checkpoint(model), folder.onnx(model))


def seal(folder: Folder, model: Model) -> str:
    """SHA-256 of the exported model, by which a run knows whose it is."""
    return hashlib.sha256(artefact.read(folder.onnx(model))).hexdigest()


def estimate_all(plan: Plan, folder: Folder, jobs: int) -> None:
    """estimates/*.npz: the errors of Table 1. All models are tried on the test part of the same data, the paper's, so
    that they can be compared; for one trained on those data the part is the one that its training left out."""
    missing = [model for model in plan.models if not _is_estimated(folder, model)]
    work.spread("estimate", partial(_estimate, plan, folder), missing, lambda model: ESTIMATE_S, jobs)


def _is_estimated(folder: Folder, model: Model) -> bool:
    out = folder.estimate(model)
    return out.is_file() and out.stat().st_mtime_ns >= folder.checkpoint(model).stat().st_mtime_ns


def _estimate(plan: Plan, folder: Folder, model: Model, told: work.Told) -> None:
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
