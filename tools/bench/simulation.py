"""Performance of the simulation kernel: a time step of the fleet compared with PyElastica, alone and in a block of 8.

`python tools/bench/simulation.py --isa native|avx2 --report docs/simulation.md`. `--compare` measures instead the
difference of their configurations.

Everything is measured in one run, in short turns that follow each other, so that other load on the machine affects all
alike. A figure is the least processor time of its turns; only the gain of a second thread is measured by wall clock.
The fraction of peak is the number of operations in fleet_kernel.h, counted by hand (a multiply-add is two operations, a
division or a root is one), over that of independent multiply-adds with vectors of the same width in the same time.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path
from typing import Any

import click
import elastica
import numpy as np
import report
from simulation_page import draw, section, section_with_figure

from modsoft.runtime import robot as robot_file
from modsoft.runtime.entry_point import entry
from modsoft.runtime.errors import DeviceAbsent, ModsoftError, UsageError
from modsoft.training.simulation import fleet_kernel
from modsoft.training.simulation.elastica import Arm, _Loads, _Simulator
from modsoft.training.simulation.fleet import Fleet
from modsoft.training.simulation.parameters import PlantParameters, plant_of

PARAMETERS = {
    kind: plant_of(robot_file.load(robot)) for kind, robot in (("cable", "cable-4"), ("pneumatic", "pneumatic-3"))
}
OPERATIONS_PER_ELEMENT = {"cable": 417, "pneumatic": 435}
ACTIONS = {"cable": 2, "pneumatic": 1}
BLOCK = 8
PEAK_ROUNDS = 2_000_000
TURNS_A_PERIOD = 4  # a turn is a quarter of a control period

Call = Callable[[], object]


class Block:
    """Eight robots as rods of one PyElastica memory block, with the rods and loads of as many `Arm`s."""

    def __init__(self, kind: str, modules: int, actuation: np.ndarray) -> None:
        self.parameters = PARAMETERS[kind]
        self.simulator = _Simulator()
        for each in actuation:
            arm = Arm(PARAMETERS[kind], modules)
            arm.step(each, self.parameters.time_step_s)  # sets the stresses
            self.simulator.append(arm._rod)
            ends = {"constrained_position_idx": (0,), "constrained_director_idx": (0,)}
            self.simulator.constrain(arm._rod).using(elastica.OneEndFixedBC, **ends)
            self.simulator.add_forcing_to(arm._rod).using(_Loads, self.parameters, arm._state)
        self.simulator.finalize()
        self.stepper = elastica.PositionVerlet()
        self.time_s = np.float64(0.0)

    def advance(self) -> None:
        for _ in range(turn_steps(self.parameters)):
            self.time_s = self.stepper.step(self.simulator, self.time_s, self.parameters.time_step_s)


def turn_steps(parameters: PlantParameters) -> int:
    """Time steps of a turn."""
    return round(parameters.period_s / parameters.time_step_s) // TURNS_A_PERIOD


def turns(kind: str, modules: int, counts: list[int]) -> dict[str, tuple[int, Call]]:
    """What is timed for one kind and module number: name to (robots, a turn)."""
    turn_s = turn_steps(PARAMETERS[kind]) * PARAMETERS[kind].time_step_s
    actions = 0.5 * np.random.default_rng(modules).uniform(-1, 1, (max(*counts, BLOCK), modules, ACTIONS[kind]))
    arm = Arm(PARAMETERS[kind], modules)
    by_name: dict[str, tuple[int, Call]] = {
        "elastica": (1, lambda: arm.step(actions[0], turn_s)),
        "elastica block of 8": (BLOCK, Block(kind, modules, actions[:BLOCK]).advance),
    }
    for count in counts:
        fleet = Fleet(PARAMETERS[kind], modules, count)
        by_name[f"fleet of {count}"] = (count, lambda fleet=fleet, count=count: fleet.step(actions[:count], turn_s))
    return by_name


def least_seconds(calls: dict[Any, Call], rounds: int, clock: Callable[[], float]) -> dict[Any, float]:
    """Seconds of the quickest of `rounds` calls of each, called in turn, after one that does not count."""
    least = dict.fromkeys(calls, float("inf"))
    for round_ in range(rounds + 1):
        for name, call in calls.items():
            start = clock()
            call()
            if round_:
                least[name] = min(least[name], clock() - start)
    return least


def two_threads(variant: int, rounds: int) -> dict[str, float]:
    """Robot-steps a second of four-module robots on one thread and on two, wall clock, and the gain of independent
    multiply-adds from the second thread in the same turns. The turns are short and many, so that some have both cores
    free on a machine with other work."""
    library, rounds = fleet_kernel.library(), 10 * rounds
    turn_s, steps = 0.125, 500
    actions = 0.5 * np.random.default_rng(0).uniform(-1, 1, (32, 4, 2))
    fleets = {threads: Fleet(PARAMETERS["cable"], 4, 32, threads=threads) for threads in (1, 2)}
    calls: dict[Any, Call] = {
        threads: lambda fleet=fleet: fleet.step(actions, turn_s) for threads, fleet in fleets.items()
    }
    with ThreadPoolExecutor(2) as pool:
        for threads in fleets:
            parts = [4 * PEAK_ROUNDS // threads] * threads
            calls["peak", threads] = lambda parts=parts: list(pool.map(lambda n: library.fleet_peak(variant, n), parts))
        seconds = least_seconds(calls, rounds, time.perf_counter)
    per_second = {f"threads_{threads}": 32 * steps / seconds[threads] for threads in fleets}
    gain, peak_gain = seconds[1] / seconds[2], seconds["peak", 1] / seconds["peak", 2]
    return {**per_second, "ratio": gain, "peak_ratio": peak_gain, "ratio_to_peak": gain / peak_gain}


def measured(kinds: list[str], module_numbers: list[int], counts: list[int], rounds: int) -> report.Result:
    """The figures of all kinds, module numbers and numbers of robots, and of two threads."""
    library, variant = fleet_kernel.library(), fleet_kernel.VARIANTS.index(fleet_kernel.variants()[-1])
    parts = {}
    for kind in kinds:
        for modules in module_numbers:
            try:
                part = turns(kind, modules, counts)
                for _ in range(rounds + 2):  # more turns than are measured: none of those diverges
                    part["elastica"][1]()
            except ModsoftError:
                click.echo(f"a {kind} robot of {modules} modules diverges in PyElastica: left out")
            else:
                parts[kind, modules] = part
    calls: dict[Any, Call] = {(*key, name): turn for key, part in parts.items() for name, (_, turn) in part.items()}
    calls["peak"] = lambda: library.fleet_peak(variant, PEAK_ROUNDS)
    seconds = least_seconds(calls, rounds, time.process_time)
    peak = 2 * 12 * library.fleet_lanes(variant) * PEAK_ROUNDS / seconds.pop("peak")
    rows = []
    for (kind, modules), part in parts.items():
        steps = turn_steps(PARAMETERS[kind])
        us = {name: 1e6 * seconds[kind, modules, name] / steps / count for name, (count, _) in part.items()}
        rows += [figures(kind, modules, count, us, peak) for count in counts]
    return {
        "about": report.about(pyelastica=version("pyelastica"), variant=fleet_kernel.VARIANTS[variant]),
        "peak_gflop_s": 1e-9 * peak,
        "rows": rows,
        "two_threads": two_threads(variant, rounds),
    }


def figures(kind: str, modules: int, count: int, us: dict[str, float], peak: float) -> dict[str, Any]:
    """The row of a fleet. us: microseconds of a time step of one robot by the name of its turn; peak: operations/s."""
    cost = us[f"fleet of {count}"]
    operations = OPERATIONS_PER_ELEMENT[kind] * modules * PARAMETERS[kind].elements
    return {
        "kind": kind,
        "modules": modules,
        "robots": count,
        "fleet_us": cost,
        "elastica_us": us["elastica"],
        "elastica_block_us": us["elastica block of 8"],
        "ratio": us["elastica"] / cost,
        "ratio_block": us["elastica block of 8"] / cost,
        "fraction_of_peak": operations / (1e-6 * cost) / peak,
    }


def compared(kinds: list[str], module_numbers: list[int], periods: int) -> list[dict[str, Any]]:
    """Largest difference of a configuration between fleet and PyElastica under full-range random actions, both with
    explicit damping. Where PyElastica's robot diverges, the fleet's has to diverge in the same period."""
    rows = []
    for kind in kinds:
        for modules in module_numbers:
            actions = np.random.default_rng(2).uniform(-1, 1, (periods, 1, modules, ACTIONS[kind]))
            arm, fleet = Arm(PARAMETERS[kind], modules), Fleet(PARAMETERS[kind], modules, 1, damping="explicit")
            difference, done = np.abs(fleet.configuration[0] - arm.configuration).max(), 0
            for action in actions:
                fleet.step(action)
                try:
                    arm.step(action[0])
                except ModsoftError:
                    break
                done += 1
                difference = max(difference, np.abs(fleet.configuration[0] - arm.configuration).max())
            diverged = "both" if done < periods and not fleet.alive[0] else "elastica" if done < periods else ""
            row = {"kind": kind, "modules": modules, "periods": done, "difference": float(difference)}
            rows.append({**row, "diverged": diverged})
            which = f" (diverged: {diverged})" if diverged else ""
            click.echo(f"{kind} {modules}: {difference:.1e} after {done} periods{which}")
    return rows


@click.command(help=__doc__)
@click.option("--kind", "kinds", multiple=True, type=click.Choice(list(PARAMETERS)), help="Default: all.")
@report.isa_option
@report.options("Fewer sizes and turns: less than a minute.")
@click.option("--picture", type=click.Path(path_type=Path), help="Write a picture here (PNG).")
@report.page_option
@click.option("--compare", is_flag=True, help="Difference between fleet and PyElastica after 50 periods; minutes.")
def main(
    kinds: tuple[str, ...],
    isa: str,
    json_file: Path | None,
    picture: Path | None,
    page: report.Page | None,
    quick: bool,
    compare: bool,
) -> None:
    if fleet_kernel.library() is None:
        raise DeviceAbsent("the fleet's kernel is not built; expected a C compiler at installation: make install")
    if isa == "avx2":
        os.environ[fleet_kernel.LIMIT] = "avx2"
        if fleet_kernel.variants()[-1] != "avx2":
            raise UsageError("this processor has no AVX2, expected one that has; leave --isa out")
    chosen = list(kinds or PARAMETERS)
    if compare:
        rows = compared(chosen, [2, 4] if quick else [2, 3, 4, 6, 12], 5 if quick else 50)
        result: report.Result = {"about": report.about(), "compared": rows}
    else:
        sizes = ([2, 4, 12], [1, 8, 64], 5) if quick else ([2, 3, 4, 6, 8, 12], [1, 2, 4, 8, 16, 32, 64], 15)
        result = measured(chosen, *sizes)
        click.echo(section(result))
        if picture:
            draw(result, picture)
        if page:
            write_page(result, page)
    report.write_json(result, json_file)


def write_page(result: report.Result, page: report.Page) -> None:
    """Draws the figure of the kernel variant and updates the page."""
    variant = result["about"]["variant"]
    page.folder.mkdir(exist_ok=True)
    draw(result, page.folder / f"{variant}.png")
    page.update(variant, result, lambda stored: section_with_figure(stored, page.folder.name))


if __name__ == "__main__":
    entry(main)()
