"""`modsoft-evaluate`: the paper's simulation study in one command, and its report again from its numbers."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import click

from modsoft.runtime.command import entry

STAGES = ("collect", "train", "export", "estimate", "fly", "floors", "measure", "figures", "report")


@click.group("modsoft-evaluate", context_settings={"show_default": True})
def cli() -> None:
    """The simulation study: how well networks estimate and control, beside the paper's numbers."""


@cli.command()
@click.option("--out", default="study", type=click.Path(path_type=Path, file_okay=False), help="Folder of the study.")
@click.option("--jobs", type=click.IntRange(1), help="Processes, of one thread each.  [default: cores]")
@click.option("--quick", is_flag=True, help="All of it in miniature, in a minute: to see that it works, no more.")
@click.option("--only", type=click.Choice(STAGES), help="One stage; what it needs must be there.")
def study(out: Path, jobs: int | None, quick: bool, only: str | None) -> None:
    """Collect, train, export and fly; write OUT/report.md, results.json, figures and every run.

    \b
    Example:
      modsoft-evaluate study --out study

    About four hours on two cores. Stopped or killed, the same command goes on where it was. Models that are in
    OUT/models already are kept if they were trained on the same data with the same settings, and refused if not.
    What stands in OUT/notes.md becomes part of the report.
    """
    # Before torch is loaded: by default its threads spin while they wait, and on a busy core that costs all speed.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from modsoft.study import figures, flights, floors, making, measure, plan, report
    from modsoft.study.folder import Folder
    from modsoft.training.backends import cores

    asked, folder, processes = plan.quick() if quick else plan.full(), Folder(out), jobs or cores()
    folder.make()
    stages: dict[str, Callable[[], None]] = {
        "collect": lambda: making.collect_all(asked, folder, processes),
        "train": lambda: making.train_all(asked, folder, processes),
        "export": lambda: making.export_all(asked, folder, processes),
        "estimate": lambda: making.estimate_all(asked, folder, processes),
        "fly": lambda: flights.fly_all(asked, folder, processes),
        "floors": lambda: floors.find_all(asked, folder, processes),
        "measure": lambda: measure.measure(asked, folder),
        "figures": lambda: figures.draw(asked, folder),
        "report": lambda: report.write(folder),
    }
    began_s = time.monotonic()
    for name, stage in stages.items():
        if only in (None, name):
            stage()
    click.echo(f"{folder.report if only is None else only}: {time.monotonic() - began_s:.0f} s")


@cli.command("report")
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False, exists=True))
def write_report(folder: Path) -> None:
    """Write FOLDER/report.md again, from its results.json and notes.md alone."""
    from modsoft.study import report
    from modsoft.study.folder import Folder

    report.write(Folder(folder))
    click.echo(Folder(folder).report)


main = entry(cli, goes_on=True)

if __name__ == "__main__":
    main()
