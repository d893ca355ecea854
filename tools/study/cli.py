"""`modsoft-evaluate`: the paper's simulation study in one command, and its report again from its numbers."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import click

from modsoft.runtime.entry_point import Choice, entry
from modsoft.runtime.locks import locked

STAGES = ("collect", "train", "export", "estimate", "rollout", "oracle", "measure", "figures", "report")


@click.group("modsoft-evaluate", context_settings={"show_default": True})
def cli() -> None:
    """The simulation study: how well networks estimate and control, beside the paper's numbers."""


@cli.command()
@click.option("--out", default="study", type=click.Path(path_type=Path, file_okay=False), help="Folder of the study.")
@click.option("--jobs", type=click.IntRange(1), help="Processes, of one thread each.  [default: cores]")
@click.option("--quick", is_flag=True, help="All of it in miniature, in a minute: to see that it works, no more.")
@click.option(
    "--only",
    type=Choice(STAGES, {"fly": "rollout", "floors": "oracle"}),
    help="One stage; what it needs must be there.",
)
def study(out: Path, jobs: int | None, quick: bool, only: str | None) -> None:
    """Collect, train, export, control; write OUT/report.md, results.json, figures and every run.

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
    from modsoft.study import figures, measurements, oracle, plan, report, rollouts, stages
    from modsoft.study.paths import Folder
    from modsoft.training.data.backends import cores

    asked, folder, processes = plan.quick() if quick else plan.full(), Folder(out), jobs or cores()
    folder.check_own()
    folder.make()
    makers = (
        stages.collecting,
        stages.training,
        stages.exporting,
        stages.estimating,
        rollouts.rolling_out,
        oracle.finding,
    )
    writers: dict[str, Callable[[], None]] = {
        "measure": lambda: measurements.measure(asked, folder),
        "figures": lambda: figures.draw(asked, folder),
        "report": lambda: report.write(folder),
    }
    began_s = time.monotonic()
    with locked(out / "study.lock", out, "modsoft-evaluate study"):
        if only is None:
            expected = [make(asked, folder, processes) for make in makers]
            told = ", ".join(f"{stage.name} {_minutes(stage.expected_s(processes))}" for stage in expected)
            whole = _minutes(sum(stage.expected_s(processes) for stage in expected))
            where = f"with {processes} processes on as many free cores"
            click.echo(f"{out}: about {whole} to go {where} ({told})", err=True)
        for name, make in zip(STAGES, makers, strict=False):
            if only in (None, name):
                make(asked, folder, processes).run(processes)  # asked again: what is left depends on the stages before
        for name, write in writers.items():
            if only in (None, name):
                write()
    click.echo(f"{folder.report if only is None else only}: {_minutes(time.monotonic() - began_s)}")


def _minutes(seconds: float) -> str:
    return f"{seconds / 60:.0f} min" if seconds >= 60 else f"{seconds:.0f} s"


@cli.command("report")
@click.argument("folder", type=click.Path(path_type=Path, file_okay=False, exists=True))
@click.option("--to", type=click.Path(path_type=Path, file_okay=False), help="Folder to publish in.  [default: FOLDER]")
def write_report(folder: Path, to: Path | None) -> None:
    """Write the report of the study in FOLDER again, from its results.json alone.

    \b
    Example:
      modsoft-evaluate report study --to docs/study

    With --to, results.json and the figures are copied there first. The notes are those of the folder that is written
    to: TO/notes.md.
    """
    from modsoft.study import report
    from modsoft.study.paths import Folder

    written = Folder(folder if to is None else to)
    written.check_own()
    if to is not None:
        report.publish(Folder(folder), written)
    report.write(written)
    click.echo(written.report)


main = entry(cli, goes_on=True)

if __name__ == "__main__":
    main()
