"""`modsoft-collect`: a data set from the simulated robot, and pictures of what data sets cover."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from modsoft.runtime import robot as robots
from modsoft.runtime.choices import STRATEGIES
from modsoft.runtime.entry_point import entry, renamed_option
from modsoft.runtime.files import check_not_input, check_writable


@click.group(
    "modsoft-collect",
    context_settings={"show_default": True},
    invoke_without_command=True,
    subcommand_metavar="[plot DATASET... --out FILE.png]",
)
@click.option("--robot", "robot_file", help="Robot file, or a shipped robot's name (pneumatic-3, ...).  [required]")
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), help="Data set to make (HDF5).  [required]")
@click.option("--samples", default=15000, type=click.IntRange(1), help="Control steps at least, in all.")
@click.option(
    "--strategy",
    default="staged",
    type=click.Choice(STRATEGIES),
    help="staged: modules share one action sequence at first, fewer of them in every stage. random: each its own. "
    "smooth: actions that wander, as tasks move. varied: the same on robots of other stiffness and payload.",
)
@click.option("--seed", default=0, type=click.IntRange(0), help="The same seed gives the same data set.")
@click.option("--steps", default=300, type=click.IntRange(1), help="Control steps of an episode; each starts at rest.")
@click.option("--jobs", type=click.IntRange(1), help="Processes, cluster jobs or workers at a time.  [default: cores]")
@click.option(
    "--backend",
    default="local",
    type=click.Choice(["local", "submitit", "dask"]),
    help="local: processes here. submitit: SLURM jobs (extra slurm). dask: its workers (extra dask).",
)
@click.option(
    "--backend-option",
    "options",
    multiple=True,
    metavar="NAME=VALUE",
    help="For submitit: slurm_partition=long, timeout_min=60, ... For dask: scheduler=ADDRESS, or cluster=SLURMCluster "
    "and its parameters (cores=1, memory=2GB, ...); what its ports get is run, so keep them off open networks, or give "
    "dask's TLS (security=true). May be repeated.",
)
@click.option("--simulator", help="elastica, fleet-plain, fleet-avx2, ...  [default: the fastest here]")
@renamed_option("--plant", "--simulator")
@click.pass_context
def cli(
    context: click.Context,
    robot_file: str | None,
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
    """Drive the simulated robot with random actions and record what it does.

    \b
    Example:
      modsoft-collect --robot pneumatic-3 --samples 15000 --out dataset.h5

    Stopped or killed, the same command goes on where it was: whole episodes wait in OUT.parts, and the finished file
    is the same, bit for bit, as if nothing had happened. Neither --jobs nor --backend changes a number. On a cluster
    every worker needs the same installation and the folder of OUT. While one works on OUT, another ends with 75.
    """
    if context.invoked_subcommand is not None:
        return
    if robot_file is None or out is None:
        raise click.UsageError(f"missing option {'--out' if robot_file else '--robot'}; see --help", context)
    check_not_input(out, Path(robot_file))
    robot = robots.load(robot_file)
    given = dict(_option(text) for text in options)
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
        if bar is None:  # what an earlier run left does not count into the rate
            bar = tqdm(total=total, initial=done, unit=" samples", desc="collect", smoothing=0.1)
        bar.update(done - bar.n)

    try:
        made = collect(robot, out, samples, strategy, seed, steps, jobs or cores(), chosen, progress, backend, given)
    finally:
        if bar is not None:
            bar.close()
    lost = f"; {made.rejected} episodes diverged and were replaced" if made.rejected else ""
    rounded = f" ({samples} rounded up to whole episodes of {steps})" if made.samples != samples else ""
    click.echo(f"{out}: {made.samples} samples in {made.episodes} episodes{rounded}{lost}")


def _option(text: str) -> tuple[str, Any]:
    """NAME=VALUE; a value that is JSON (a number, a list) is taken as such, any other as text."""
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
    """Show where the module ends of data sets were, side by side, and how much space they cover.

    \b
    Example:
      modsoft-collect plot staged.h5 random.h5 --out workspace.png
    """
    check_writable(out)
    check_not_input(out, *data_files)
    from modsoft.training.data import coverage

    found = coverage.compare(list(data_files))
    coverage.draw(found, out)
    for each in found:
        click.echo(coverage.line(each))


main = entry(cli, resumable=True)

if __name__ == "__main__":
    main()
