"""Lateness of control ticks: our ticker, time.sleep and asyncio, at 2.5, 25 and 100 Hz, on a free and a busy core.

`python tools/bench/loop.py`. All nine loops run at the same time, so that other load affects all alike: each is a
process on the same core, and their ticks are spread over 10 ms so that no two coincide. On the busy core four processes
that never sleep run as well. All timers wait for absolute deadlines. Our ticker skips a tick that is more than half a
period late; the other two run it at once. Lateness is that of the ticks that ran.
"""

from __future__ import annotations

import asyncio
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
import report

from modsoft.runtime.clock import Ticker
from modsoft.runtime.entry_point import entry
from modsoft.runtime.stop import Stop
from modsoft.study.cells import table

RATES_HZ = (2.5, 25.0, 100.0)
BUSY_PROCESSES = 4
START_S = 0.5  # from the start of all processes to the first tick
SPREAD_S = 0.01  # over which the first ticks of the loops are spread

Ticks = list[tuple[float, float]]  # (due, begun), seconds of the monotonic clock


def our_ticker(period_s: float, start_s: float, end_s: float) -> Ticks:
    """The ticker of a run, which a request to stop interrupts."""
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


TIMERS: dict[str, Callable[[float, float, float], Ticks]] = {
    "our ticker": our_ticker,
    "time.sleep": sleep,
    "asyncio": with_asyncio,
}


def run_loop(timer: str, period_s: float, core: int, connection: Connection) -> None:
    """A process with one loop: reports that it has started, receives the start and end time, sends its ticks."""
    os.sched_setaffinity(0, {core})
    connection.send("started")
    connection.send(TIMERS[timer](period_s, *connection.recv()))


def busy(core: int) -> None:
    """A process that never sleeps."""
    os.sched_setaffinity(0, {core})
    while True:
        pass


def figures(ticks: Ticks, period_s: float, planned: int) -> dict[str, float | int]:
    """Figures of one loop: lateness, ms; skipped ticks; bursts, gaps of less than half a period between two ticks."""
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
    """All nine loops at once, for so many seconds."""
    spawn = mp.get_context("spawn")
    loops = [(timer, hz, *spawn.Pipe()) for hz in RATES_HZ for timer in TIMERS]
    processes = [spawn.Process(target=run_loop, args=(timer, 1 / hz, core, child)) for timer, hz, _, child in loops]
    others = [spawn.Process(target=busy, args=(core,), daemon=True) for _ in range(busy_processes)]
    for process in processes:
        process.start()
    for _, _, connection, _ in loops:
        connection.recv()
    for process in others:
        process.start()
    start_s = time.monotonic() + START_S
    for number, (_, _, connection, _) in enumerate(loops):
        begin_s = start_s + SPREAD_S * number / len(loops)
        connection.send((begin_s, begin_s + seconds))
    rows = []
    for timer, hz, connection, _ in loops:
        planned = math.ceil(seconds * hz - 1e-9)  # a rounding error does not count as a tick
        row = {"busy": busy_processes, "hz": hz, "timer": timer}
        rows.append({**row, **figures(connection.recv(), 1 / hz, planned)})
    for process in others:
        process.terminate()
    for process in [*processes, *others]:
        process.join()
    return rows


def ratios(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Lateness of the others divided by ours, at the same rate and load."""
    ours = {(row["busy"], row["hz"]): row for row in rows if row["timer"] == "our ticker"}
    return [
        {
            **{name: row[name] for name in ("busy", "hz", "timer")},
            **{f"{name}_over_ours": row[name] / ours[row["busy"], row["hz"]][name] for name in ("p50_ms", "p99_ms")},
        }
        for row in rows
        if row["timer"] != "our ticker"
    ]


def section(result: report.Result) -> str:
    """One result in Markdown."""
    about, rows = result["about"], []
    for row in result["rows"]:
        lateness = [f"{row[name]:.3f}" for name in ("p50_ms", "p99_ms", "p99_9_ms", "max_ms")]
        gaps = [row["skipped"], f"{row['shortest_gap']:.2f}", row["bursts"]]
        rows.append([row["timer"], row["busy"], f"{row['hz']:g}", row["ticks"], *lateness, *gaps])
    heads = ["timer", "busy processes", "Hz", "ticks", "p50 ms", "p99 ms", "p99.9 ms", "max ms"]
    heads += ["skipped", "shortest gap / period", "gaps below half"]
    machine = f"{about['system']}, {about['cores']} cores, load average {about['load_average']:.1f} before"
    duration = f"{about['seconds']:g} s each, all at once on core {about['core']}"
    return "\n".join([f"{machine}; {duration}", "", *table(heads, rows)]).rstrip()


@click.command(help=__doc__)
@report.options("10 seconds each: less than a minute.")
@click.option(
    "--seconds", default=420.0, show_default=True, help="Duration with the free and with the busy core, each."
)
def main(json_file: Path | None, seconds: float, quick: bool) -> None:
    seconds = 10.0 if quick else seconds
    core = max(os.sched_getaffinity(0))
    about = report.about(seconds=seconds, core=core)
    rows = [row for busy_processes in (0, BUSY_PROCESSES) for row in measured(seconds, busy_processes, core)]
    result = {"about": about, "rows": rows, "ratios": ratios(rows)}
    report.publish(result, section, json_file)


if __name__ == "__main__":
    entry(main)()
