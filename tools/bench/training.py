"""How fast modsoft-train reaches the paper's Table 1, against the same training done the way of the paper's authors.

`python tools/bench/training.py`. Two processes take turns of a few seconds on one core, so that whatever else the
machine does hits both alike. Same samples, same split (the paper's, shuffled), same network, one torch thread each:

    ours     modsoft.training.train.train with its own defaults; its learning rate ends with --iterations of --batch
    authors  a Python data set of windows read through a DataLoader with one worker; Table S1: batch 64, Adam at a
             constant rate of 0.001; dropout 0.1; the validation error every 500 iterations

Either is there when its validation error, mean over the modules, is at most Table 1's. Times are processor time of the
training process, validation included: what it takes by the clock where nothing else runs. The authors' worker works
beside it on the other core and is not counted.
"""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch is loaded: see modsoft-train

import click
import numpy as np
import torch

from modsoft.runtime import robot as robots
from modsoft.runtime.command import entry
from modsoft.training import collect, dataset, train
from modsoft.training.dataset import DataSet, Windows
from modsoft.training.networks import BiLSTM

TABLE_1_PERCENT = (1.63, 1.49, 1.11, 0.70)  # biLSTM, modules 1 to 4
SAMPLES, STEPS = 16_000, 1000  # the paper's; control steps in an episode
TURN_S = 5.0
WAYS = ("ours", "authors")


@dataclasses.dataclass(frozen=True)
class Race:
    """What both ways train, and when they have arrived."""

    data: str  # file
    samples: int
    layers: int
    hidden: int
    iterations: int  # of ours
    batch: int  # of ours
    target_percent: float  # validation error, mean over the modules
    seed: int
    authors_check: int = 500  # iterations between their looks at the validation error


def first_samples(data: DataSet, samples: int) -> DataSet:
    """The first episodes of a data set that make up so many samples."""
    episodes = -(-samples // data.action.shape[1])
    return dataclasses.replace(data, configuration=data.configuration[:episodes], action=data.action[:episodes])


class Turns:
    """The runner's end of its pipes: it tells how far it is, and waits at the end of its turn for the next."""

    def __init__(self, batch: int):
        self.batch = batch
        self.end_s = 0.0  # the first turn is yet to come

    def tell(self, iteration: int, validation_percent: float) -> None:
        """After every step of the optimiser; `validation_percent` is the best so far."""
        waits = time.monotonic() >= self.end_s
        if waits or iteration % 20 == 0:
            state = {"iteration": iteration, "percent": validation_percent, "batch": self.batch, "waits": waits}
            print(json.dumps(state | {"cpu_s": time.process_time()}), flush=True)
        if waits:
            granted = sys.stdin.readline()
            if not granted:  # the race is over
                raise SystemExit
            self.end_s = time.monotonic() + float(granted)


def ours(race: Race, data: DataSet) -> None:
    """modsoft-train without its command line."""
    settings = train.Settings(
        **train.BY_KIND[data.robot.robot.kind] | {"split": "shuffled", "batch": race.batch},
        iterations=race.iterations,
        layers=race.layers,
        hidden=race.hidden,
        seed=race.seed,
    )

    turns = Turns(settings.batch)
    with tempfile.TemporaryDirectory() as folder:
        made = train.train(
            [data],
            Path(folder) / "model.pt",
            settings,
            lambda told: turns.tell(told.iteration, told.validation_percent),
        )
    turns.end_s = 0.0  # the last look at the validation error came after the last step was told
    turns.tell(made["provenance"]["iterations_done"], made["provenance"]["validation_percent"])


class WindowSet(Windows, torch.utils.data.Dataset):
    """Windows one by one, as a DataLoader asks for them."""

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        return self.features[index], self.targets[index]


def authors(race: Race, data: DataSet) -> None:
    """The training of the paper, until someone ends it."""
    torch.set_num_threads(1)
    torch.manual_seed(race.seed)
    history = train.BY_KIND[data.robot.robot.kind]["history"]
    training, validation, _ = dataset.split(data, history, "shuffled", race.seed)
    network = BiLSTM(training.features.shape[-1], training.targets.shape[-1], race.layers, race.hidden, dropout=0.1)
    optimiser = torch.optim.Adam(network.parameters(), lr=0.001)
    windows = WindowSet(training.features, training.targets)
    loader = torch.utils.data.DataLoader(windows, batch_size=64, shuffle=True, num_workers=1)
    turns, percent = Turns(64), float("inf")
    epochs = itertools.repeat(loader)
    for iteration, (features, targets) in enumerate(itertools.chain.from_iterable(epochs), start=1):
        network.train()
        loss = torch.nn.functional.mse_loss(network(features), targets)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        if iteration % race.authors_check == 0:
            percent = min(percent, float(train.estimation_errors(network, validation).mean()))
        turns.tell(iteration, percent)


RUNS: dict[str, Callable[[Race, DataSet], None]] = {"ours": ours, "authors": authors}


class Runner:
    """One way in a process of its own, which works in its turns only."""

    def __init__(self, way: str, race: Race):
        self.target_percent = race.target_percent
        self.told: list[dict[str, Any]] = []
        self.process = subprocess.Popen(
            [sys.executable, __file__, "--run", way, json.dumps(dataclasses.asdict(race))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._listen()  # until the first step is done: imports and data are behind it
        if not self.told:
            raise click.ClickException(f"{way}: ended before its first step; what it said stands above")

    def turn(self, seconds: float) -> None:
        """Lets it run so long."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{seconds}\n")
        self.process.stdin.flush()
        self._listen()

    def _listen(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.told.append(json.loads(line))
            if self.told[-1]["waits"]:
                return
        self.process.wait()

    def end(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()  # what it waits for; were this process killed, it would be closed too
        self.process.wait()

    @property
    def over(self) -> bool:
        return arrived(self.told, self.target_percent) is not None or self.process.poll() is not None


def arrived(told: list[dict[str, Any]], target_percent: float) -> dict[str, Any] | None:
    """The first that was told with the error reached."""
    return next((line for line in told if line["percent"] <= target_percent), None)


def figures(told: list[dict[str, Any]], target_percent: float) -> dict[str, Any]:
    """What is known of one way; the time to the error is None where it did not get there."""
    first, there = told[0], arrived(told, target_percent)
    last = there or told[-1]
    seconds = last["cpu_s"] - first["cpu_s"]
    iterations_per_s = (last["iteration"] - first["iteration"]) / seconds
    best = min(line["percent"] for line in told)
    return {
        "batch": last["batch"],
        "iterations": last["iteration"],
        "iterations_per_s": iterations_per_s,
        "samples_per_s": iterations_per_s * last["batch"],
        "seconds": seconds,
        "seconds_to_target": seconds if there else None,
        "best_percent": best if np.isfinite(best) else None,
    }


def compared(race: Race, one: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """Figures of ours and of the authors' way, and our advantage: more than 1 is better."""
    ratios = {name: one[name] / other[name] for name in ("iterations_per_s", "samples_per_s")}
    reached = one["seconds_to_target"]
    # Where the authors' way is not there yet, its time so far is a lower bound.
    ratios["time_to_target"] = other["seconds"] / reached if reached else None
    return {
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "torch": str(torch.__version__),
        "race": {name: value for name, value in dataclasses.asdict(race).items() if name != "data"},
        "ours": one,
        "authors": other,
        "ratios": ratios,
        "ratio_is_lower_bound": other["seconds_to_target"] is None,
    }


def same_error(one: list[dict[str, Any]], other: list[dict[str, Any]]) -> dict[str, float] | None:
    """The smallest error that both ways reached, the processor time of each to it, and how many times as fast ours was;
    None where one of them has not looked at its error yet."""
    percent = max(min(line["percent"] for line in told) for told in (one, other))
    if not np.isfinite(percent):
        return None
    reached = [next(line for line in told if line["percent"] <= percent) for told in (one, other)]
    ours_s, authors_s = (line["cpu_s"] - told[0]["cpu_s"] for line, told in zip(reached, (one, other), strict=True))
    return {"percent": percent, "ours_s": ours_s, "authors_s": authors_s, "ratio": authors_s / ours_s}


def raced(race: Race, minutes: float, turn_s: float) -> dict[str, Any]:
    """Both in turns until both are there, or for so many minutes by the clock."""
    with contextlib.ExitStack() as stack:
        runners = {}
        for way in WAYS:
            runners[way] = Runner(way, race)
            stack.callback(runners[way].end)
        end_s = time.monotonic() + 60.0 * minutes
        while time.monotonic() < end_s and not all(runner.over for runner in runners.values()):
            for way, runner in runners.items():
                if not runner.over:
                    runner.turn(turn_s)
                    told = runner.told[-1]
                    click.echo(f"{way}: iteration {told['iteration']}, best {told['percent']:.2f} %", err=True)
        silent = [way for way, runner in runners.items() if len(runner.told) < 2]
        if silent:
            raise click.ClickException(f"{', '.join(silent)}: no turn within {minutes:g} minutes; give more --minutes")
        told = [runners[way].told for way in WAYS]
        result = compared(race, *(figures(each, race.target_percent) for each in told))
        return result | {"same_error": same_error(*told)}


def table(result: dict[str, Any]) -> str:
    race = result["race"]
    lines = [f"{result['processor']}, {result['cores']} cores, torch {result['torch']}, {race['samples']} samples", ""]
    lines += [f"| way | batch | iterations/s | samples/s | iterations | best % | s to {race['target_percent']:.2f} % |"]
    lines += ["| --- | ---: | ---: | ---: | ---: | ---: | ---: |"]
    for way in WAYS:
        row = result[way]
        reached = row["seconds_to_target"]
        best = "none yet" if row["best_percent"] is None else f"{row['best_percent']:.2f}"
        lines.append(
            f"| {way} | {row['batch']} | {row['iterations_per_s']:.1f} | {row['samples_per_s']:.0f} "
            f"| {row['iterations']} | {best} | {f'{reached:.0f}' if reached else 'not reached'} |"
        )
    ratios = result["ratios"]
    lines += ["", f"ours over the authors': {ratios['samples_per_s']:.2f} times the samples/s"]
    if ratios["time_to_target"]:
        least = "at least " if result["ratio_is_lower_bound"] else ""
        lines += [f"to the same error: {least}{ratios['time_to_target']:.2f} times as fast"]
    same = result.get("same_error")
    if same:
        lines += [f"to {same['percent']:.2f} %, the smallest error that both reached: {same['ours_s']:.0f} s and "
                  f"{same['authors_s']:.0f} s, {same['ratio']:.2f} times as fast"]  # fmt: skip
    return "\n".join(lines)


@click.command(help=__doc__)
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write all figures here, one JSON object.")
@click.option("--quick", is_flag=True, help="A small network to a coarse error: less than a minute.")
@click.option("--data", type=click.Path(path_type=Path), help="Data set to train on; collected where none is given.")
@click.option("--iterations", default=1600, show_default=True, help="Of ours: few that still reach the error.")
@click.option("--batch", default=128, show_default=True, help="Windows in a step of ours.")
@click.option("--minutes", default=90.0, show_default=True, help="By the clock, for both together.")
@click.option("--seed", default=0, show_default=True)
@click.option("--run", nargs=2, hidden=True)
def main(json_file: Path | None, quick: bool, data: Path | None, minutes: float, run: Any, **asked: int) -> None:
    if run:
        race = Race(**json.loads(run[1]))
        RUNS[run[0]](race, first_samples(dataset.read(Path(race.data)), race.samples))
        return
    with tempfile.TemporaryDirectory() as folder:
        samples, turn_s = (3200, 1.0) if quick else (SAMPLES, TURN_S)
        if data is None:
            data = Path(folder) / "d.h5"
            collect.collect(robots.load("cable-4"), data, samples, steps=STEPS if not quick else 200)
        race = Race(str(data), samples, layers=4, hidden=128, target_percent=float(np.mean(TABLE_1_PERCENT)), **asked)
        if quick:
            race = dataclasses.replace(race, layers=2, hidden=32, iterations=300, target_percent=8.0)
            minutes = min(minutes, 0.7)
        result = raced(race, minutes, turn_s)
    click.echo(table(result))
    if json_file:
        json_file.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    entry(main)()
