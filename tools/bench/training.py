"""Training speed: the time to the error of the paper's Table 1, compared with Adam and with the authors' training.

`python tools/bench/training.py --isa native|avx2 --report docs/training.md`. Three methods, each in its own process,
take turns of a few seconds on one core, so that other load of the machine affects all alike. They have the same
samples, split (the paper's, shuffled) and network, and one torch thread each:

    ours     modsoft.training.train.train with its own defaults, --iterations of --batch windows
    adam     the same with Adam for all parameters instead of Muon, and four times the iterations, which it needs
    authors  the training of the paper's authors: windows read one by one through a DataLoader with one worker; batch
             64, Adam at a constant learning rate of 0.001 (Table S1); dropout 0.1; validation every 500 iterations

A method ends when its validation error, mean over the modules, is at most that of Table 1, or after --give-up times our
time.
Times are processor time of the training process, validation included. The authors' worker runs on the other core and
is not counted. The fraction of the optimizer in a training step is measured first.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import click
import numpy as np
import report
import torch
from training_methods import METHODS, Comparison

from modsoft.runtime import robot as robot_file
from modsoft.runtime.entry_point import entry
from modsoft.study.cells import table
from modsoft.study.paper import TABLE_1
from modsoft.training.data import collect

SCRIPT = Path(__file__).with_name("training_methods.py")
SAMPLES, STEPS_PER_EPISODE = 16_000, 1000  # the paper's
TURN_S = 5.0
# Limits of the instruction set of torch and of the libraries that it calls.
ISAS = {
    "native": {},
    "avx2": {"ATEN_CPU_CAPABILITY": "avx2", "ONEDNN_MAX_CPU_ISA": "AVX2", "MKL_ENABLE_INSTRUCTIONS": "AVX2"},
}

States = list[dict[str, Any]]  # what a method reported, see `training_methods.Turns`


def command(method: str, argument: str) -> list[str]:
    return [sys.executable, str(SCRIPT), method, argument]


def step_times_at(isa: str, rounds: int) -> list[dict[str, Any]]:
    """`training_methods.step_times` in a process limited to the instruction set."""
    environment = report.script_environment(**ISAS[isa])
    done = subprocess.run(command("steps", str(rounds)), env=environment, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout)


class Runner:
    """One method in its own process, which trains in its turns only."""

    def __init__(self, method: str, comparison: Comparison, isa: str):
        self.target_percent = comparison.target_percent
        self.states: States = []
        self.process = subprocess.Popen(
            command(method, json.dumps(dataclasses.asdict(comparison))),
            env=report.script_environment(**ISAS[isa]),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self._read_states()  # until the first iteration: imports and reading of data do not count
        if not self.states:
            raise click.ClickException(f"{method}: ended before its first iteration; see its output above")

    def turn(self, seconds: float) -> None:
        """The process trains for so many seconds."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{seconds}\n")
        self.process.stdin.flush()
        self._read_states()

    def _read_states(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.states.append(json.loads(line))
            if self.states[-1]["waits"]:
                return
        self.process.wait()

    def end(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.close()  # ends the process; the system closes it too if this process is killed
        self.process.wait()

    def over(self, limit_s: float) -> bool:
        """Whether the method has reached the target, has ended, or has trained for `limit_s`."""
        trained_s = self.states[-1]["cpu_s"] - self.states[0]["cpu_s"]
        reached = first_at_target(self.states, self.target_percent) is not None
        return reached or trained_s > limit_s or self.process.poll() is not None


def first_at_target(states: States, target_percent: float) -> dict[str, Any] | None:
    """The first state whose error is at most the target."""
    return next((state for state in states if state["percent"] <= target_percent), None)


def figures(states: States, target_percent: float) -> dict[str, Any]:
    """The figures of one method; the time to the target is None if it was not reached."""
    first, at_target = states[0], first_at_target(states, target_percent)
    last = at_target or states[-1]
    seconds = last["cpu_s"] - first["cpu_s"]
    iterations_per_s = (last["iteration"] - first["iteration"]) / seconds
    best = min(state["percent"] for state in states)
    return {
        "batch": last["batch"],
        "iterations": last["iteration"],
        "iterations_per_s": iterations_per_s,
        "samples_per_s": iterations_per_s * last["batch"],
        "seconds": seconds,
        "seconds_to_target": seconds if at_target else None,
        "best_percent": best if np.isfinite(best) else None,
    }


def compared(comparison: Comparison, methods: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """The figures of every method and the ratios of ours to the others: more than 1 means that ours is faster."""
    reached_s = methods["ours"]["seconds_to_target"]
    ratios = {}
    for method in list(METHODS)[1:]:
        other = methods[method]
        # If the other method has not reached the target, its time so far is a lower bound.
        ratios[method] = {
            "samples_per_s": methods["ours"]["samples_per_s"] / other["samples_per_s"],
            "time_to_target": other["seconds"] / reached_s if reached_s else None,
            "lower_bound": other["seconds_to_target"] is None,
        }
    settings = {name: value for name, value in dataclasses.asdict(comparison).items() if name != "data"}
    return {"comparison": settings, "methods": methods, "ratios": ratios}


def run(comparison: Comparison, minutes: float, turn_s: float, isa: str = "native") -> dict[str, Any]:
    """All methods in turns, until each is over or for so many minutes of wall clock."""
    with contextlib.ExitStack() as stack:
        runners = {}
        for method in METHODS:
            runners[method] = Runner(method, comparison, isa)
            stack.callback(runners[method].end)
        end_s, limit_s = time.monotonic() + 60.0 * minutes, float("inf")
        while time.monotonic() < end_s and not all(runner.over(limit_s) for runner in runners.values()):
            for method, runner in runners.items():
                if not runner.over(limit_s):
                    runner.turn(turn_s)
                    state = runner.states[-1]
                    click.echo(f"{method}: iteration {state['iteration']}, best {state['percent']:.2f} %", err=True)
            ours_s = figures(runners["ours"].states, comparison.target_percent)["seconds_to_target"]
            limit_s = comparison.give_up * ours_s if ours_s else limit_s
        without_turn = [method for method, runner in runners.items() if len(runner.states) < 2]
        if without_turn:
            names = ", ".join(without_turn)
            raise click.ClickException(f"{names}: no turn within {minutes:g} minutes; give more --minutes")
        target_percent = comparison.target_percent
        return compared(comparison, {name: figures(each.states, target_percent) for name, each in runners.items()})


def processor() -> str:
    """The processor's name and its vector instructions."""
    units = getattr(torch.cpu, "get_capabilities", dict)()
    flags = [name for name in ("avx2", "avx512_f", "avx512_bf16", "amx_bf16") if units.get(name)]
    return f"{report.processor()} with {', '.join(flags) or 'unknown vector instructions'}"


def section(result: report.Result) -> str:
    """One result in Markdown."""
    comparison, about = result["comparison"], result["about"]
    lines = [
        f"Instruction set {about['isa']}: {about['processor']}, {about['cores']} cores, torch {about['torch']}, commit "
        f"{about['commit']}; {comparison['samples']} samples.",
        "",
    ]
    heads = [
        "method",
        "batch",
        "iterations/s",
        "samples/s",
        "iterations",
        "best %",
        f"s to {comparison['target_percent']:.2f} %",
    ]
    rows = []
    for method, row in result["methods"].items():
        ratio, reached_s = result["ratios"].get(method), row["seconds_to_target"]
        faster = ""
        if ratio and ratio["time_to_target"]:
            faster = f"{'at least ' * ratio['lower_bound']}{ratio['time_to_target']:.1f}"
        speeds = [f"{row['iterations_per_s']:.1f}", f"{row['samples_per_s']:.0f}"]
        best = "none yet" if row["best_percent"] is None else f"{row['best_percent']:.2f}"
        reached = f"{reached_s:.0f}" if reached_s else "not reached"
        rows.append([method, row["batch"], *speeds, row["iterations"], best, reached, faster])
    lines += table([*heads, "ours is faster by"], rows)
    heads = ["windows in a step", "modules", "gradient, ms", "optimizer, ms", "fraction of the optimizer", "target"]
    rows = []
    for row in result["steps"]:
        times = [f"{row['gradient_ms']:.1f}", f"{row['optimizer_ms']:.1f}", f"{row['optimizer_fraction']:.0%}"]
        rows.append([row["batch"], row["modules"], *times, f"at most {row['target_fraction']:.0%}"])
    return "\n".join([*lines, *table(heads, rows)]).rstrip()


@click.command(help=__doc__)
@report.isa_option
@report.options("A small network and a target that is easy to reach: less than a minute.")
@report.page_option
@click.option("--data", type=click.Path(path_type=Path), help="Data set to train on.  [default: collect one]")
@click.option("--iterations", default=1400, show_default=True, help="Of ours: few that still reach the target.")
@click.option("--batch", default=128, show_default=True, help="Windows in an iteration of ours.")
@click.option("--give-up", default=5.0, show_default=True, help="Stop a method after so many times our time.")
@click.option(
    "--minutes", default=90.0, show_default=True, help="Limit of the wall-clock time of all methods together."
)
@click.option("--seed", default=0, show_default=True)
def main(
    isa: str,
    json_file: Path | None,
    page: report.Page | None,
    quick: bool,
    data: Path | None,
    minutes: float,
    **comparison_options: Any,
) -> None:
    about = report.about(isa=isa, torch=str(torch.__version__)) | {"processor": processor()}
    with tempfile.TemporaryDirectory() as folder:
        samples, turn_s = (3200, 1.0) if quick else (SAMPLES, TURN_S)
        if data is None:
            data = Path(folder) / "d.h5"
            collect.collect(robot_file.load("cable-4"), data, samples, steps=200 if quick else STEPS_PER_EPISODE)
        target_percent = float(np.mean(TABLE_1["bilstm"][0]))
        sizes = {"layers": 4, "hidden": 128}
        comparison = Comparison(str(data), samples, **sizes, target_percent=target_percent, **comparison_options)
        if quick:
            comparison = dataclasses.replace(comparison, layers=2, hidden=32, iterations=300, target_percent=8.0)
            minutes = min(minutes, 0.7)
        steps = step_times_at(isa, 3 if quick else 30)
        result = {"about": about, **run(comparison, minutes, turn_s, isa), "steps": steps}
    report.publish(result, section, json_file, page, isa)


if __name__ == "__main__":
    entry(main)()
