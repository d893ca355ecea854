"""`modsoft-evaluate`: runs the paper's study, in simulation and on the emulated rig, or writes its report."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from modsoft.runtime.entry_point import Choice, entry
from modsoft.runtime.locks import locked

if TYPE_CHECKING:
    from modsoft.study.scheduler import Stage

STAGES = ("collect", "train", "export", "estimate", "rollout", "oracle", "measure", "figures", "report")
RIG_STAGES = (
    "calibrate",
    "collect",
    "train",
    "export",
    "estimate",
    "stepped",
    "real-time",
    "measure",
    "figures",
    "report",
)


@click.group("modsoft-evaluate", context_settings={"show_default": True})
def cli() -> None:
    """The paper's experiments: how well networks estimate and control, compared with the paper."""


def options(default_out: str, choice: Choice) -> Callable[[Any], Any]:
    """The options of a study."""

    def add(command: Any) -> Any:
        for option in (
            click.option("--only", type=choice, help="Run one stage; the files of the stages before must exist."),
            click.option(
                "--quick", is_flag=True, help="A miniature of the study, a minute long; its numbers have no meaning."
            ),
            click.option("--jobs", type=click.IntRange(1), help="Processes, of one thread each.  [default: cores]"),
            click.option(
                "--out",
                default=default_out,
                type=click.Path(path_type=Path, file_okay=False),
                help="Folder of the study.",
            ),
        ):
            command = option(command)
        return command

    return add


@cli.command()
@options("study", Choice(STAGES, {"fly": "rollout", "floors": "oracle"}))
def study(out: Path, jobs: int | None, quick: bool, only: str | None) -> None:
    """Collect data, train, export, control; write OUT/report.md, results.json, figures and every run.

    \b
    Example:
      modsoft-evaluate study --out study

    Takes about four hours on two cores. After a stop the same command resumes. Existing models in OUT/models are kept
    if they were trained on the same data with the same settings, and refused otherwise. The report includes
    OUT/notes.md.
    """
    _before_torch()
    from modsoft.study import figures, measurements, oracle, plan, report, rollouts, stages
    from modsoft.study.paths import Folder

    planned, folder = plan.quick() if quick else plan.full(), Folder(out)
    makers = {
        "collect": stages.collect_stage,
        "train": stages.train_stage,
        "export": stages.export_stage,
        "estimate": stages.estimate_stage,
        "rollout": rollouts.rollout_stage,
        "oracle": oracle.oracle_stage,
    }
    writers: dict[str, Callable[[], None]] = {
        "measure": lambda: measurements.measure(planned, folder),
        "figures": lambda: figures.draw(planned, folder),
        "report": lambda: report.write(folder),
    }
    _run("study", out, jobs, only, {name: _of(planned, folder, make) for name, make in makers.items()}, writers)


@cli.command()
@options("rig", Choice(RIG_STAGES, {}))
def rig(out: Path, jobs: int | None, quick: bool, only: str | None) -> None:
    """Section 3.3 on the emulated rig: collect through firmware, valves and tracker, train, control; Table 4.

    \b
    Example:
      modsoft-evaluate rig --out rig

    The robot is simulated. The command states the expected time at the start; after a stop it resumes, as study does.
    Run nothing else on the machine during the runs in real time. Linux only. The report includes OUT/notes.md.
    """
    _before_torch()
    from modsoft.hil.cli import check_system

    check_system()
    from modsoft.study import stages
    from modsoft.study.paths import Folder
    from modsoft.study.rig import figures, measurements, plan, report, runs
    from modsoft.study.rig import stages as rig_stages

    planned, folder = plan.quick() if quick else plan.full(), Folder(out)
    makers: dict[str, Any] = {
        "calibrate": rig_stages.calibrate_stage,
        "collect": rig_stages.collect_stage,
        "train": stages.train_stage,
        "export": stages.export_stage,
        "estimate": stages.estimate_stage,
        "stepped": runs.stepped_stage,
        "real-time": runs.real_time_stage,
    }
    writers: dict[str, Callable[[], None]] = {
        "measure": lambda: measurements.measure(planned, folder),
        "figures": lambda: figures.draw(planned, folder),
        "report": lambda: report.write(folder),
    }
    _run("rig", out, jobs, only, {name: _of(planned, folder, make) for name, make in makers.items()}, writers)


def _before_torch() -> None:
    """By default its threads spin while they wait, which slows all processes on a busy core."""
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("OMP_NUM_THREADS", "1")


def _of(planned: Any, folder: Any, make: Callable[[Any, Any, int], Stage]) -> Callable[[int], Stage]:
    """The stage of a plan, for a number of processes."""
    return lambda jobs: make(planned, folder, jobs)


def _run(
    command: str,
    out: Path,
    jobs: int | None,
    only: str | None,
    makers: dict[str, Callable[[int], Stage]],
    writers: dict[str, Callable[[], None]],
) -> None:
    """Runs all stages of a study, or one, and then its writers."""
    from modsoft.study.paths import Folder
    from modsoft.training.data.backends import cores

    folder, processes = Folder(out), jobs or cores()
    folder.check_own()
    folder.make()
    began_s = time.monotonic()
    with locked(out / "study.lock", out, f"modsoft-evaluate {command}"):
        if only is None:
            remaining = [make(processes) for make in makers.values()]
            expected_s = {stage.name: stage.expected_s(processes) for stage in remaining}
            by_stage = ", ".join(f"{name} {_minutes(seconds)}" for name, seconds in expected_s.items())
            total = _minutes(sum(expected_s.values()))
            click.echo(f"{out}: about {total} with {processes} processes on as many free cores ({by_stage})", err=True)
        for name, make in makers.items():
            if only in (None, name):
                make(processes).run(processes)  # its items depend on the stages before
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
    """Write the report of the study in FOLDER, in simulation or on the rig, from its results.json.

    \b
    Example:
      modsoft-evaluate report study --to docs/study

    With --to, results.json and the figures are copied there first, and the notes are those of TO/notes.md.
    """
    from modsoft.study import figures, report, results
    from modsoft.study.paths import Folder
    from modsoft.study.rig import figures as rig_figures
    from modsoft.study.rig import report as rig_report

    source, output = Folder(folder), Folder(folder if to is None else to)
    output.check_own()
    is_of_rig = any(each.table == "4" for each in results.load(source.results).records)
    if to is not None:
        report.publish(source, output, rig_figures.CAPTIONS if is_of_rig else figures.CAPTIONS)
    (rig_report if is_of_rig else report).write(output)
    click.echo(output.report)


main = entry(cli, resumable=True)

if __name__ == "__main__":
    main()
