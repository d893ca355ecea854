"""`modsoft-train`: a model from a data set."""

from __future__ import annotations

import math
import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from modsoft.runtime.choices import NETWORKS
from modsoft.runtime.entry_point import entry, renamed_option
from modsoft.runtime.errors import UsageError
from modsoft.runtime.files import check_not_input, check_writable, target_of

if TYPE_CHECKING:
    from tqdm import tqdm

    from modsoft.training.fit import Progress

BAR = "{desc}: {percentage:3.0f}%|{bar}| {remaining} left{postfix}"


@click.command("modsoft-train", context_settings={"show_default": True})
@click.argument("data_files", metavar="DATASET...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--out", default="model.pt", type=click.Path(path_type=Path, dir_okay=False), help="Model to write.")
@click.option(
    "--network",
    default="bilstm",
    type=click.Choice(NETWORKS),
    help="bilstm works for any number of modules; lstm (one network for all modules) and module-lstm (one network for "
    "each module) only for that of the data.",
)
@click.option("--iterations", default=6000, type=click.IntRange(1), help="Steps of the optimizer.")
@click.option(
    "--minutes",
    type=click.FloatRange(min=0, min_open=True),
    help="Time limit; the run ends at the limit that is first.",
)
@click.option(
    "--target-percent",
    type=click.FloatRange(min=0, min_open=True),
    help="Validation error, percent of the actuation range: the run ends as soon as it is reached. A run that ends "
    "above it exits with 77.",
)
@click.option(
    "--batch",
    type=click.IntRange(1),
    help="Batch size: windows in a step.  [default: 64 cable, 128 pneumatic; 4 times as many on a GPU]",
)
@click.option("--learning-rate", default=3e-3, type=click.FloatRange(0, 1e6, min_open=True), help="Peak learning rate.")
@click.option(
    "--dropout", default=0.0, type=click.FloatRange(0, 1, max_open=True), help="Dropout probability between the layers."
)
@click.option(
    "--truncation-probability",
    type=click.FloatRange(0, 1),
    help="Probability that a step uses only the last modules, as a shorter robot; bilstm only.  "
    "[default: 0 cable, 0.4 pneumatic]",
)
@click.option(
    "--history", type=click.IntRange(1), help="Time steps T in the features.  [default: 5 cable, 10 pneumatic]"
)
@click.option(
    "--split",
    default="blocks",
    type=click.Choice(["blocks", "shuffled"]),
    help="Division into training, validation and test part. blocks: contiguous in time, without overlap. shuffled: "
    "single windows at random as in the paper; neighbouring windows overlap, so that the errors come out too small.",
)
@click.option("--seed", default=0, type=click.IntRange(0), help="Random seed; the same seed gives the same model.")
@click.option(
    "--precision",
    default="float32",
    type=click.Choice(["float32", "bfloat16"]),
    help="Number format of the network's products. bfloat16 is as accurate, and faster by half or more on processors "
    "with AMX.",
)
@click.option(
    "--device",
    default="auto",
    type=click.Choice(["auto", "cpu", "cuda"]),
    help="auto: a GPU where torch finds one, else the CPU.",
)
@click.option(
    "--threads",
    default=1,
    type=click.IntRange(1),
    help="CPU threads; more threads than idle cores are much slower than one.",
)
@renamed_option("--rate", "--learning-rate")
@renamed_option("--shorter", "--truncation-probability")
def cli(data_files: tuple[Path, ...], out: Path, **options: Any) -> None:
    """Train a network of the paper's Table S1, by default the bidirectional LSTM, on one or more data sets of
    modsoft-collect, all of the same robot.

    \b
    Example:
      modsoft-train dataset.h5 --out model.pt
      modsoft-train staged.h5 smooth.h5 --out model.pt

    After an interruption, the same command resumes from OUT.resume and ends with the same model. While one process
    trains OUT, a second one exits with 75. At the end the command prints the error of the estimated actuation on the
    test part, in percent of the actuation range.
    """
    for name, value in options.items():
        if isinstance(value, float) and not math.isfinite(value):
            raise UsageError(f"--{name.replace('_', '-')} {value}: expected a finite number")
    check_writable(out)
    check_not_input(out, *data_files)
    check_not_input((target := target_of(out)).with_name(f"{target.name}.resume"), *data_files)
    existed = out.exists()
    # Before torch is loaded: by default its threads spin while they wait, which on a busy core costs all speed.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    from tqdm import tqdm

    from modsoft.training import train
    from modsoft.training.data import dataset
    from modsoft.training.settings import settings_for

    data = [dataset.read(path) for path in data_files]
    settings = settings_for(data[0].robot.actuators.drive, options)
    with tqdm(total=100, desc="train", bar_format=BAR, disable=existed) as bar:
        checkpoint = train.train(data, out, settings, _Shown(bar, settings.batch))
    _print_result(checkpoint["provenance"], out, existed)


class _Shown:
    """Shows progress, samples a second, smoothed loss and best validation error in a progress bar."""

    def __init__(self, bar: tqdm, batch: int) -> None:
        self._bar, self._batch = bar, batch
        self._start_s = time.monotonic()
        self._first: int | None = None  # iterations before this process: they do not count for the speed
        self._loss = 0.0

    def __call__(self, progress: Progress) -> None:
        if self._first is None:
            self._first, self._loss = progress.iteration - 1, progress.loss
        self._loss = 0.98 * self._loss + 0.02 * progress.loss
        speed = (progress.iteration - self._first) * self._batch / (time.monotonic() - self._start_s)
        percent = progress.validation_percent
        best = f"{percent:.2f} %" if math.isfinite(percent) else "not yet known"
        self._bar.set_postfix_str(
            f"{speed:.0f} samples/s, loss {self._loss:.5f}, best validation {best}", refresh=False
        )
        self._bar.update(100 * min(progress.progress, 1.0) - self._bar.n)


def _print_result(provenance: dict[str, Any], out: Path, existed: bool) -> None:
    from modsoft.training.fit import PATIENCE

    errors = zip(provenance["errors_percent"], provenance["errors_std_percent"], strict=True)
    for module, (mean, std) in enumerate(errors, start=1):
        click.echo(f"module {module}: actuation estimation error {mean:.2f} +- {std:.2f} % of the actuation range")
    done, planned = provenance["iterations_done"], provenance["iterations"]
    iterations = f"{done} iterations"
    if done < planned and provenance.get("stopped_early"):
        iterations = f"stopped after {done} of {planned} iterations without improvement in {PATIENCE} checks,"
    click.echo(f"{out}: {'exists already, ' if existed else ''}{iterations} in {provenance['seconds']:.0f} s")


main = entry(cli, resumable=True)

if __name__ == "__main__":
    main()
