"""The training methods that tools/bench/training.py compares, and the time of a training step, each in its own process.

`python tools/bench/training_methods.py METHOD COMPARISON` trains in turns and reports its progress on standard output:
one line of JSON for each state. A line on standard input is the duration of the next turn in seconds.
`training_methods.py steps ROUNDS` measures training steps.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch is loaded: see modsoft-train

import numpy as np
import torch

from modsoft.runtime import robot as robot_file
from modsoft.training import networks, optimizer, train
from modsoft.training.data import dataset
from modsoft.training.data.dataset import DataSet, Windows
from modsoft.training.fit import estimation_errors
from modsoft.training.networks import BiLSTM
from modsoft.training.settings import BY_DRIVE, Settings

ADAM_ITERATIONS = 4  # times ours: with as many as ours the learning rate reaches zero far above the target
# Windows, robot, and the largest fraction of the optimizer in a training step that is acceptable with AVX2.
STEPS = ((128, "pneumatic-3", 0.5), (256, "cable-4", 0.25))


@dataclasses.dataclass(frozen=True)
class Comparison:
    """What all methods train, and their target."""

    data: str  # file
    samples: int
    layers: int
    hidden: int
    iterations: int  # of ours
    batch: int  # of ours
    target_percent: float  # validation error, mean over the modules
    seed: int
    authors_check: int = 500  # iterations between two validations of the authors' training
    give_up: float = 5.0  # times our time, after which a method is stopped


def first_samples(data: DataSet, samples: int) -> DataSet:
    """The first episodes of a data set that have at least so many samples."""
    episodes = -(-samples // data.action.shape[1])
    return dataclasses.replace(data, configuration=data.configuration[:episodes], action=data.action[:episodes])


class Turns:
    """Trains in turns: reports the progress on standard output, and waits for the next turn on standard input."""

    def __init__(self, batch: int):
        self.batch = batch
        self.end_s = 0.0  # no turn yet

    def report(self, iteration: int, validation_percent: float) -> None:
        """Called after every iteration; `validation_percent` is the smallest so far."""
        waits = time.monotonic() >= self.end_s
        if waits or iteration % 20 == 0:
            state = {"iteration": iteration, "percent": validation_percent, "batch": self.batch, "waits": waits}
            print(json.dumps(state | {"cpu_s": time.process_time()}), flush=True)
        if waits:
            turn_s = sys.stdin.readline()
            if not turn_s:  # closed: the comparison has ended
                raise SystemExit
            self.end_s = time.monotonic() + float(turn_s)


class Adam(torch.optim.Adam):
    """Adam for all parameters, with the interface of `optimizer.MuonAndAdam`."""

    def __init__(self, network: torch.nn.Module):
        super().__init__(network.parameters())

    def step(self, learning_rate: float) -> None:  # type: ignore[override]
        self.param_groups[0]["lr"] = learning_rate
        super().step()
        self.zero_grad()


def ours(comparison: Comparison, data: DataSet) -> None:
    """modsoft-train without its command line."""
    settings = Settings(
        **BY_DRIVE[data.robot.actuators.drive] | {"split": "shuffled", "batch": comparison.batch},
        iterations=comparison.iterations,
        layers=comparison.layers,
        hidden=comparison.hidden,
        seed=comparison.seed,
    )
    turns = Turns(settings.batch)
    with tempfile.TemporaryDirectory() as folder:
        checkpoint = train.train(
            [data],
            Path(folder) / "model.pt",
            settings,
            lambda progress: turns.report(progress.iteration, progress.validation_percent),
        )
    turns.end_s = 0.0  # the next report is not left out: the last validation comes after the last iteration
    turns.report(checkpoint["provenance"]["iterations_done"], checkpoint["provenance"]["validation_percent"])


def adam(comparison: Comparison, data: DataSet) -> None:
    """`ours` with Adam for all parameters."""
    optimizer.MuonAndAdam = Adam  # type: ignore[misc,assignment]
    ours(dataclasses.replace(comparison, iterations=ADAM_ITERATIONS * comparison.iterations), data)


class WindowSet(Windows, torch.utils.data.Dataset):
    """Windows one by one, as a DataLoader reads them."""

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        return self.features[index], self.targets[index]


def authors(comparison: Comparison, data: DataSet) -> None:
    """The training of the paper's authors, until the comparison ends."""
    torch.set_num_threads(1)
    torch.manual_seed(comparison.seed)
    history = BY_DRIVE[data.robot.actuators.drive]["history"]
    training, validation, _ = dataset.split(data, history, "shuffled", comparison.seed)
    network = BiLSTM(
        training.features.shape[-1], training.targets.shape[-1], comparison.layers, comparison.hidden, dropout=0.1
    )
    adam_optimizer = torch.optim.Adam(network.parameters(), lr=0.001)
    windows = WindowSet(training.features, training.targets)
    loader = torch.utils.data.DataLoader(windows, batch_size=64, shuffle=True, num_workers=1)
    turns, percent = Turns(64), float("inf")
    epochs = itertools.repeat(loader)
    for iteration, (features, targets) in enumerate(itertools.chain.from_iterable(epochs), start=1):
        network.train()
        loss = torch.nn.functional.mse_loss(network(features), targets)
        adam_optimizer.zero_grad()
        loss.backward()
        adam_optimizer.step()
        if iteration % comparison.authors_check == 0:
            percent = min(percent, float(estimation_errors(network, validation).mean()))
        turns.report(iteration, percent)


METHODS: dict[str, Callable[[Comparison, DataSet], None]] = {"ours": ours, "adam": adam, "authors": authors}


def step_times(rounds: int) -> list[dict[str, Any]]:
    """Milliseconds of processor time of the training steps of `STEPS`, gradient and optimizer, medians of `rounds`."""
    torch.set_num_threads(1)
    rows = []
    for batch, name, target_fraction in STEPS:
        robot = robot_file.load(name)
        history = BY_DRIVE[robot.actuators.drive]["history"]
        sizes = {"feature_size": history * (robot.state_size + robot.action_size) + 1, "action_size": robot.action_size}
        network = networks.build({"name": "bilstm", "layers": 4, "hidden": 128, **sizes})
        muon_and_adam = optimizer.MuonAndAdam(network)
        features = torch.randn(batch, robot.modules, sizes["feature_size"])
        times_s = []
        for _ in range(rounds + 1):  # the first one allocates memory and does not count
            start_s = time.process_time()
            network(features).abs().mean().backward()
            middle_s = time.process_time()
            muon_and_adam.step(1e-3)
            times_s.append((middle_s - start_s, time.process_time() - middle_s))
        gradient_ms, optimizer_ms = (1e3 * float(each) for each in np.median(times_s[1:], axis=0))
        rows.append(
            {
                "batch": batch,
                "modules": robot.modules,
                "gradient_ms": gradient_ms,
                "optimizer_ms": optimizer_ms,
                "optimizer_fraction": optimizer_ms / (gradient_ms + optimizer_ms),
                "target_fraction": target_fraction,
            }
        )
    return rows


if __name__ == "__main__":
    method, argument = sys.argv[1:]
    if method == "steps":
        print(json.dumps(step_times(int(argument))))
    else:
        comparison = Comparison(**json.loads(argument))
        METHODS[method](comparison, first_samples(dataset.read(Path(comparison.data)), comparison.samples))
