"""How late a control tick begins: our ticker, time.sleep and asyncio, at 2.5, 25 and 100 Hz, on a free and a busy core.

`python tools/bench/loop.py`. All nine loops run at the same time, each a process of its own on one core, their ticks
spread over 10 ms so that none meets another: whatever disturbs one disturbs all. Busy: four processes that never rest
share that core with them. All three wait for absolute deadlines; the other two make up for a late tick at once, ours
skips it where it is more than half a period late. Lateness is that of the ticks that ran.
"""

from __future__ import annotations

import asyncio
import json
import math
import multiprocessing as mp
import os
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import click
import numpy as np

from modsoft.runtime.clock import Ticker
from modsoft.runtime.entry_point import entry
from modsoft.runtime.log import host
from modsoft.runtime.stop import Stop

RATES_HZ = (2.5, 25.0, 100.0)
BUSY = 4
START_S = 0.5  # from when all loops are there
SPREAD_S = 0.01

Ticks = list[tuple[float, float]]  # (due, begun), seconds of the monotonic clock


def our_ticker(period_s: float, start_s: float, end_s: float) -> Ticks:
    """As in a run: the ticker waits with what a request to stop would wake."""
    ticker = Ticker(period_s, time.monotonic, Stop().wait)
    ticker.start(start_s - time.monotonic())
    ticks = []
    while (tick := ticker.next()).due_s < end_s:
        ticks.append((tick.due_s, tick.start_s))
    return ticks


def sleep(period_s: float, start_s: float, end_s: float) -> Ticks:
    ticks: Ticks = []
    while (due_s := start_s + len(ticks) * period_s) < end_s:
        time.sleep(max(0.0, due_s - time.monotonic()))
        ticks.append((due_s, time.monotonic()))
    return ticks


def with_asyncio(period_s: float, start_s: float, end_s: float) -> Ticks:
    async def loop() -> Ticks:
        ticks: Ticks = []
        while (due_s := start_s + len(ticks) * period_s) < end_s:
            await asyncio.sleep(max(0.0, due_s - time.monotonic()))
            ticks.append((due_s, time.monotonic()))
        return ticks

    return asyncio.run(loop())


PACES: dict[str, Callable[[float, float, float], Ticks]] = {
    "our ticker": our_ticker,
    "time.sleep": sleep,
    "asyncio": with_asyncio,
}


def paced(pace: str, period_s: float, core: int, told: Connection) -> None:
    """A process with one loop: says that it is there, is told from when until when, gives its ticks."""
    os.sched_setaffinity(0, {core})
    told.send("here")
    told.send(PACES[pace](period_s, *told.recv()))


def busy(core: int) -> None:
    """A process that never rests."""
    os.sched_setaffinity(0, {core})
    while True:
        pass


def figures(ticks: Ticks, period_s: float, planned: int) -> dict[str, float | int]:
    """Of one loop: lateness, ms; slots that it skipped; gaps of less than half a period between two ticks."""
    due_s, begun_s = np.array(ticks).T
    late_ms = 1e3 * (begun_s - due_s)
    p50, p99, p999 = np.percentile(late_ms, [50, 99, 99.9], method="higher")
    gaps_s = np.diff(begun_s)
    return {
        "ticks": len(ticks),
        "p50_ms": float(p50),
        "p99_ms": float(p99),
        "p99_9_ms": float(p999),
        "max_ms": float(late_ms.max()),
        "skipped": planned - len(ticks),
        "bursts": int(np.sum(gaps_s < 0.5 * period_s * (1 - 1e-6))),
        "shortest_gap": float(gaps_s.min() / period_s),
    }


def measured(seconds: float, busy_processes: int, core: int) -> list[dict[str, Any]]:
    """All nine loops at once, for so long."""
    spawn = mp.get_context("spawn")
    loops = [(pace, hz, *spawn.Pipe()) for hz in RATES_HZ for pace in PACES]
    processes = [spawn.Process(target=paced, args=(pace, 1 / hz, core, theirs)) for pace, hz, _, theirs in loops]
    others = [spawn.Process(target=busy, args=(core,), daemon=True) for _ in range(busy_processes)]
    for process in processes:
        process.start()
    for _, _, ours, _ in loops:
        ours.recv()
    for process in others:
        process.start()
    start_s = time.monotonic() + START_S
    for place, (_, _, ours, _) in enumerate(loops):
        begin_s = start_s + SPREAD_S * place / len(loops)
        ours.send((begin_s, begin_s + seconds))
    rows = [
        {"busy": busy_processes, "hz": hz, "pace": pace, **figures(ours.recv(), 1 / hz, math.ceil(seconds * hz - 1e-9))}
        for pace, hz, ours, _ in loops
    ]
    for process in others:
        process.terminate()
    for process in [*processes, *others]:
        process.join()
    return rows


def ratios(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Lateness of the others over ours, at the same rate and load."""
    ours = {(row["busy"], row["hz"]): row for row in rows if row["pace"] == "our ticker"}
    return [
        {
            **{name: row[name] for name in ("busy", "hz", "pace")},
            **{f"{name}_over_ours": row[name] / ours[row["busy"], row["hz"]][name] for name in ("p50_ms", "p99_ms")},
        }
        for row in rows
        if row["pace"] != "our ticker"
    ]


def table(result: dict[str, Any]) -> str:
    lines = [
        f"{result['system']}, {result['cores']} cores, load average {result['load_average']:.1f} before; "
        f"{result['seconds']:g} s each, all at once on core {result['core']}",
        "",
    ]
    lines += [
        "| busy beside | Hz | pace | ticks | p50 ms | p99 ms | p99.9 ms | max ms | skipped | shortest gap "
        "/ period | gaps below half |"
    ]
    lines += ["| ---: | ---: | --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"]
    for row in result["rows"]:
        lines.append(
            f"| {row['busy']} | {row['hz']:g} | {row['pace']} | {row['ticks']} | {row['p50_ms']:.3f} "
            f"| {row['p99_ms']:.3f} | {row['p99_9_ms']:.3f} | {row['max_ms']:.3f} | {row['skipped']} "
            f"| {row['shortest_gap']:.2f} | {row['bursts']} |"
        )
    return "\n".join(lines)


@click.command(help=__doc__)
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write all figures here, one JSON object.")
@click.option("--seconds", default=420.0, show_default=True, help="Of the free and of the busy core each.")
@click.option("--quick", is_flag=True, help="10 seconds each: less than a minute.")
def main(json_file: Path | None, seconds: float, quick: bool) -> None:
    seconds = 10.0 if quick else seconds
    core = max(os.sched_getaffinity(0))
    about = {**host(), "load_average": os.getloadavg()[0], "seconds": seconds, "core": core}
    about.pop("name")
    rows = [row for others in (0, BUSY) for row in measured(seconds, others, core)]
    result = {**about, "rows": rows, "ratios": ratios(rows)}
    click.echo(table(result))
    if json_file:
        json_file.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    entry(main)()
