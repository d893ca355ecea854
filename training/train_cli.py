"""`modsoft-train`: a model from a data set."""

from __future__ import annotations

import math
import os
import time
from pathlib import Path
from typing import Any

import click

from modsoft.runtime.choices import NETWORKS
from modsoft.runtime.entry_point import entry, renamed_option
from modsoft.runtime.errors import UsageError
from modsoft.runtime.files import check_not_input, check_writable, target_of


@click.command("modsoft-train", context_settings={"show_default": True})
@click.argument("data_files", metavar="DATASET...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--out", default="model.pt", type=click.Path(path_type=Path, dir_okay=False), help="Model to make.")
@click.option(
    "--network",
    default="bilstm",
    type=click.Choice(NETWORKS),
    help="bilstm serves any number of modules; lstm (all modules in one) and module-lstm (one each) only the data's.",
)
@click.option("--iterations", default=6000, type=click.IntRange(1), help="Steps of the optimiser.")
@click.option("--minutes", type=click.FloatRange(min=0, min_open=True), help="Time that ends the run if it is first.")
@click.option(
    "--target-percent",
    type=click.FloatRange(min=0, min_open=True),
    help="Validation error, percent of the actuation range, that ends the run once reached; a run that ends above "
    "it exits with 77.",
)
@click.option(
    "--batch",
    type=click.IntRange(1),
    help="Windows in a step.  [default: 64 cable, 128 pneumatic; 4 times as many on a GPU]",
)
@click.option("--learning-rate", default=3e-3, type=click.FloatRange(0, 1e6, min_open=True), help="Peak learning rate.")
@click.option("--dropout", default=0.0, type=click.FloatRange(0, 1, max_open=True), help="Between the layers.")
@click.option(
    "--truncation-probability",
    type=click.FloatRange(0, 1),
    help="Of a step that takes the last modules for a robot of their own; bilstm only.  "
    "[default: 0 cable, 0.4 pneumatic]",
)
@click.option("--history", type=click.IntRange(1), help="Time steps T.  [default: 5 cable, 10 pneumatic]")
@click.option(
    "--split",
    default="blocks",
    type=click.Choice(["blocks", "shuffled"]),
    help="blocks: contiguous in time, nothing shared. shuffled: as the paper did, which leaks.",
)
@click.option("--seed", default=0, type=click.IntRange(0), help="The same seed gives the same model.")
@click.option(
    "--precision",
    default="float32",
    type=click.Choice(["float32", "bfloat16"]),
    help="Of the network's products. bfloat16: as good, and faster on processors with AMX, by half or more.",
)
@click.option(
    "--device",
    default="auto",
    type=click.Choice(["auto", "cpu", "cuda"]),
    help="auto: a GPU where torch finds one, else the CPU.",
)
@click.option("--threads", default=1, type=click.IntRange(1), help="Cores; more than are free is far slower than one.")
@renamed_option("--rate", "--learning-rate")
@renamed_option("--shorter", "--truncation-probability")
def cli(data_files: tuple[Path, ...], out: Path, **options: Any) -> None:
    """Train a network of the paper's Table S1, by default the bidirectional LSTM, on one or more data sets of
    modsoft-collect, all of the same robot.

    \b
    Example:
      modsoft-train dataset.h5 --out model.pt
      modsoft-train staged.h5 smooth.h5 --out model.pt

    Stopped or killed, the same command goes on from OUT.resume and ends with the same model. While one works on OUT,
    another ends with 75. At the end it prints how far off the estimated actuation is on data never used, in percent of
    the actuation range.
    """
    for name, value in options.items():
        if isinstance(value, float) and not math.isfinite(value):
            raise UsageError(f"--{name.replace('_', '-')} {value}: expected a finite number")
    check_writable(out)
    check_not_input(out, *data_files)
    check_not_input((target := target_of(out)).with_name(f"{target.name}.resume"), *data_files)
    is_there = out.exists()
    # Before torch is loaded: by default its threads spin while they wait, and on a busy core that costs all speed.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    from tqdm import tqdm

    from modsoft.training import train
    from modsoft.training.data import dataset

    data = [dataset.read(path) for path in data_files]
    settings = train.settings_for(data[0].robot.kind, options)
    began_s, first, smooth = time.monotonic(), None, 0.0
    shown = "{desc}: {percentage:3.0f}%|{bar}| {remaining} left{postfix}"
    with tqdm(total=100, desc="train", bar_format=shown, disable=is_there) as bar:

        def progress(told: train.Progress) -> None:
            nonlocal first, smooth
            if first is None:  # what an earlier run did does not count into the rate
                first, smooth = told.iteration - 1, told.loss
            smooth = 0.98 * smooth + 0.02 * told.loss
            rate = (told.iteration - first) * settings.batch / (time.monotonic() - began_s)
            best = f"{told.validation_percent:.2f} %" if math.isfinite(told.validation_percent) else "not yet known"
            bar.set_postfix_str(f"{rate:.0f} samples/s, loss {smooth:.5f}, best validation {best}", refresh=False)
            bar.update(100 * min(told.share, 1.0) - bar.n)

        made = train.train(data, out, settings, progress)
    said = made["provenance"]
    for module, (mean, std) in enumerate(zip(said["errors_percent"], said["errors_std_percent"], strict=True), start=1):
        click.echo(f"module {module}: actuation estimated within {mean:.2f} +- {std:.2f} % of its range")
    done = said["iterations_done"]
    iterations = f"{done} iterations"
    if done < settings.iterations and said.get("stopped_early"):
        iterations = f"stopped after {done} of {settings.iterations} iterations, no better for {train.PATIENCE} checks,"
    click.echo(f"{out}: {'there already, ' if is_there else ''}{iterations} in {said['seconds']:.0f} s")


main = entry(cli, goes_on=True)

if __name__ == "__main__":
    main()
