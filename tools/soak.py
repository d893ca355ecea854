"""`make soak`: an hour of the rig, with a fault of the failure matrix about once a minute.

The unmodified modsoft-runtime drives the emulated board, the fake tracker and the simulated robot at 2.5 Hz. The first
third injects transient faults only, so that one process runs for long; then all faults. Where a fault ends a run, the
next run starts on the same board. The report states whether every fault was detected and named, whether any valve had a
wrong value, whether memory grew, and whether the log is complete. `--seed` sets the order and the times of the faults.
With `--full-matrix`, the failure matrix with its full numbers follows (tools/reliability.py --full): hours.

Exit code 1 if a check failed.
"""

from __future__ import annotations

import math
import os
import statistics
import subprocess
import sys
from collections import defaultdict
from datetime import UTC, datetime
from pathlib import Path

import click

from modsoft.hil import shipped
from modsoft.hil.board.toolchain import build, choose
from modsoft.hil.post_fault_checks import InjectedFault, SoakRun
from modsoft.hil.record import board_description, firmware_sha256
from modsoft.hil.soak import Soak, SoakRig
from modsoft.runtime import log
from modsoft.runtime.control.model import Model
from modsoft.runtime.entry_point import entry
from modsoft.runtime.errors import LostInRun, UsageError
from modsoft.runtime.files import written

ROOT = Path(__file__).resolve().parents[1]
ROBOT, TASK = "pneumatic-3", "down"
GROWTH_MIB_PER_H = 4.0  # every tick adds its figures to the summary: 0.2 kB, 9,000 an hour
FULL_MATRIX = ["tools/reliability.py", "--full"]


def growth_mib_per_h(samples: list[tuple[float, float]]) -> float | None:
    """Slope of the resident memory after the first minute: the median of the slopes between samples of its two halves
    (Theil's incomplete method). None for less than five minutes."""
    kept = [(at_s, mib) for at_s, mib in samples if at_s >= 60.0 and math.isfinite(mib)]
    if not kept or kept[-1][0] - kept[0][0] < 240.0:
        return None
    half = len(kept) // 2
    slopes = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in zip(kept[:half], kept[-half:], strict=True)]
    return 3600.0 * statistics.median(slopes)


def fault_rows(faults: list[InjectedFault]) -> list[str]:
    """Table with a row for each kind of fault."""
    kinds: dict[str, list[InjectedFault]] = defaultdict(list)
    for each in faults:
        kinds[each.fault.name].append(each)
    rows = ["| row | fault | times | detected | worst | exit codes | message | checks passed |"]
    rows += ["| ---: | --- | ---: | --- | ---: | --- | --- | --- |"]
    for name, group in sorted(kinds.items(), key=lambda kind: (kind[1][0].fault.row, kind[0])):
        detected_ms = [each.detected_ms for each in group if each.detected_ms is not None]
        vented_ms = [each.vented_ms for each in group if each.vented_ms is not None]
        ended = [each for each in group if each.code is not None]
        counts = {"in the log": len(detected_ms), "by its end": len(ended)}
        detected = [f"{count} {how}" for how, count in counts.items() if count]
        worst = f"{max(detected_ms):.0f} ms" if detected_ms else ""
        if vented_ms:
            worst = f"valves at 0 after {max(vented_ms):.0f} ms"
        codes = ", ".join(sorted({str(each.code) for each in ended})) or "continued"
        message = next((each.message.removeprefix("modsoft-runtime: ")[:90] for each in ended), "")
        failures = sorted({failure for each in group for failure in each.failures})
        passed = "**no**: " + "; ".join(failures) if failures else "yes"
        cells = [str(group[0].fault.row), name, str(len(group)), ", ".join(detected), worst, codes, message, passed]
        rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return rows


def page(soak: Soak, about: dict[str, str]) -> tuple[str, bool]:
    """The report, and whether every check passed."""
    runs, faults = soak.runs, soak.faults
    longest = max(runs, key=lambda run: run.ticks)
    growth = growth_mib_per_h(longest.memory_mib)
    failed_runs = [f"run {run.number}: {failure}" for run in runs for failure in run.failures]
    failed_faults = [each for each in faults if each.failures]
    grew = growth is not None and growth > GROWTH_MIB_PER_H
    vents = [run.vented_ms for run in runs if run.vented_ms is not None and run.code != LostInRun.exit_code]
    stalled_s, seconds = 1e-3 * sum(run.stalled_ms for run in runs), sum(run.seconds for run in runs)
    lines = ["# Soak test", ""]
    lines += [f"- {name}: {value}" for name, value in about.items()]
    lines += [
        "",
        f"{sum(run.ticks for run in runs)} control ticks in {len(runs)} runs, {len(faults)} faults of "
        f"{len({each.fault.name for each in faults})} kinds.",
        "",
    ]
    lines += [
        f"- Every fault detected and named: {'yes' if not failed_faults else f'**no**, {len(failed_faults)} not'}.",
        f"- Valve outputs (timer registers) against the set-points of the log, at all times: at most "
        f"{max(run.above_counts for run in runs):.1f} counts of 4096 above, "
        f"{max(run.below_counts for run in runs):.1f} below, "
        f"{max(run.off_counts for run in runs):.1f} off once settled (1 is rounding).",
        f"- Every valve at 0 within {max(vents, default=math.nan):.0f} ms (board's clock) of the start of venting, in "
        "runs that had not lost the board.",
        f"- The emulated board stalled for {stalled_s:.1f} s of {seconds / 60:.0f} minutes, through other load of the "
        "machine.",
        f"- Every run passed its checks, with a complete log: {'yes' if not failed_runs else '**no**'}.",
        *(f"    - {failure}" for failure in failed_runs),
        "- Memory of the longest run: " + memory(longest, growth) + (" **Too much.**" if grew else ""),
        *(f"- Memory of the {name}, whole soak: {_range(mib)}" for name, mib in soak.helpers_mib.items()),
        "",
        *fault_rows(faults),
        "",
    ]
    return "\n".join(lines), not (failed_faults or failed_runs or grew)


def memory(run: SoakRun, growth: float | None) -> str:
    values = [mib for _, mib in run.memory_mib if math.isfinite(mib)]
    if not values:
        return "not measured."
    grown = "too short for a slope" if growth is None else f"{growth:+.2f} MiB an hour after its first minute"
    return f"{run.ticks} ticks, {values[0]:.1f} MiB at first, {values[-1]:.1f} MiB at last, {grown}."


def _range(mib: list[float]) -> str:
    values = [value for value in mib if math.isfinite(value)]
    return f"{values[0]:.1f} MiB at first, {values[-1]:.1f} at last." if values else "not measured."


@click.command("soak", help=__doc__, context_settings={"show_default": True})
@click.option("--minutes", default=60.0, type=click.FloatRange(min=0.1), help="Duration of the soak.")
@click.option("--every", "every_s", default=55.0, type=click.FloatRange(min=2.0), help="Seconds between two faults.")
@click.option("--seed", default=1, help="Of the order and the times of the faults.")
@click.option(
    "--model",
    type=click.Path(exists=True, dir_okay=False, path_type=Path),
    help="Controller of modsoft-export.  [default: the shipped one, else that of make demo]",
)
@click.option(
    "--out",
    default=ROOT / "build" / "soak",
    type=click.Path(file_okay=False, path_type=Path),
    show_default="build/soak",
    help="A new folder below it gets all traces and report.md.",
)
@click.option("--report", type=click.Path(dir_okay=False, path_type=Path), help="Write the report here too.")
@click.option("--full-matrix", is_flag=True, help="Then run the failure matrix with its full numbers: hours.")
def cli(
    minutes: float, every_s: float, seed: int, model: Path | None, out: Path, report: Path | None, full_matrix: bool
) -> int:
    model = model or shipped.model(ROBOT)
    Model.load(model)
    build(choose())
    began, load = datetime.now(UTC), os.getloadavg()[1]
    folder = out / f"{began:%Y%m%dT%H%M%SZ}"
    if folder.exists():
        raise UsageError(f"{folder} exists already; start the command again")
    folder.mkdir(parents=True)
    click.echo(f"{minutes:g} minutes, everything in {folder}")
    with SoakRig(ROBOT, folder) as rig:
        soak = Soak(rig, model, TASK, folder, minutes, seed, every_s)
        soak.run(print_fault)
        board = rig.board
    host = log.host()
    about = {
        "made by": f"`tools/soak.py --minutes {minutes:g} --every {every_s:g} --seed {seed}`, {began:%Y-%m-%d}",
        "on": f"{host['system']}, {host['cores']} cores",
        "load average": f"{load:.1f} before, {os.getloadavg()[1]:.1f} at the end"
        f"{'; at real-time priority' if os.sched_getscheduler(0) in (os.SCHED_FIFO, os.SCHED_RR) else ''}",
        "board": board_description(board.board),
        "firmware, SHA-256": firmware_sha256(board.board),
        "robot, task": f"{ROBOT}, {TASK}, repeated",
    }
    text, passed = page(soak, about)
    for path in [folder / "report.md", *([report] if report else [])]:
        with written(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
    click.echo(text)
    if full_matrix:
        passed &= subprocess.run([sys.executable, *FULL_MATRIX], cwd=ROOT, check=False).returncode == 0
    return 0 if passed else 1


def print_fault(injected: InjectedFault) -> None:
    """One line on the terminal for each fault."""
    result = "; ".join(injected.failures) or "ok"
    click.echo(f"{injected.at_s / 60:5.1f} min, run {injected.run}: {injected.fault.name}: {result}")
    sys.stdout.flush()


main = entry(cli)

if __name__ == "__main__":
    main()
