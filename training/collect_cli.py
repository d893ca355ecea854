"""`modsoft-collect`: a data set from the simulated robot."""

from __future__ import annotations

import os
from pathlib import Path

import click

from modsoft.runtime import robot as robots
from modsoft.runtime.command import entry


@click.command("modsoft-collect", context_settings={"show_default": True})
@click.option("--robot", "robot_file", required=True, help="Robot file, or a shipped robot's name (pneumatic-3, ...).")
@click.option("--out", required=True, type=click.Path(path_type=Path, dir_okay=False), help="Data set to make (HDF5).")
@click.option("--samples", default=15000, type=click.IntRange(1), help="Control steps at least, in all.")
@click.option(
    "--strategy",
    default="staged",
    type=click.Choice(["staged", "random"]),
    help="staged: modules share one action sequence at first, fewer of them in every stage. random: each its own.",
)
@click.option("--seed", default=0, type=click.IntRange(0), help="The same seed gives the same data set.")
@click.option("--steps", default=300, type=click.IntRange(1), help="Control steps of an episode; each starts at rest.")
@click.option("--jobs", default=os.cpu_count() or 1, type=click.IntRange(1), help="Processes, a core each.")
def cli(robot_file: str, out: Path, samples: int, strategy: str, seed: int, steps: int, jobs: int) -> None:
    """Drive the simulated robot with random actions and record what it does.

    \b
    Example:
      modsoft-collect --robot pneumatic-3 --samples 15000 --out dataset.h5

    Stopped or killed, the same command goes on where it was: whole episodes wait in OUT.parts, and the finished file
    is the same, bit for bit, as if nothing had happened.
    """
    robot = robots.load(robot_file)
    from tqdm import tqdm

    from modsoft.training import plants
    from modsoft.training.collect import collect

    plant = plants.fastest(robot)
    if plant.name == "elastica":
        click.echo("the fast plant is not built (no C compiler at installation?): PyElastica, slower", err=True)
    bar: tqdm | None = None

    def progress(done: int, total: int) -> None:
        nonlocal bar
        if bar is None:  # what an earlier run left does not count into the rate
            bar = tqdm(total=total, initial=done, unit=" samples", desc="collect", smoothing=0.1)
        bar.update(done - bar.n)

    try:
        data = collect(robot, out, samples, strategy, seed, steps, jobs, plant, progress)
    finally:
        if bar is not None:
            bar.close()
    again = f", {data.redrawn} of them drawn again" if data.redrawn else ""
    click.echo(f"{out}: {data.samples} samples in {len(data.action)} episodes{again}")


main = entry(cli)

if __name__ == "__main__":
    main()
