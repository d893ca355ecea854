"""`make soak`: an hour of the rig, with a fault of the failure matrix about once a minute.

The unmodified modsoft-runtime drives the emulated board, the fake tracker and the simulated robot at 2.5 Hz. In the
first third come only faults that a run has to outlast, so that one process is watched for long; then any. Where a fault
ended the run, as it must, the next one is started on the same board. At the end: whether every fault was noticed and
named, whether any valve ever had a wrong value, whether memory grew, whether the log can be read. Faults and times are
drawn with `--seed`. Then, with `--proofs`, the failure matrix with its full numbers (tools/reliability.py --full), 10^8
corrupted frames and 10^6 on the emulated board among them: hours.

Exit code 1 where anything was not as it must be.
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
from modsoft.hil.board.emulator import build, choose
from modsoft.hil.post_fault_checks import Injected, Ran
from modsoft.hil.record import board_in_words, firmware_sha256
from modsoft.hil.soak import Soak, SoakRig
from modsoft.runtime import log
from modsoft.runtime.control.model import Model
from modsoft.runtime.entry_point import entry
from modsoft.runtime.errors import LostInRun, UsageError
from modsoft.runtime.files import written

ROOT = Path(__file__).resolve().parents[1]
ROBOT, TASK = "pneumatic-3", "down"
GROWTH_MIB_PER_H = 4.0  # every tick leaves its figures for the summary: 0.2 kB of it, 9,000 an hour
PROOFS = ["tools/reliability.py", "--full"]


def growth_mib_per_h(samples: list[tuple[float, float]]) -> float | None:
    """Resident memory over time, from the second minute on: Theil and Sen's slope. None for less than five minutes."""
    kept = [(at_s, mib) for at_s, mib in samples if at_s >= 60.0 and math.isfinite(mib)]
    if not kept or kept[-1][0] - kept[0][0] < 240.0:
        return None
    half = len(kept) // 2
    slopes = [(b[1] - a[1]) / (b[0] - a[0]) for a, b in zip(kept[:half], kept[-half:], strict=True)]
    return 3600.0 * statistics.median(slopes)


def fault_rows(faults: list[Injected]) -> list[str]:
    """One line for each kind of fault."""
    kinds: dict[str, list[Injected]] = defaultdict(list)
    for each in faults:
        kinds[each.fault.name].append(each)
    rows = ["| row | fault | times | noticed | worst | exit codes | words | as it must be |"]
    rows += ["| ---: | --- | ---: | --- | ---: | --- | --- | --- |"]
    for name, found in sorted(kinds.items(), key=lambda kind: (kind[1][0].fault.row, kind[0])):
        in_log = [each.noticed_ms for each in found if each.noticed_ms is not None]
        alone = [each.vented_ms for each in found if each.vented_ms is not None]
        ended = [each for each in found if each.code is not None]
        noticed = [f"{len(in_log)} in the log"] * bool(in_log) + [f"{len(ended)} by its end"] * bool(ended)
        worst = f"valves at 0 after {max(alone):.0f} ms" if alone else f"{max(in_log):.0f} ms" if in_log else ""
        codes = ", ".join(sorted({str(each.code) for each in ended})) or "went on"
        words = next((each.words.removeprefix("modsoft-runtime: ")[:90] for each in ended), "")
        wrong = sorted({word for each in found for word in each.wrong})
        verdict = "**no**: " + "; ".join(wrong) if wrong else "yes"
        cells = [str(found[0].fault.row), name, str(len(found)), ", ".join(noticed), worst, codes, words, verdict]
        rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return rows


def page(soak: Soak, about: dict[str, str]) -> tuple[str, bool]:
    """The report, and whether everything was as it must be."""
    runs, faults = soak.runs, soak.faults
    longest = max(runs, key=lambda ran: ran.ticks)
    growth = growth_mib_per_h(longest.memory_mib)
    wrong_runs = [f"run {ran.number}: {word}" for ran in runs for word in ran.wrong]
    wrong_faults = [each for each in faults if each.wrong]
    grew = growth is not None and growth > GROWTH_MIB_PER_H
    vents = [ran.vented_ms for ran in runs if ran.vented_ms is not None and ran.code != LostInRun.exit_code]
    stalled_s, seconds = 1e-3 * sum(ran.stalled_ms for ran in runs), sum(ran.seconds for ran in runs)
    lines = ["# The soak", ""]
    lines += [f"- {name}: {value}" for name, value in about.items()]
    lines += [
        "",
        f"{sum(ran.ticks for ran in runs)} control ticks in {len(runs)} runs, {len(faults)} faults of "
        f"{len({each.fault.name for each in faults})} kinds.",
        "",
    ]
    lines += [
        f"- Every fault noticed and named: {'yes' if not wrong_faults else f'**no**, {len(wrong_faults)} not'}.",
        f"- Valve outputs, by the timer registers, against the set-points of the log at all times: at most "
        f"{max(ran.over_counts for ran in runs):.1f} counts of 4096 above, {max(ran.under_counts for ran in runs):.1f} "
        f"below, {max(ran.off_counts for ran in runs):.1f} off once settled (1 is rounding).",
        f"- Every valve at 0 at most {max(vents, default=math.nan):.0f} ms of the board's clock after the runtime "
        f"began to vent, where it still had the board.",
        f"- The emulated board stood still for {stalled_s:.1f} s of {seconds / 60:.0f} minutes, while the machine was "
        "busy with other things.",
        f"- Every run and its log as it must be: {'yes' if not wrong_runs else '**no**'}.",
        *(f"    - {word}" for word in wrong_runs),
        "- Memory of the longest run: " + memory(longest, growth) + (" **Too much.**" if grew else ""),
        *(f"- Memory of the {name}, all the time: {_range(mib)}" for name, mib in soak.helpers_mib.items()),
        "",
        *fault_rows(faults),
        "",
    ]
    return "\n".join(lines), not (wrong_faults or wrong_runs or grew)


def memory(ran: Ran, growth: float | None) -> str:
    found = [mib for _, mib in ran.memory_mib if math.isfinite(mib)]
    if not found:
        return "not looked at."
    grown = "too short to say more" if growth is None else f"{growth:+.2f} MiB an hour after its first minute"
    return f"{ran.ticks} ticks, {found[0]:.1f} MiB at first, {found[-1]:.1f} MiB at last, {grown}."


def _range(mib: list[float]) -> str:
    found = [value for value in mib if math.isfinite(value)]
    return f"{found[0]:.1f} MiB at first, {found[-1]:.1f} at last." if found else "not looked at."


@click.command("soak", help=__doc__, context_settings={"show_default": True})
@click.option("--minutes", default=60.0, type=click.FloatRange(min=0.1), help="Of the rig.")
@click.option("--every", "every_s", default=55.0, type=click.FloatRange(min=2.0), help="Seconds between two faults.")
@click.option("--seed", default=1, help="Of the faults and their times.")
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
@click.option("--proofs", is_flag=True, help="Then the failure matrix with its full numbers: hours.")
def cli(
    minutes: float, every_s: float, seed: int, model: Path | None, out: Path, report: Path | None, proofs: bool
) -> int:
    model = model or shipped.model(ROBOT)
    Model.load(model)
    build(choose())
    began, load = datetime.now(UTC), os.getloadavg()[1]
    folder = out / f"{began:%Y%m%dT%H%M%SZ}"
    if folder.exists():
        raise UsageError(f"{folder} exists; start again")
    folder.mkdir(parents=True)
    click.echo(f"{minutes:g} minutes, everything in {folder}")
    with SoakRig(ROBOT, folder) as rig:
        soak = Soak(rig, model, TASK, folder, minutes, seed, every_s)
        soak.go(tell)
        board = rig.board
    host = log.host()
    about = {
        "made by": f"`tools/soak.py --minutes {minutes:g} --every {every_s:g} --seed {seed}`, {began:%Y-%m-%d}",
        "on": f"{host['system']}, {host['cores']} cores",
        "load average": f"{load:.1f} before, {os.getloadavg()[1]:.1f} at the end"
        f"{'; at real-time priority' if os.sched_getscheduler(0) in (os.SCHED_FIFO, os.SCHED_RR) else ''}",
        "board": board_in_words(board.board),
        "firmware, SHA-256": firmware_sha256(board.board),
        "robot, task": f"{ROBOT}, {TASK}, again and again",
    }
    text, good = page(soak, about)
    for path in [folder / "report.md", *([report] if report else [])]:
        with written(path) as new:
            new.write_text(text, encoding="utf-8")
    click.echo(text)
    proved = not proofs or subprocess.run([sys.executable, *PROOFS], cwd=ROOT, check=False).returncode == 0
    return 0 if good and proved else 1


def tell(each: Injected) -> None:
    """A line on the terminal as it goes."""
    word = "; ".join(each.wrong) or "ok"
    click.echo(f"{each.at_s / 60:5.1f} min, run {each.run}: {each.fault.name}: {word}")
    sys.stdout.flush()


main = entry(cli)

if __name__ == "__main__":
    main()
