"""`modsoft-collect`: a data set of a simulated robot, and pictures of the space that data sets cover."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from modsoft.runtime import robot as robot_file
from modsoft.runtime.choices import STRATEGIES
from modsoft.runtime.entry_point import entry, renamed_option
from modsoft.runtime.files import check_not_input, check_writable


@click.group(
    "modsoft-collect",
    context_settings={"show_default": True},
    invoke_without_command=True,
    subcommand_metavar="[plot DATASET... --out FILE.png]",
)
@click.option("--robot", "file_or_name", help="Robot file, or a shipped robot's name (pneumatic-3, ...).  [required]")
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), help="Data set to write (HDF5).  [required]")
@click.option(
    "--samples", default=15000, type=click.IntRange(1), help="Number of control steps, rounded up to whole episodes."
)
@click.option(
    "--strategy",
    default="staged",
    type=click.Choice(STRATEGIES),
    help="Kind of random actions. staged: all modules share one sequence at first, fewer of them in every stage, as in "
    "the paper. random: every module has its own. smooth: slow motion as in tasks. varied: smooth, on robots with "
    "other stiffness and payload.",
)
@click.option("--seed", default=0, type=click.IntRange(0), help="Random seed; the same seed gives the same data set.")
@click.option("--steps", default=300, type=click.IntRange(1), help="Control steps of an episode, which starts at rest.")
@click.option("--jobs", type=click.IntRange(1), help="Processes, cluster jobs or workers at a time.  [default: cores]")
@click.option(
    "--backend",
    default="local",
    type=click.Choice(["local", "submitit", "dask"]),
    help="local: processes of this machine. submitit: SLURM jobs (extra slurm). dask: its workers (extra dask).",
)
@click.option(
    "--backend-option",
    "options",
    multiple=True,
    metavar="NAME=VALUE",
    help="For submitit: slurm_partition=long, timeout_min=60, ... For dask: scheduler=ADDRESS, or cluster=SLURMCluster "
    "and its parameters (cores=1, memory=2GB, ...). dask runs all code that its ports receive: keep them off open "
    "networks, or use its TLS (security=true). May be repeated.",
)
@click.option("--simulator", help="Simulator: elastica, fleet-plain, fleet-avx2, ...  [default: the fastest here]")
@renamed_option("--plant", "--simulator")
@click.pass_context
def cli(
    context: click.Context,
    file_or_name: str | None,
    out: Path | None,
    samples: int,
    strategy: str,
    seed: int,
    steps: int,
    jobs: int | None,
    backend: str,
    options: tuple[str, ...],
    simulator: str | None,
) -> None:
    """Apply random actions to the simulated robot and record its configurations.

    \b
    Example:
      modsoft-collect --robot pneumatic-3 --samples 15000 --out dataset.h5

    After an interruption, the same command resumes from the finished episodes in OUT.parts; the data set is the same,
    bit for bit, as without the interruption. It does not depend on --jobs or --backend. On a cluster every worker needs
    the same installation and access to the folder of OUT. While one process collects OUT, a second one exits with 75.
    """
    if context.invoked_subcommand is not None:
        return
    if file_or_name is None or out is None:
        raise click.UsageError(f"missing option {'--out' if file_or_name else '--robot'}; see --help", context)
    check_not_input(out, Path(file_or_name))
    robot = robot_file.load(file_or_name)
    backend_options = dict(_option(text) for text in options)
    from tqdm import tqdm

    from modsoft.training.data.backends import cores
    from modsoft.training.data.collect import collect
    from modsoft.training.simulation import simulators

    chosen = simulators.fastest(robot) if simulator is None else simulators.by_name(simulator, robot)
    if simulator is None and chosen.name == "elastica":
        click.echo("the fast simulator is not built (no C compiler at installation?): PyElastica, slower", err=True)
    bar: tqdm | None = None

    def progress(done: int, total: int) -> None:
        nonlocal bar
        if bar is None:  # episodes of an earlier run do not count for the speed
            bar = tqdm(total=total, initial=done, unit=" samples", desc="collect", smoothing=0.1)
        bar.update(done - bar.n)

    try:
        header = collect(
            robot, out, samples, strategy, seed, steps, jobs or cores(), chosen, progress, backend, backend_options
        )
    finally:
        if bar is not None:
            bar.close()
    rejected = f"; {header.rejected} episodes diverged and were replaced" if header.rejected else ""
    note = f" ({samples} rounded up to whole episodes of {steps})" if header.samples != samples else ""
    click.echo(f"{out}: {header.samples} samples in {header.episodes} episodes{note}{rejected}")


def _option(text: str) -> tuple[str, Any]:
    """NAME=VALUE; the value is JSON (a number, a list) or else text."""
    name, separator, value = text.partition("=")
    if not (name and separator):
        raise click.UsageError(f"--backend-option {text}: expected NAME=VALUE")
    try:
        return name, json.loads(value)
    except ValueError:
        return name, value


@cli.command()
@click.argument("data_files", metavar="DATASET...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--out", required=True, type=click.Path(path_type=Path, dir_okay=False), help="Picture (PNG, PDF, SVG).")
def plot(data_files: tuple[Path, ...], out: Path) -> None:
    """Draw the positions of the module ends in data sets, side by side, and print how much space they cover.

    \b
    Example:
      modsoft-collect plot staged.h5 random.h5 --out workspace.png
    """
    check_writable(out)
    check_not_input(out, *data_files)
    from modsoft.training.data import coverage

    coverages = coverage.compare(list(data_files))
    coverage.draw(coverages, out)
    for each in coverages:
        click.echo(coverage.line(each))


main = entry(cli, resumable=True)

if __name__ == "__main__":
    main()
