"""`modsoft-evaluate`: runs the paper's simulation study, or writes its report from its numbers."""

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
    """The simulation study: how well networks estimate and control, compared with the paper."""


@cli.command()
@click.option("--out", default="study", type=click.Path(path_type=Path, file_okay=False), help="Folder of the study.")
@click.option("--jobs", type=click.IntRange(1), help="Processes, of one thread each.  [default: cores]")
@click.option("--quick", is_flag=True, help="A miniature of the study, a minute long; its numbers have no meaning.")
@click.option(
    "--only",
    type=Choice(STAGES, {"fly": "rollout", "floors": "oracle"}),
    help="Run one stage; the files of the stages before must exist.",
)
def study(out: Path, jobs: int | None, quick: bool, only: str | None) -> None:
    """Collect data, train, export, control; write OUT/report.md, results.json, figures and every run.

    \b
    Example:
      modsoft-evaluate study --out study

    Takes about four hours on two cores. After a stop the same command resumes. Existing models in OUT/models are kept
    if they were trained on the same data with the same settings, and refused otherwise. The report includes
    OUT/notes.md.
    """
    # Before torch is loaded: by default its threads spin while they wait, which slows all processes on a busy core.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from modsoft.study import figures, measurements, oracle, plan, report, rollouts, stages
    from modsoft.study.paths import Folder
    from modsoft.training.data.backends import cores

    planned, folder, processes = plan.quick() if quick else plan.full(), Folder(out), jobs or cores()
    folder.check_own()
    folder.make()
    makers = (
        stages.collect_stage,
        stages.train_stage,
        stages.export_stage,
        stages.estimate_stage,
        rollouts.rollout_stage,
        oracle.oracle_stage,
    )
    writers: dict[str, Callable[[], None]] = {
        "measure": lambda: measurements.measure(planned, folder),
        "figures": lambda: figures.draw(planned, folder),
        "report": lambda: report.write(folder),
    }
    began_s = time.monotonic()
    with locked(out / "study.lock", out, "modsoft-evaluate study"):
        if only is None:
            remaining = [make(planned, folder, processes) for make in makers]
            expected_s = {stage.name: stage.expected_s(processes) for stage in remaining}
            by_stage = ", ".join(f"{name} {_minutes(seconds)}" for name, seconds in expected_s.items())
            total = _minutes(sum(expected_s.values()))
            click.echo(f"{out}: about {total} with {processes} processes on as many free cores ({by_stage})", err=True)
        for name, make in zip(STAGES, makers, strict=False):
            if only in (None, name):
                make(planned, folder, processes).run(processes)  # its items depend on the stages before
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
    """Write the report of the study in FOLDER from its results.json.

    \b
    Example:
      modsoft-evaluate report study --to docs/study

    With --to, results.json and the figures are copied there first, and the notes are those of TO/notes.md.
    """
    from modsoft.study import report
    from modsoft.study.paths import Folder

    output = Folder(folder if to is None else to)
    output.check_own()
    if to is not None:
        report.publish(Folder(folder), output)
    report.write(output)
    click.echo(output.report)


main = entry(cli, resumable=True)

if __name__ == "__main__":
    main()
