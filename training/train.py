"""Training the networks of Table S1: one loop, read from top to bottom, that can be killed at any time.

`OUT.resume` beside the model holds all that the loop needs to go on; a run that was cut anywhere ends with the same
weights, bit for bit, as one that was not (with the same number of threads on the same machine, and no time budget).
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from modsoft.runtime.control.features import feature_names, labels
from modsoft.runtime.errors import ModelError, TargetNotReached, UsageError
from modsoft.runtime.files import check_writable, target_of
from modsoft.runtime.locks import locked
from modsoft.training import checkpoint as checkpoints
from modsoft.training import networks, optimizer
from modsoft.training.data.dataset import DataSet, Windows, split

# What suits a kind of robot: history and batch of Table S1. A hanging robot's last modules hang from a module that
# hardly moves beside them, so that they are as good as a robot of their own; with the cable robot nothing was gained by
# training on them.
BY_KIND: dict[str, dict[str, Any]] = {
    "cable": {"history": 5, "batch": 64, "truncation_probability": 0.0},
    "pneumatic": {"history": 10, "batch": 128, "truncation_probability": 0.4},
}
CUDA_BATCHES = 4  # times these windows in a step on a GPU, which small batches leave idle
ACTUATION_RANGE = 2.0  # errors are told in percent of it
CHECKS = 20  # looks at the validation error in a whole run, each with a checkpoint
VALIDATED = 4096  # windows that a look at the validation error takes at most
ROUND_PERCENT = 0.5  # errors below it are weighted as squares, above as they are
PRECISIONS = ("float32", "bfloat16")
DEVICES = ("cpu", "cuda")
PATIENCE = 8  # checks without a better one that end the run: a one-cycle rate is at its best only in the end


@dataclass(frozen=True)
class Settings:
    """What the weights depend on, together with the data."""

    history: int  # T
    network: str = "bilstm"  # one of choices.NETWORKS
    batch: int = 64
    truncation_probability: float = 0.0  # of a step that takes the robot's last modules for a robot of their own
    iterations: int = 6000
    minutes: float | None = None  # of wall clock; the learning rate ends its cycle with whichever ends first
    target_percent: float | None = None  # validation error, mean of the modules, that ends the run as soon as reached
    learning_rate: float = 3e-3  # peak of the one-cycle learning rate; 0.001 and 0.0003, constant, in Table S1
    dropout: float = 0.0  # between layers; 0.05 makes estimation worse, with 16,000 samples of cable-4 as with 96,000
    layers: int = 4  # Table S1
    hidden: int = 128  # Table S1
    split: str = "blocks"
    seed: int = 0
    threads: int = 1
    precision: str = "float32"  # of the network's products, one of PRECISIONS
    device: str = "cpu"  # one of DEVICES

    def __post_init__(self) -> None:
        if self.network != "bilstm" and self.truncation_probability:
            raise UsageError(
                f"--truncation-probability {self.truncation_probability}: the network {self.network} is bound to its "
                "number of modules"
            )
        if self.precision not in PRECISIONS:
            raise UsageError(f"precision {self.precision!r}, expected one of {', '.join(PRECISIONS)}")
        if self.device not in DEVICES:
            raise UsageError(f"device {self.device!r}, expected one of {', '.join(DEVICES)}")


def settings_for(kind: str, options: dict[str, Any]) -> Settings:
    """The settings of a run: `options` that are not None, else what suits the kind of robot and the device.

    `options` are named as the fields of `Settings`; device "auto" is cuda where there is a GPU. Raises `UsageError` for
    a device or precision that this machine does not have.
    """
    given = {name: value for name, value in options.items() if value is not None}
    if given.get("device", "auto") == "auto":
        given["device"] = "cuda" if torch.cuda.is_available() else "cpu"
    suited = dict(BY_KIND[kind])
    if given.get("network", "bilstm") != "bilstm":
        suited["truncation_probability"] = 0.0
    if given["device"] == "cuda":
        suited["batch"] *= CUDA_BATCHES
    settings = Settings(**{**suited, **given})
    check_machine(settings)
    return settings


def check_machine(settings: Settings) -> None:
    """Raises `UsageError` where the device or its units for the precision do not exist on this machine."""
    if settings.device == "cuda" and not torch.cuda.is_available():
        raise UsageError("device cuda: torch finds no GPU here; give --device cpu, or install torch for CUDA")
    if settings.precision == "bfloat16" and not bfloat16_works(settings.device):
        raise UsageError("precision bfloat16: this machine has no units for it; give --precision float32")


@functools.cache
def bfloat16_works(device: str) -> bool:
    """Whether `device` trains an LSTM with bfloat16 products. Tried out: what the processor reports and what torch's
    libraries are allowed to use are two things."""
    network = torch.nn.LSTM(8, 8, bidirectional=True).to(device)
    try:
        with torch.random.fork_rng(), torch.autocast(device, torch.bfloat16):
            network(torch.zeros(2, 2, 8, device=device))[0].float().sum().backward()
    except RuntimeError:
        return False
    return True


class Progress(NamedTuple):
    """What a run tells after every step of the optimiser."""

    iteration: int
    share: float  # of the run that is over, 0 to 1
    loss: float  # of this step
    validation_percent: float  # of the best weights so far


def one_cycle(share: float, peak: float) -> float:
    """Learning rate at `share` of the run: rises over the first 30 %, then falls to nothing, both as cosines."""
    if share < 0.3:
        return peak * (0.04 + 0.96 * 0.5 * (1 - math.cos(math.pi * share / 0.3)))
    return peak * 0.5 * (1 + math.cos(math.pi * min(1.0, (share - 0.3) / 0.7)))


def fastest_precision() -> str:
    """bfloat16 where the processor has units for its products (AMX): two thirds of the time of a step, or less."""
    units: dict[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()  # newer than the oldest torch that will do
    return "bfloat16" if units.get("amx_bf16") and bfloat16_works("cpu") else "float32"


def charbonnier_loss(estimated: torch.Tensor, true: torch.Tensor) -> torch.Tensor:
    """Mean of |estimated - true|, which is what the paper reports, rounded at zero so that it ends smoothly."""
    return (((estimated - true) ** 2 + (ROUND_PERCENT * ACTUATION_RANGE / 100.0) ** 2).sqrt()).mean()


def estimation_errors(network: torch.nn.Module, windows: Windows) -> torch.Tensor:
    """|estimated - true actuation| (W, N, A) in percent of the actuation range, on the CPU."""
    network.eval()
    device = next(network.parameters()).device
    with torch.no_grad():
        pieces = torch.from_numpy(windows.features).split(1024)
        estimated = torch.cat([network(piece.to(device)).cpu() for piece in pieces])
    return (estimated - torch.from_numpy(windows.targets)).abs() * (100.0 / ACTUATION_RANGE)


def train(
    data: Sequence[DataSet],
    out: Path,
    settings: Settings,
    progress: Callable[[Progress], None] = lambda told: None,
    clock: Callable[[], float] = time.monotonic,
) -> dict[str, Any]:
    """Trains on all windows of the data sets, which are of one robot, writes the checkpoint `out` and gives it. Each
    data set is split on its own. Where `out` is there already of the same data and settings it
    is given as it is, and a run goes on from `out.resume`; either of others is refused. Sets torch's threads and random
    state for the whole process.

    Raises `InUse` while another process trains `out`, and `TargetNotReached` where the run ends above
    `settings.target_percent`; the model is written all the same.
    """
    check_machine(settings)
    check_writable(out)
    out = target_of(out)  # what a run goes on from waits beside a link's target
    with locked(out.with_name(f"{out.name}.lock"), out, "modsoft-train"):
        return _train(data, out, settings, progress, clock)


def _train(
    data: Sequence[DataSet],
    out: Path,
    settings: Settings,
    progress: Callable[[Progress], None],
    clock: Callable[[], float],
) -> dict[str, Any]:
    torch.set_num_threads(settings.threads)
    torch.manual_seed(settings.seed)
    robot = _robot(data)
    splits = [split(each, settings.history, settings.split, settings.seed) for each in data]
    training, validation, test = (Windows.joined(parts) for parts in zip(*splits, strict=True))
    features, actions = training.features.shape[-1], training.targets.shape[-1]
    described: dict[str, Any] = {
        "name": settings.network,
        "feature_size": features,
        "action_size": actions,
        "layers": settings.layers,
        "hidden": settings.hidden,
        "dropout": settings.dropout,
        "history": settings.history,
    }
    if settings.network != "bilstm":
        described["modules"] = robot["robot"]["modules"]
    network = networks.build(described)
    identity = {"data_sha256": data_sha256(data), "optimizer": optimizer.DESCRIPTION, **asdict(settings)}
    resume = out.with_name(f"{out.name}.resume")
    if out.exists():
        made = _finished(out, identity)
        with contextlib.suppress(ModelError):  # a file that this training did not write
            if resume.is_file():  # killed between the last two lines below
                _resumed(resume, identity)
                resume.unlink()
        _check_target(made, out, settings)
        return made
    state = _fit(network, training, validation, settings, identity, resume, progress, clock)
    if state["best"] is None or state["best_percent"] > 100.0:  # worse than any guess within the range can be
        resume.unlink(missing_ok=True)  # there is nothing in it to go on from
        raise ModelError(
            f"{out}: training diverged, validation error {state['best_percent']:.3g} % of the actuation range at best; "
            "try a smaller --learning-rate"
        )

    network.load_state_dict(state["best"])
    errors = estimation_errors(network, test)
    checkpoint = {
        "schema": checkpoints.SCHEMA,
        "robot": robot,
        "network": described,
        "features": feature_names(data[0].robot.kind, settings.history),
        "weights": state["best"],
        "provenance": {
            **identity,
            "code_version": version("modsoft"),
            "torch_version": str(torch.__version__),
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
            "recipes": [{key: value for key, value in each.recipe.items() if key != "robot"} for each in data],
            "strategy": " + ".join(each.recipe["strategy"] for each in data),
            "samples": sum(each.samples for each in data),
            "windows": [len(training), len(validation), len(test)],
            "iterations_done": state["iteration"],
            "stopped_early": state["worse"] >= PATIENCE,
            "seconds": round(state["elapsed_s"], 1),
            "validation_percent": float(state["best_percent"]),
            # Actuation estimation error of the test part, percent of the range, by module: the paper's Table 1.
            "errors_percent": [round(float(e), 4) for e in errors.mean(dim=(0, 2))],
            "errors_std_percent": [round(float(e), 4) for e in errors.std(dim=(0, 2), correction=0)],
        },
    }
    checkpoints.save(checkpoint, out)
    resume.unlink(missing_ok=True)
    _check_target(checkpoint, out, settings)
    return checkpoint


def _check_target(checkpoint: dict[str, Any], out: Path, settings: Settings) -> None:
    """`TargetNotReached` where a finished model errs by more than was asked for."""
    made, target = checkpoint["provenance"], settings.target_percent
    if target is not None and made["validation_percent"] > target:
        raise TargetNotReached(
            f"{out}: validation error {made['validation_percent']:.2f} % after {made['iterations_done']} iterations "
            f"and {made['seconds'] / 60:.1f} minutes, expected at most {target:g} %; the model is kept, but give more "
            "--minutes, --iterations or data before it controls a robot"
        )


def data_sha256(data: Sequence[DataSet]) -> str:
    """Of all data sets in their order; of one, its own."""
    digests = [each.sha256() for each in data]
    return digests[0] if len(digests) == 1 else hashlib.sha256(" ".join(digests).encode()).hexdigest()


def _robot(data: Sequence[DataSet]) -> dict[str, Any]:
    """The robot that all data sets are of; `ModelError` where they are not of one."""
    robot = data[0].recipe["robot"]
    for each in data[1:]:
        if each.recipe["robot"] != robot:
            raise ModelError(
                f"data sets of different robots, {data[0].robot.name} and {each.robot.name} (or of one with other "
                "limits or another rate); a model is trained on data of one robot"
            )
    return robot


def _fit(
    network: torch.nn.Module,
    training: Windows,
    validation: Windows,
    settings: Settings,
    identity: dict[str, Any],
    resume: Path,
    progress: Callable[[Progress], None],
    clock: Callable[[], float],
) -> dict[str, Any]:
    """The loop. Leaves the state of its end in the file `resume` and gives it: `best` weights, `best_percent`,
    `iteration`, `elapsed_s` and what it takes to go on."""
    device = settings.device
    dropout_random = torch.cuda if device == "cuda" else torch
    features, targets = (torch.from_numpy(each).to(device) for each in (training.features, training.targets))
    looked_at = validation.evenly(VALIDATED)
    network.to(device)
    optimiser = optimizer.MuonAndAdam(network)
    state: dict[str, Any] = {"identity": identity, "iteration": 0, "elapsed_s": 0.0}
    state |= {"best": None, "best_percent": math.inf, "worse": 0}
    if resume.is_file():
        state |= _resumed(resume, identity)
        try:
            network.load_state_dict(state["weights"])
            optimiser.load_state_dict(state["optimiser"])
            dropout_random.set_rng_state(state["random_state"])
        except (KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
            why = " ".join(str(error).split())[:200]
            raise ModelError(f"{resume}: not the state of this training ({why}); delete it to start again") from error

    per_epoch = -(-len(training) // settings.batch)
    iteration = first = state["iteration"]
    began_s = clock() - state["elapsed_s"]
    order = np.zeros(0, dtype=np.int64)
    share = _share(iteration, clock() - began_s, settings)
    while share < 1.0 and state["worse"] < PATIENCE and not _reached(state["best_percent"], settings):
        epoch, step = divmod(iteration, per_epoch)
        if step == 0 or iteration == first:
            order = np.random.default_rng([settings.seed, epoch]).permutation(len(training))
        rows = torch.from_numpy(order[step * settings.batch : (step + 1) * settings.batch]).to(device)
        modules = _modules_of_step(targets.shape[1], settings, iteration)
        network.train()
        with torch.autocast(device, torch.bfloat16, enabled=settings.precision == "bfloat16"):
            estimated = network(last_modules(features[rows], modules))
        loss = charbonnier_loss(estimated.float(), targets[rows, -modules:])
        loss.backward()
        # The first steps at a high rate now and then meet a gradient a hundred times the usual one.
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step(one_cycle(share, settings.learning_rate))

        iteration += 1
        before, share = share, _share(iteration, clock() - began_s, settings)
        progress(Progress(iteration, share, loss.item(), state["best_percent"]))
        if _checks_due(share) > _checks_due(before):
            percent = float(estimation_errors(network, looked_at).mean())
            if percent < state["best_percent"]:
                weights = {name: value.detach().to("cpu", copy=True) for name, value in network.state_dict().items()}
                state.update(best=weights, best_percent=percent, worse=0)
            else:
                state["worse"] += 1
            state.update(
                iteration=iteration,
                elapsed_s=clock() - began_s,
                weights=network.state_dict(),
                optimiser=optimiser.state_dict(),
                random_state=dropout_random.get_rng_state(),
            )
            checkpoints.save(state, resume)
    return state


def last_modules(features: torch.Tensor, modules: int) -> torch.Tensor:
    """The last `modules` of a robot's features (W, N, F), labelled as a robot of that many (eq. 1)."""
    last = features[:, -modules:].clone()
    last[..., -1] = torch.from_numpy(labels(modules)).to(last)
    return last


def _reached(percent: float, settings: Settings) -> bool:
    """Whether a validation error, percent, ends the run."""
    return settings.target_percent is not None and percent <= settings.target_percent


def _modules_of_step(modules: int, settings: Settings, iteration: int) -> int:
    """Modules that the robot of this step has: all, or, with `truncation_probability`, from 2 to all but one."""
    rng = np.random.default_rng([settings.seed, 1, iteration])
    return int(rng.integers(2, modules)) if modules > 2 and rng.uniform() < settings.truncation_probability else modules


def _share(iteration: int, elapsed_s: float, settings: Settings) -> float:
    """How much of the run is over, 0 to 1: by iterations, or by time where a budget is set and ends first."""
    share = iteration / settings.iterations
    return share if settings.minutes is None else max(share, elapsed_s / (60.0 * settings.minutes))


def _checks_due(share: float) -> int:
    """How many looks at the validation error belong to a run that is over by `share`."""
    return math.floor(min(share, 1.0) * CHECKS + 1e-9)


def _finished(out: Path, identity: dict[str, Any]) -> dict[str, Any]:
    """The finished model that is there already; `ModelError` where it is of other data or settings."""
    made = checkpoints.load(out)
    _check_same(f"{out}: there already, made", made["provenance"], identity, "give another --out, or delete it")
    return made


def _resumed(resume: Path, identity: dict[str, Any]) -> dict[str, Any]:
    state = checkpoints.read(resume)
    advice = "ask for the same to go on, or delete it to start anew"
    found = state.get("identity")
    _check_same(f"{resume}: of a run", found if isinstance(found, dict) else {}, identity, advice)
    numbers = (state.get(name, 0) for name in ("iteration", "elapsed_s", "best_percent", "worse"))
    if not all(isinstance(number, int | float) and number >= 0 for number in numbers):
        raise ModelError(f"{resume}: not the state of this training (its counts); delete it to start again")
    return state


def _check_same(what: str, found: dict[str, Any], identity: dict[str, Any], advice: str) -> None:
    """`ModelError` at the first entry of `identity` that `found` has otherwise."""
    for key, asked in identity.items():
        if found.get(key) != asked:
            raise ModelError(f"{what} with {key} {found.get(key)}, asked for {asked}; {advice}")
