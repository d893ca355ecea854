"""Training: from data sets to a checkpoint, in a run that can be stopped at any time.

`OUT.resume` beside the model holds all that it takes to resume. An interrupted run ends with the same weights, bit for
bit, as an uninterrupted one (with the same number of threads, on the same machine, without a time budget).
"""

from __future__ import annotations

import contextlib
import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from modsoft.runtime.control.features import feature_names
from modsoft.runtime.errors import ModelError, TargetNotReached
from modsoft.runtime.files import check_writable, target_of
from modsoft.runtime.locks import locked
from modsoft.training import checkpoint as checkpoints
from modsoft.training import networks, optimizer
from modsoft.training.data.dataset import DataSet, Windows, split
from modsoft.training.fit import Fit, Progress, estimation_errors
from modsoft.training.settings import Settings, check_machine


def train(
    data: Sequence[DataSet],
    out: Path,
    settings: Settings,
    report: Callable[[Progress], None] = lambda progress: None,
    clock: Callable[[], float] = time.monotonic,
) -> dict[str, Any]:
    """Trains on all windows of the data sets, which are of one robot; writes the checkpoint `out` and returns it.

    Each data set is split on its own. A finished `out` of the same data and settings is returned unchanged, and a run
    resumes from `out.resume`; files of other data or settings are refused. report: called after every step. Sets
    torch's threads and random state for the whole process.

    Raises `InUse` while another process trains `out`; `ModelError` where the training diverges; `TargetNotReached`
    where the run ends above `settings.target_percent`, with the model written.
    """
    check_machine(settings)
    check_writable(out)
    out = target_of(out)  # through a link, the state is saved beside its target
    with locked(out.with_name(f"{out.name}.lock"), out, "modsoft-train"):
        return _train(data, out, settings, report, clock)


def _train(
    data: Sequence[DataSet],
    out: Path,
    settings: Settings,
    report: Callable[[Progress], None],
    clock: Callable[[], float],
) -> dict[str, Any]:
    torch.set_num_threads(settings.threads)
    torch.manual_seed(settings.seed)
    robot = _robot(data)
    splits = [split(each, settings.history, settings.split, settings.seed) for each in data]
    training, validation, test = (Windows.joined(parts) for parts in zip(*splits, strict=True))
    description = _description(settings, training, robot["robot"]["modules"])
    network = networks.build(description)
    identity = {"data_sha256": data_sha256(data), "optimizer": optimizer.DESCRIPTION, **asdict(settings)}
    resume = out.with_name(f"{out.name}.resume")
    if out.exists():
        return _finished(out, resume, identity, settings)
    fit = Fit(network, training, validation, settings)
    if resume.is_file():
        _resume(fit, resume, identity)
    fit.run(lambda state: checkpoints.save({"identity": identity, **state}, resume), report, clock)
    if fit.best is None or fit.best_percent > 100.0:  # more than the error of any guess within the range
        resume.unlink(missing_ok=True)
        raise ModelError(
            f"{out}: training diverged, validation error {fit.best_percent:.3g} % of the actuation range at best; "
            "try a smaller --learning-rate"
        )
    network.load_state_dict(fit.best)
    checkpoint = {
        "schema": checkpoints.SCHEMA,
        "robot": robot,
        "network": description,
        "features": feature_names(data[0].robot.motion, settings.history),
        "weights": fit.best,
        "provenance": identity
        | _of_code_and_data(data)
        | {"windows": [len(training), len(validation), len(test)]}
        | _of_fit(fit, estimation_errors(network, test)),
    }
    checkpoints.save(checkpoint, out)
    resume.unlink(missing_ok=True)
    _check_target(checkpoint, out, settings)
    return checkpoint


def _description(settings: Settings, training: Windows, modules: int) -> dict[str, Any]:
    """The checkpoint's `network`."""
    description: dict[str, Any] = {
        "name": settings.network,
        "feature_size": training.features.shape[-1],
        "action_size": training.targets.shape[-1],
        "layers": settings.layers,
        "hidden": settings.hidden,
        "dropout": settings.dropout,
        "history": settings.history,
    }
    return description if settings.network == "bilstm" else description | {"modules": modules}


def _of_code_and_data(data: Sequence[DataSet]) -> dict[str, Any]:
    return {
        "code_version": version("modsoft"),
        "torch_version": str(torch.__version__),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "generation": [{key: value for key, value in each.generation.items() if key != "robot"} for each in data],
        "strategy": " + ".join(each.generation["strategy"] for each in data),
        "samples": sum(each.samples for each in data),
    }


def _of_fit(fit: Fit, errors: torch.Tensor) -> dict[str, Any]:
    """errors: of estimation (W, N, A) on the test part, percent of the range; by module, the paper's Table 1."""
    return {
        "iterations_done": fit.iteration,
        "stopped_early": fit.stopped_early(),
        "seconds": round(fit.elapsed_s, 1),
        "validation_percent": float(fit.best_percent),
        "errors_percent": [round(float(e), 4) for e in errors.mean(dim=(0, 2))],
        "errors_std_percent": [round(float(e), 4) for e in errors.std(dim=(0, 2), correction=0)],
    }


def _check_target(checkpoint: dict[str, Any], out: Path, settings: Settings) -> None:
    """`TargetNotReached` where the validation error of a finished model is above the target."""
    provenance, target = checkpoint["provenance"], settings.target_percent
    if target is not None and provenance["validation_percent"] > target:
        raise TargetNotReached(
            f"{out}: validation error {provenance['validation_percent']:.2f} % after {provenance['iterations_done']} "
            f"iterations and {provenance['seconds'] / 60:.1f} minutes, expected at most {target:g} %; the model is "
            "kept, but give more --minutes, --iterations or data before it controls a robot"
        )


def data_sha256(data: Sequence[DataSet]) -> str:
    """Of all data sets in their order; of one, its own."""
    digests = [each.sha256() for each in data]
    return digests[0] if len(digests) == 1 else hashlib.sha256(" ".join(digests).encode()).hexdigest()


def _robot(data: Sequence[DataSet]) -> dict[str, Any]:
    """The robot file of all data sets, as plain values; `ModelError` where they differ."""
    for each in data[1:]:
        if each.robot != data[0].robot:
            raise ModelError(
                f"data sets of different robots, {data[0].robot.name} and {each.robot.name} (or of one with other "
                "limits or another rate); a model is trained on data of one robot"
            )
        if source_of(each) != source_of(data[0]):
            raise ModelError(
                f"data of {source_of(data[0])} and of {source_of(each)}; a model is trained on data of one source"
            )
    return data[0].robot.to_dict()


def source_of(data: DataSet) -> str:
    """Where the numbers come from, in words."""
    sources = {"robot": "a real robot", "import": "a real robot", "rig": "the emulated rig"}
    return sources.get(str(data.generation.get("source")), "a simulated robot")


def _finished(out: Path, resume: Path, identity: dict[str, Any], settings: Settings) -> dict[str, Any]:
    """The existing model `out`; `ModelError` where it is of other data or settings."""
    checkpoint = checkpoints.load(out)
    advice = "give another --out, or delete it"
    _check_same(f"{out}: exists already, with", checkpoint["provenance"], identity, advice)
    with contextlib.suppress(ModelError):  # a file that this training did not write
        if resume.is_file():  # of a run that was killed after it wrote the model
            _read_state(resume, identity)
            resume.unlink()
    _check_target(checkpoint, out, settings)
    return checkpoint


def _resume(fit: Fit, resume: Path, identity: dict[str, Any]) -> None:
    """Continues `fit` from a saved state; `ModelError` for any other file."""
    state = _read_state(resume, identity)
    try:
        fit.resume(state)
    except (KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:200]
        raise ModelError(f"{resume}: not the state of this training ({reason}); delete it to start again") from error


def _read_state(resume: Path, identity: dict[str, Any]) -> dict[str, Any]:
    state = checkpoints.read(resume)
    of_state = state.get("identity")
    advice = "give the same settings to resume, or delete it to start again"
    _check_same(f"{resume}: of a run with", of_state if isinstance(of_state, dict) else {}, identity, advice)
    return state


def _check_same(what: str, of_file: dict[str, Any], identity: dict[str, Any], advice: str) -> None:
    """`ModelError` at the first entry of `identity` that differs in the file."""
    for key, expected in identity.items():
        if of_file.get(key) != expected:
            raise ModelError(f"{what} {key} {of_file.get(key)}, expected {expected}; {advice}")
