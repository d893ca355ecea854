"""Performance of the simulation kernel: a time step of the fleet against PyElastica, one robot and eight in a block.

`python tools/bench/simulation.py --isa native|avx2 --report docs/simulation.md`; `--compare` shows instead how far the
two are apart.

Everything is measured in one run, in short turns that follow each other, so that other load on the machine affects all
alike; a figure is the least processor time of its turns, and only two threads against one are by the wall clock. The
share of the core's peak counts the arithmetic in fleet_kernel.h by hand (a multiply-add is two operations, a division
or a root one), against independent multiply-adds with vectors of the same width.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import elastica
import numpy as np

from modsoft.runtime.entry_point import entry
from modsoft.runtime.errors import DeviceAbsent, ModsoftError, UsageError
from modsoft.training import plotting
from modsoft.training.simulation import fleet_kernel
from modsoft.training.simulation.elastica import Arm, _Loads, _Simulator
from modsoft.training.simulation.fleet import Fleet
from modsoft.training.simulation.parameters import PLANTS, PlantParameters

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROOT = Path(__file__).parents[2]
OPERATIONS_PER_ELEMENT = {"cable": 417, "pneumatic": 435}
ACTIONS = {"cable": 2, "pneumatic": 1}
BLOCK = 8
FREE_CORE_GAIN = 1.5  # of multiply-adds from a second thread: less, and other load had the second core
PEAK_ROUNDS = 2_000_000
TURNS_A_PERIOD = 4  # a turn is a quarter of a control period
PAGE_ROWS = [(modules, 8) for modules in (2, 4, 12)]  # (modules, robots) in the table; the JSON file has all rows
BEGIN, END = "<!-- performance: written by tools/bench/simulation.py -->", "<!-- end of performance -->"


class Block:
    """Eight robots as rods of one PyElastica memory block, made of the rods and loads of as many `Arm`s."""

    def __init__(self, kind: str, modules: int, actuation: np.ndarray) -> None:
        self.plant = PLANTS[kind]
        self.simulator = _Simulator()
        for each in actuation:
            arm = Arm(kind, modules)
            arm.step(each, self.plant.time_step_s)  # sets the stresses
            self.simulator.append(arm._rod)
            ends = {"constrained_position_idx": (0,), "constrained_director_idx": (0,)}
            self.simulator.constrain(arm._rod).using(elastica.OneEndFixedBC, **ends)
            self.simulator.add_forcing_to(arm._rod).using(_Loads, self.plant, arm._state)
        self.simulator.finalize()
        self.stepper = elastica.PositionVerlet()
        self.time_s = np.float64(0.0)

    def advance(self) -> None:
        for _ in range(turn_steps(self.plant)):
            self.time_s = self.stepper.step(self.simulator, self.time_s, self.plant.time_step_s)


def turn_steps(plant: PlantParameters) -> int:
    return round(plant.period_s / plant.time_step_s) // TURNS_A_PERIOD


def turns(kind: str, modules: int, counts: list[int]) -> dict[str, tuple[int, Callable[[], object]]]:
    """What is timed for one kind and module number: name to (robots, a turn)."""
    turn_s = turn_steps(PLANTS[kind]) * PLANTS[kind].time_step_s
    drawn = 0.5 * np.random.default_rng(modules).uniform(-1, 1, (max(*counts, BLOCK), modules, ACTIONS[kind]))
    arm = Arm(kind, modules)
    found: dict[str, tuple[int, Callable[[], object]]] = {
        "elastica": (1, lambda: arm.step(drawn[0], turn_s)),
        "elastica block of 8": (BLOCK, Block(kind, modules, drawn[:BLOCK]).advance),
    }
    for count in counts:
        robots = Fleet(kind, modules, count)
        found[f"fleet of {count}"] = (count, lambda robots=robots, count=count: robots.step(drawn[:count], turn_s))
    return found


def least_seconds(calls: dict[Any, Callable[[], object]], rounds: int, clock: Callable[[], float]) -> dict[Any, float]:
    """Seconds of the quickest of `rounds` calls of each, called in turn; one more before, which is not counted."""
    least = dict.fromkeys(calls, float("inf"))
    for round_ in range(rounds + 1):
        for name, call in calls.items():
            start = clock()
            call()
            if round_:
                least[name] = min(least[name], clock() - start)
    return least


def two_threads(variant: int, rounds: int) -> dict[str, float]:
    """Robot-steps a second of four-module robots on one thread and on two, by the wall clock, and what independent
    multiply-adds gain from the second thread in the same turns. These are short and many, so that some find both cores
    free on a machine that has other work."""
    library, rounds = fleet_kernel.library(), 10 * rounds
    turn_s, steps = 0.125, 500
    drawn = 0.5 * np.random.default_rng(0).uniform(-1, 1, (32, 4, 2))
    fleets = {threads: Fleet("cable", 4, 32, threads=threads) for threads in (1, 2)}
    calls: dict[Any, Callable[[], object]] = {
        threads: lambda robots=robots: robots.step(drawn, turn_s) for threads, robots in fleets.items()
    }
    with ThreadPoolExecutor(2) as pool:
        for threads in fleets:
            parts = [4 * PEAK_ROUNDS // threads] * threads
            calls["peak", threads] = lambda parts=parts: list(pool.map(lambda n: library.fleet_peak(variant, n), parts))
        seconds = least_seconds(calls, rounds, time.perf_counter)
    per_second = {f"threads_{threads}": 32 * steps / seconds[threads] for threads in fleets}
    gain, peak_gain = seconds[1] / seconds[2], seconds["peak", 1] / seconds["peak", 2]
    return {**per_second, "ratio": gain, "peak_ratio": peak_gain, "ratio_to_peak": gain / peak_gain}


def measured(kinds: list[str], module_numbers: list[int], counts: list[int], rounds: int) -> dict[str, Any]:
    library, variant = fleet_kernel.library(), fleet_kernel.VARIANTS.index(fleet_kernel.variants()[-1])
    parts = {}
    for kind in kinds:
        for modules in module_numbers:
            try:
                part = turns(kind, modules, counts)
                for _ in range(rounds + 2):
                    part["elastica"][1]()
            except ModsoftError:  # a robot that PyElastica loses at once is not worth a figure
                click.echo(f"a {kind} robot of {modules} modules does not hold: left out")
            else:
                parts[kind, modules] = part
    calls: dict[Any, Callable[[], object]] = {
        (*key, name): turn for key, part in parts.items() for name, (_, turn) in part.items()
    }
    calls["peak"] = lambda: library.fleet_peak(variant, PEAK_ROUNDS)
    seconds = least_seconds(calls, rounds, time.process_time)
    peak = 2 * 12 * library.fleet_lanes(variant) * PEAK_ROUNDS / seconds.pop("peak")
    rows = []
    for (kind, modules), part in parts.items():
        steps = turn_steps(PLANTS[kind])
        us = {name: 1e6 * seconds[kind, modules, name] / steps / count for name, (count, _) in part.items()}
        operations = OPERATIONS_PER_ELEMENT[kind] * modules * PLANTS[kind].elements
        for count in counts:
            cost = us[f"fleet of {count}"]
            rows.append(
                {
                    "kind": kind,
                    "modules": modules,
                    "robots": count,
                    "fleet_us": cost,
                    "elastica_us": us["elastica"],
                    "elastica_block_us": us["elastica block of 8"],
                    "ratio": us["elastica"] / cost,
                    "ratio_block": us["elastica block of 8"] / cost,
                    "share_of_peak": operations / (1e-6 * cost) / peak,
                }
            )
    return {
        "processor": processor(),
        "cores": os.cpu_count(),
        "commit": commit(),
        "load_average": os.getloadavg()[0],
        "pyelastica": version("pyelastica"),
        "variant": fleet_kernel.VARIANTS[variant],
        "peak_gflop_s": 1e-9 * peak,
        "rows": rows,
        "two_threads": two_threads(variant, rounds),
    }


def commit() -> str:
    """The commit of the measured code; "-dirty" if the code differs from it."""

    def git(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)

    try:
        name = git("describe", "--always", "--abbrev=10").stdout.strip()
        changed = git("diff", "--quiet", "HEAD", "--", "training", "runtime", "tools", "setup.py").returncode
    except OSError:
        return "unknown"
    return f"{name}{'-dirty' if changed else ''}" if name else "unknown"


def processor() -> str:
    path = Path("/proc/cpuinfo")
    lines = path.read_text().splitlines() if path.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    families = [line.split(":", 1)[1].strip() for line in lines if line.startswith("cpu family")]
    return f"{names[0]}, family {families[0]}" if names and families else platform.processor() or platform.machine()


def table(result: dict[str, Any]) -> str:
    threads = result["two_threads"]
    lines = [
        f"Kernel {result['variant']}: {result['processor']}, {result['cores']} cores, commit {result['commit']}, load "
        f"{result['load_average']:.1f}, peak {result['peak_gflop_s']:.0f} GFLOP/s a core, PyElastica "
        f"{result['pyelastica']}. Microseconds of processor time for a time step of one robot:",
        "",
        "| kind | modules | robots | fleet | PyElastica | its block of 8 | ratio | ratio to block | share of peak |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for row in result["rows"]:
        if (row["modules"], row["robots"]) not in PAGE_ROWS:
            continue
        lines.append(
            f"| {row['kind']} | {row['modules']} | {row['robots']} | {row['fleet_us']:.3f} | {row['elastica_us']:.1f} "
            f"| {row['elastica_block_us']:.1f} | {row['ratio']:.1f} | {row['ratio_block']:.1f} "
            f"| {100 * row['share_of_peak']:.0f} % |"
        )
    measured_alone = f"Multiply-adds alone gain {threads['peak_ratio']:.2f} times from a second thread"
    if threads["peak_ratio"] < FREE_CORE_GAIN:
        sentence = f"{measured_alone}: other load left no core for it, so the kernel's gain was not measured."
    else:
        sentence = (
            f"32 four-module cable robots by the wall clock: {threads['threads_1'] / 1e6:.2f} million robot-steps a "
            f"second on one thread, {threads['threads_2'] / 1e6:.2f} on two: {threads['ratio']:.2f} times. "
            f"{measured_alone}: the kernel gains {threads['ratio_to_peak']:.2f} of that."
        )
    lines += ["", sentence]
    return "\n".join(lines)


def write_report(result: dict[str, Any], page: Path) -> None:
    """Keeps `result` in the folder named like `page`, one JSON file and one picture for each kernel variant, and writes
    the tables of all of them into the page, between its two marks. `UsageError` if it has no such marks."""
    text = page.read_text(encoding="utf-8")
    if text.count(BEGIN) != 1 or text.count(END) != 1 or text.index(BEGIN) > text.index(END):
        raise UsageError(f"{page}: expected one line {BEGIN} and one line {END} after it")
    folder = page.with_suffix("")
    folder.mkdir(exist_ok=True)
    (folder / f"{result['variant']}.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    draw(result, folder / f"{result['variant']}.png")
    parts = []
    for variant in fleet_kernel.VARIANTS:
        path = folder / f"{variant}.json"
        if path.exists():
            caption = f"Microseconds for a time step of one robot, over the number of modules, kernel {variant}"
            parts.append(table(json.loads(path.read_text(encoding="utf-8"))))
            parts.append(f"![{caption}]({folder.name}/{variant}.png)")
    before, after = text[: text.index(BEGIN) + len(BEGIN)], text[text.index(END) :]
    page.write_text("\n\n".join([before, *parts, after]), encoding="utf-8")


def draw(result: dict[str, Any], path: Path) -> None:
    """Cost over the number of modules, a panel for each kind."""
    plotting.save(lambda: _figure(result), path, dpi=110)


def _figure(result: dict[str, Any]) -> Figure:
    kinds = list(dict.fromkeys(row["kind"] for row in result["rows"]))
    figure = plotting.figure(5.2 * len(kinds), 4.2)
    axes = figure.subplots(1, len(kinds), squeeze=False)
    for axis, kind in zip(axes[0], kinds, strict=True):
        rows = [row for row in result["rows"] if row["kind"] == kind]
        modules = sorted({row["modules"] for row in rows})
        counts = sorted({row["robots"] for row in rows})
        first = [row for row in rows if row["robots"] == counts[0]]
        axis.plot(modules, [row["elastica_us"] for row in first], "k-o", label="PyElastica")
        axis.plot(modules, [row["elastica_block_us"] for row in first], "k--s", label="PyElastica, block of 8")
        for count in counts:
            costs = [row["fleet_us"] for row in rows if row["robots"] == count]
            axis.plot(modules, costs, "-o", label=f"fleet of {count}")
        axis.set(title=kind, xlabel="modules", ylabel="microseconds a robot and time step", yscale="log")
        axis.set_xticks(modules)
        axis.grid(visible=True, which="both", alpha=0.3)
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
    return figure


def compared(kinds: list[str], module_numbers: list[int], periods: int) -> list[dict[str, Any]]:
    """Largest difference of a configuration between fleet and PyElastica under full-range random actions, both with
    explicit damping. Where PyElastica loses the robot, the fleet has to lose it in the same period."""
    rows = []
    for kind in kinds:
        for modules in module_numbers:
            drawn = np.random.default_rng(2).uniform(-1, 1, (periods, 1, modules, ACTIONS[kind]))
            arm, robots = Arm(kind, modules), Fleet(kind, modules, 1, damping="explicit")
            apart, done = np.abs(robots.configuration[0] - arm.configuration).max(), 0
            for action in drawn:
                robots.step(action)
                try:
                    arm.step(action[0])
                except ModsoftError:
                    break
                done += 1
                apart = max(apart, np.abs(robots.configuration[0] - arm.configuration).max())
            lost = "both" if done < periods and not robots.alive[0] else "elastica" if done < periods else ""
            rows.append({"kind": kind, "modules": modules, "periods": done, "difference": float(apart), "lost": lost})
            click.echo(f"{kind} {modules}: {apart:.1e} after {done} periods{' (lost by ' + lost + ')' if lost else ''}")
    return rows


@click.command(help=__doc__)
@click.option("--kind", "kinds", multiple=True, type=click.Choice(list(PLANTS)), help="Default: all.")
@click.option(
    "--isa", type=click.Choice(["native", "avx2"]), default="native", show_default=True, help="Instruction set."
)
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write all figures here, one JSON object.")
@click.option("--picture", type=click.Path(path_type=Path), help="Write a picture here (PNG).")
@click.option(
    "--report", type=click.Path(exists=True, dir_okay=False, path_type=Path), help="Page to update (Markdown)."
)
@click.option("--quick", is_flag=True, help="Fewer sizes and turns: less than a minute.")
@click.option("--compare", is_flag=True, help="How far fleet and PyElastica are apart after 50 periods; minutes.")
def main(
    kinds: tuple[str, ...],
    isa: str,
    json_file: Path | None,
    picture: Path | None,
    report: Path | None,
    quick: bool,
    compare: bool,
) -> None:
    if fleet_kernel.library() is None:
        raise DeviceAbsent("the fleet's kernel is not built; expected a C compiler at installation: make install")
    if isa == "avx2":
        os.environ[fleet_kernel.LIMIT] = "avx2"
        if fleet_kernel.variants()[-1] != "avx2":
            raise UsageError("this processor has no AVX2, expected one that has; leave --isa out")
    chosen = list(kinds or PLANTS)
    if compare:
        rows = compared(chosen, [2, 4] if quick else [2, 3, 4, 6, 12], 5 if quick else 50)
        result: dict[str, Any] = {"compared": rows}
    else:
        sizes = ([2, 4, 12], [1, 8, 64], 5) if quick else ([2, 3, 4, 6, 8, 12], [1, 2, 4, 8, 16, 32, 64], 15)
        result = measured(chosen, *sizes)
        click.echo(table(result))
        if picture:
            draw(result, picture)
        if report:
            write_report(result, report)
    if json_file:
        json_file.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    entry(main)()
