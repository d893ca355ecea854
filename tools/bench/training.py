"""How fast modsoft-train reaches the paper's Table 1: against the same training with Adam, and against the training of
the paper's authors.

`python tools/bench/training.py --isa native|avx2`. Three processes take turns of a few seconds on one core, so that
other load of the machine meets them alike. Same samples, same split (the paper's, shuffled), same network, one torch
thread each:

    ours     modsoft.training.train.train with its own defaults; its learning rate ends with --iterations of --batch
    adam     the same with Adam for all parameters in place of Muon, and four times the iterations, which it needs
    authors  a Python data set of windows read through a DataLoader with one worker; Table S1: batch 64, Adam at a
             constant rate of 0.001; dropout 0.1; the validation error every 500 iterations

A way is done when its validation error, mean over the modules, is at most Table 1's, or when it has taken --give-up
times as long as ours. Times are processor time of the training process, validation included. The authors' worker works
beside it on the other core and is not counted. The share of the optimizer in a training step is measured first.
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
from modsoft.runtime.entry_point import entry
from modsoft.training import networks, optimizer, train
from modsoft.training.data import collect, dataset
from modsoft.training.data.dataset import DataSet, Windows
from modsoft.training.fit import estimation_errors
from modsoft.training.networks import BiLSTM
from modsoft.training.settings import BY_KIND, Settings

TABLE_1_PERCENT = (1.63, 1.49, 1.11, 0.70)  # biLSTM, modules 1 to 4
ROOT = Path(__file__).resolve().parents[2]
SAMPLES, STEPS_PER_EPISODE = 16_000, 1000  # the paper's
TURN_S = 5.0
WAYS = ("ours", "adam", "authors")
ADAM_TIMES = 4  # as many iterations as ours: with as few it ends its schedule far above the error
# What limits the instruction set of torch and of the libraries that it calls.
ISAS = {
    "native": {},
    "avx2": {"ATEN_CPU_CAPABILITY": "avx2", "ONEDNN_MAX_CPU_ISA": "AVX2", "MKL_ENABLE_INSTRUCTIONS": "AVX2"},
}
# Windows, robot and largest share of the optimizer in a training step that we want at AVX2.
STEPS = ((128, "pneumatic-3", 0.5), (256, "cable-4", 0.25))


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
    give_up: float = 5.0  # a way that takes so many times our time is not waited for


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


class Adam(torch.optim.Adam):
    """Adam for all parameters, with the interface of `muon.MuonAndAdam`."""

    def __init__(self, network: torch.nn.Module):
        super().__init__(network.parameters())

    def step(self, rate: float) -> None:  # type: ignore[override]
        self.param_groups[0]["lr"] = rate
        super().step()
        self.zero_grad()


def adam(race: Race, data: DataSet) -> None:
    """`ours` with another optimizer."""
    optimizer.MuonAndAdam = Adam  # type: ignore[misc,assignment]
    ours(dataclasses.replace(race, iterations=ADAM_TIMES * race.iterations), data)


def ours(race: Race, data: DataSet) -> None:
    """modsoft-train without its command line."""
    settings = Settings(
        **BY_KIND[data.robot.kind] | {"split": "shuffled", "batch": race.batch},
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
            lambda progress: turns.tell(progress.iteration, progress.validation_percent),
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
    history = BY_KIND[data.robot.kind]["history"]
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
            percent = min(percent, float(estimation_errors(network, validation).mean()))
        turns.tell(iteration, percent)


RUNS: dict[str, Callable[[Race, DataSet], None]] = {"ours": ours, "adam": adam, "authors": authors}


def step_times(rounds: int) -> list[dict[str, Any]]:
    """Milliseconds of processor time of a training step of `STEPS`, gradient and optimizer: medians of `rounds`."""
    torch.set_num_threads(1)
    rows = []
    for batch, name, wanted in STEPS:
        robot = robots.load(name)
        history = BY_KIND[robot.kind]["history"]
        sizes = {"feature_size": history * (robot.state_size + robot.action_size) + 1, "action_size": robot.action_size}
        network = networks.build({"name": "bilstm", "layers": 4, "hidden": 128, **sizes})
        both, features = optimizer.MuonAndAdam(network), torch.randn(batch, robot.modules, sizes["feature_size"])
        times = []
        for _ in range(rounds + 1):  # the first one sets up
            began_s = time.process_time()
            network(features).abs().mean().backward()
            middle_s = time.process_time()
            both.step(1e-3)
            times.append((middle_s - began_s, time.process_time() - middle_s))
        gradient_ms, optimizer_ms = (1e3 * float(each) for each in np.median(times[1:], axis=0))
        share = optimizer_ms / (gradient_ms + optimizer_ms)
        rows.append(
            {
                "batch": batch,
                "modules": robot.modules,
                "gradient_ms": gradient_ms,
                "optimizer_ms": optimizer_ms,
                "share": share,
                "wanted_share": wanted,
            }
        )
    return rows


def step_times_at(isa: str, rounds: int) -> list[dict[str, Any]]:
    """`step_times` in a process of that instruction set."""
    command = [sys.executable, "-P", __file__, "--run", "steps", str(rounds)]
    done = subprocess.run(command, env=os.environ | ISAS[isa], stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout)


class Runner:
    """One way in a process of its own, which works in its turns only."""

    def __init__(self, way: str, race: Race, isa: str):
        self.target_percent = race.target_percent
        self.told: list[dict[str, Any]] = []
        self.process = subprocess.Popen(
            [sys.executable, "-P", __file__, "--run", way, json.dumps(dataclasses.asdict(race))],
            env=os.environ | ISAS[isa],
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

    def over(self, limit_s: float) -> bool:
        """Whether it is done, has ended, or has worked for `limit_s`."""
        worked_s = self.told[-1]["cpu_s"] - self.told[0]["cpu_s"]
        done = arrived(self.told, self.target_percent) is not None
        return done or worked_s > limit_s or self.process.poll() is not None


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


def compared(race: Race, found: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The figures of every way, and how many times as fast ours is: more than 1 is better."""
    reached = found["ours"]["seconds_to_target"]
    ratios = {}
    for way in WAYS[1:]:
        other = found[way]
        # Where the other way is not there yet, its time so far is a lower bound.
        ratios[way] = {
            "samples_per_s": found["ours"]["samples_per_s"] / other["samples_per_s"],
            "time_to_target": other["seconds"] / reached if reached else None,
            "lower_bound": other["seconds_to_target"] is None,
        }
    settings = {name: value for name, value in dataclasses.asdict(race).items() if name != "data"}
    return {"race": settings, "ways": found, "ratios": ratios}


def raced(race: Race, minutes: float, turn_s: float, isa: str = "native") -> dict[str, Any]:
    """All ways in turns until each is done, gives up, or for so many minutes by the clock."""
    with contextlib.ExitStack() as stack:
        runners = {}
        for way in WAYS:
            runners[way] = Runner(way, race, isa)
            stack.callback(runners[way].end)
        end_s, limit_s = time.monotonic() + 60.0 * minutes, float("inf")
        while time.monotonic() < end_s and not all(runner.over(limit_s) for runner in runners.values()):
            for way, runner in runners.items():
                if not runner.over(limit_s):
                    runner.turn(turn_s)
                    state = runner.told[-1]
                    click.echo(f"{way}: iteration {state['iteration']}, best {state['percent']:.2f} %", err=True)
            ours_s = figures(runners["ours"].told, race.target_percent)["seconds_to_target"]
            limit_s = race.give_up * ours_s if ours_s else limit_s
        silent = [way for way, runner in runners.items() if len(runner.told) < 2]
        if silent:
            raise click.ClickException(f"{', '.join(silent)}: no turn within {minutes:g} minutes; give more --minutes")
        return compared(race, {way: figures(runners[way].told, race.target_percent) for way in WAYS})


def about(isa: str) -> dict[str, Any]:
    """Where and on what commit a run was made."""
    git = subprocess.run(["git", "describe", "--always", "--dirty"], cwd=ROOT, capture_output=True, text=True)
    return {
        "isa": isa,
        "processor": processor(),
        "cores": os.cpu_count(),
        "torch": str(torch.__version__),
        "commit": git.stdout.strip() or "unknown",
    }


def processor() -> str:
    """The processor's name and which vector instructions it has."""
    units = getattr(torch.cpu, "get_capabilities", dict)()
    flags = [name for name in ("avx2", "avx512_f", "avx512_bf16", "amx_bf16") if units.get(name)]
    return f"{platform.processor() or platform.machine()} with {', '.join(flags) or 'no vector instructions known'}"


def table(result: dict[str, Any]) -> str:
    """One run in Markdown."""
    race, described = result["race"], result["about"]
    target = race["target_percent"]
    lines = [
        f"Instruction set {described['isa']}: {described['processor']}, {described['cores']} cores, torch "
        f"{described['torch']}, commit {described['commit']}; {race['samples']} samples.",
        "",
        f"| way | batch | iterations/s | samples/s | iterations | best % | s to {target:.2f} % | ours is faster by |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for way in WAYS:
        row, ratio = result["ways"][way], result["ratios"].get(way)
        reached = row["seconds_to_target"]
        best = "none yet" if row["best_percent"] is None else f"{row['best_percent']:.2f}"
        faster = ""
        if ratio and ratio["time_to_target"]:
            faster = f"{'at least ' * ratio['lower_bound']}{ratio['time_to_target']:.1f}"
        lines.append(
            f"| {way} | {row['batch']} | {row['iterations_per_s']:.1f} | {row['samples_per_s']:.0f} "
            f"| {row['iterations']} | {best} | {f'{reached:.0f}' if reached else 'not reached'} | {faster} |"
        )
    lines += ["", "| windows in a step | modules | gradient, ms | optimizer, ms | share of the optimizer | wanted |"]
    lines += ["| ---: | ---: | ---: | ---: | ---: | ---: |"]
    lines += [
        f"| {row['batch']} | {row['modules']} | {row['gradient_ms']:.1f} | {row['optimizer_ms']:.1f} "
        f"| {row['share']:.0%} | at most {row['wanted_share']:.0%} |"
        for row in result["steps"]
    ]
    return "\n".join(lines)


def document(folder: Path) -> str:
    """The page of all runs kept in `folder`, one JSON file an instruction set."""
    results = [json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*.json"))]
    return f"""# Training speed

Processor seconds to the error of the paper's Table 1, the mean over the four modules on the paper's shuffled split.
`ours` is modsoft-train, `adam` the same with Adam in place of Muon, `authors` the training of the paper's authors
(Table S1). All take turns on one core in one run. Each table is made by

    python tools/bench/training.py --isa native|avx2 --report docs/training.md

{(chr(10) * 2).join(table(result) for result in results)}
"""


@click.command(help=__doc__)
@click.option("--isa", type=click.Choice(list(ISAS)), default="native", show_default=True, help="Instruction set.")
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write all figures here, one JSON object.")
@click.option("--report", type=click.Path(path_type=Path), help="Markdown page to update.")
@click.option("--quick", is_flag=True, help="A small network to a coarse error: less than a minute.")
@click.option("--data", type=click.Path(path_type=Path), help="Data set to train on; collected where none is given.")
@click.option("--iterations", default=1400, show_default=True, help="Of ours: few that still reach the error.")
@click.option("--batch", default=128, show_default=True, help="Windows in a step of ours.")
@click.option("--give-up", default=5.0, show_default=True, help="Stop a way after so many times our time.")
@click.option("--minutes", default=90.0, show_default=True, help="By the clock, for all together.")
@click.option("--seed", default=0, show_default=True)
@click.option("--run", nargs=2, hidden=True)
def main(
    isa: str,
    json_file: Path | None,
    report: Path | None,
    quick: bool,
    data: Path | None,
    minutes: float,
    run: Any,
    **options: Any,
) -> None:
    if run and run[0] == "steps":
        click.echo(json.dumps(step_times(int(run[1]))))
        return
    if run:
        race = Race(**json.loads(run[1]))
        RUNS[run[0]](race, first_samples(dataset.read(Path(race.data)), race.samples))
        return
    described = about(isa)
    with tempfile.TemporaryDirectory() as folder:
        samples, turn_s = (3200, 1.0) if quick else (SAMPLES, TURN_S)
        if data is None:
            data = Path(folder) / "d.h5"
            collect.collect(robots.load("cable-4"), data, samples, steps=STEPS_PER_EPISODE if not quick else 200)
        race = Race(str(data), samples, layers=4, hidden=128, target_percent=float(np.mean(TABLE_1_PERCENT)), **options)
        if quick:
            race = dataclasses.replace(race, layers=2, hidden=32, iterations=300, target_percent=8.0)
            minutes = min(minutes, 0.7)
        steps = step_times_at(isa, 3 if quick else 30)
        result = {"about": described, **raced(race, minutes, turn_s, isa), "steps": steps}
    click.echo(table(result))
    text = json.dumps(result, indent=1) + "\n"
    if json_file:
        json_file.write_text(text, encoding="utf-8")
    if report:
        folder = report.with_suffix("")
        folder.mkdir(exist_ok=True)
        (folder / f"{isa}.json").write_text(text, encoding="utf-8")
        report.write_text(document(folder), encoding="utf-8")


if __name__ == "__main__":
    entry(main)()
