"""The training loop: it fits a network to windows, and can be stopped and resumed at any check."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch

from modsoft.runtime.control.features import labels
from modsoft.training import optimizer
from modsoft.training.data.dataset import Windows
from modsoft.training.settings import Settings

ACTUATION_RANGE = 2.0  # errors are in percent of it
CHECKS = 20  # of the validation error in a whole run; the state is saved at each
VALIDATED = 4096  # windows in a check, at most
EPSILON_PERCENT = 0.5  # of the Charbonnier loss: smaller errors are weighted as squares, larger ones linearly
PATIENCE = 8  # checks without improvement that end the run; a one-cycle learning rate is at its best only at the end


class Progress(NamedTuple):
    """The state of a run after a step of the optimizer."""

    iteration: int
    progress: float  # 0 at the start of the run, 1 at its end
    loss: float  # of this step
    validation_percent: float  # of the best weights so far


def one_cycle(progress: float, peak: float) -> float:
    """Learning rate at `progress` (0 to 1): rises over the first 30 % of the run, then falls to 0, both as cosines."""
    if progress < 0.3:
        return peak * (0.04 + 0.96 * 0.5 * (1 - math.cos(math.pi * progress / 0.3)))
    return peak * 0.5 * (1 + math.cos(math.pi * min(1.0, (progress - 0.3) / 0.7)))


def charbonnier_loss(estimated: torch.Tensor, true: torch.Tensor) -> torch.Tensor:
    """Mean of |estimated - true|, the error that the paper reports, made smooth at zero by epsilon."""
    return (((estimated - true) ** 2 + (EPSILON_PERCENT * ACTUATION_RANGE / 100.0) ** 2).sqrt()).mean()


def estimation_errors(network: torch.nn.Module, windows: Windows) -> torch.Tensor:
    """|estimated - true actuation| (W, N, A) in percent of the actuation range, on the CPU."""
    network.eval()
    device = next(network.parameters()).device
    with torch.no_grad():
        pieces = torch.from_numpy(windows.features).split(1024)
        estimated = torch.cat([network(piece.to(device)).cpu() for piece in pieces])
    return (estimated - torch.from_numpy(windows.targets)).abs() * (100.0 / ACTUATION_RANGE)


def last_modules(features: torch.Tensor, modules: int) -> torch.Tensor:
    """The last `modules` of a robot's features (W, N, F), labelled as a robot of that many (eq. 1)."""
    last = features[:, -modules:].clone()
    last[..., -1] = torch.from_numpy(labels(modules)).to(last)
    return last


class Fit:
    """The training of one network on `training`, checked on `validation`.

    After `run`: `best` holds the weights with the smallest validation error, `best_percent` that error (infinite, and
    `best` None, before the first check and where no error is a number), `iteration` and `elapsed_s` the length of the
    run, with the part before an interruption.
    """

    def __init__(self, network: torch.nn.Module, training: Windows, validation: Windows, settings: Settings) -> None:
        self._network, self._settings = network.to(settings.device), settings
        self._features, self._targets = (
            torch.from_numpy(each).to(settings.device) for each in (training.features, training.targets)
        )
        self._validation = validation.evenly(VALIDATED)
        self._optimizer = optimizer.MuonAndAdam(network)
        self._dropout_random = torch.cuda if settings.device == "cuda" else torch
        self._order = np.zeros(0, dtype=np.int64)
        self._epoch = -1
        self.iteration, self.elapsed_s = 0, 0.0
        self.best: dict[str, torch.Tensor] | None = None
        self.best_percent = math.inf
        self.checks_without_improvement = 0

    def state(self) -> dict[str, Any]:
        """All that it takes to resume, as tensors and plain values."""
        return {
            "iteration": self.iteration,
            "elapsed_s": self.elapsed_s,
            "best": self.best,
            "best_percent": self.best_percent,
            "checks_without_improvement": self.checks_without_improvement,
            "weights": self._network.state_dict(),
            "optimizer": self._optimizer.state_dict(),
            "random_state": self._dropout_random.get_rng_state(),
        }

    def resume(self, state: dict[str, Any]) -> None:
        """Continues from a `state`; an error of Python's or torch's for anything else."""
        self._network.load_state_dict(state["weights"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._dropout_random.set_rng_state(state["random_state"])
        for name in ("iteration", "elapsed_s", "best_percent", "checks_without_improvement"):
            if not (isinstance(state[name], int | float) and state[name] >= 0):
                raise ValueError(f"{name} {state[name]}")
            setattr(self, name, state[name])
        self.best = state["best"]

    def run(
        self, save: Callable[[dict[str, Any]], None], report: Callable[[Progress], None], clock: Callable[[], float]
    ) -> None:
        """Trains to the end of the settings. save: called with the state after each check."""
        start_s = clock() - self.elapsed_s
        progress = self._progress(clock() - start_s)
        while progress < 1.0 and not self._is_finished():
            loss = self._step(progress)
            before, progress = progress, self._progress(clock() - start_s)
            report(Progress(self.iteration, progress, loss, self.best_percent))
            if _checks_due(progress) > _checks_due(before):
                self._check()
                self.elapsed_s = clock() - start_s
                save(self.state())

    def stopped_early(self) -> bool:
        """Whether the validation error had not improved for `PATIENCE` checks."""
        return self.checks_without_improvement >= PATIENCE

    def _is_finished(self) -> bool:
        target = self._settings.target_percent
        return self.stopped_early() or (target is not None and self.best_percent <= target)

    def _step(self, progress: float) -> float:
        """One step of the optimizer; its loss."""
        settings = self._settings
        rows = self._next_rows()
        modules = self._modules_of_step()
        self._network.train()
        with torch.autocast(settings.device, torch.bfloat16, enabled=settings.precision == "bfloat16"):
            estimated = self._network(last_modules(self._features[rows], modules))
        loss = charbonnier_loss(estimated.float(), self._targets[rows, -modules:])
        loss.backward()
        # The first steps at a high rate sometimes have a gradient a hundred times the usual one.
        torch.nn.utils.clip_grad_norm_(self._network.parameters(), 1.0)
        self._optimizer.step(one_cycle(progress, settings.learning_rate))
        self.iteration += 1
        return loss.item()

    def _next_rows(self) -> torch.Tensor:
        """Indices of the windows of the next step. Every window is used once in an epoch."""
        batch, windows = self._settings.batch, len(self._targets)
        epoch, step = divmod(self.iteration, -(-windows // batch))
        if epoch != self._epoch:
            self._epoch = epoch
            self._order = np.random.default_rng([self._settings.seed, epoch]).permutation(windows)
        return torch.from_numpy(self._order[step * batch : (step + 1) * batch]).to(self._settings.device)

    def _modules_of_step(self) -> int:
        """Modules of the robot in this step: all, or, with `truncation_probability`, from 2 to all but one."""
        settings, modules = self._settings, self._targets.shape[1]
        rng = np.random.default_rng([settings.seed, 1, self.iteration])
        is_truncated = modules > 2 and rng.uniform() < settings.truncation_probability
        return int(rng.integers(2, modules)) if is_truncated else modules

    def _check(self) -> None:
        percent = float(estimation_errors(self._network, self._validation).mean())
        if percent < self.best_percent:
            weights = self._network.state_dict()
            self.best = {name: value.detach().to("cpu", copy=True) for name, value in weights.items()}
            self.best_percent, self.checks_without_improvement = percent, 0
        else:
            self.checks_without_improvement += 1

    def _progress(self, elapsed_s: float) -> float:
        """0 to 1, by iterations, or by time where `minutes` is set and ends first."""
        settings = self._settings
        progress = self.iteration / settings.iterations
        return progress if settings.minutes is None else max(progress, elapsed_s / (60.0 * settings.minutes))


def _checks_due(progress: float) -> int:
    """Checks of the validation error up to `progress`."""
    return math.floor(min(progress, 1.0) * CHECKS + 1e-9)
