"""Writes report.md from results.json alone, and includes the notes that people wrote."""

from __future__ import annotations

import shutil
from collections.abc import Iterable

from modsoft.runtime.errors import ModelError
from modsoft.runtime.files import check_not_input, make_folder, read_text, written
from modsoft.study import figures, results, tables
from modsoft.study.cells import table
from modsoft.study.paths import Folder
from modsoft.study.results import About, Results

HOW_TO_READ = """\
Control errors are distances of the measured unit vector from the desired one, in percent of its length: the
configuration at the start of control step k against target k. Estimation errors are percent of the actuation range.
`0.97 ± 0.71 (0.91 to 1.03)`: mean and standard deviation over the steps (Table 1: over the windows of the test part),
both averaged over the seeds, then the smallest and the largest mean of a seed. Ratio: our error over the paper's.
Oracle error: the smallest error that any sequence of actions is known to reach, found by optimising the actions; it
is an upper bound of the optimum. Targets, set for the biLSTM on rich data: half of the paper's error for the network
alone; with correction a tenth of the paper's error or 1.1 times the oracle error, whichever is larger. Task B begins
with a jump from rest. The paper leaves the first steps out; here these are the first five, and a second table has all
steps. All numbers are in `results.json`; `tools/study/results.py` describes its fields."""

END_EFFECTOR = """\
Task B holds the end of the robot in place while the modules rotate, task C holds its orientation. The table has the
mean distance of the tip from the axis over the robot's length, and the mean angle between the tip's tangent and the
axis. The desired configurations themselves hold the end only approximately: the last column is the robot under the
actions of the oracle error."""

MODULES = """\
The biLSTM trained on four modules, on robots of other numbers of modules with tasks of the same shape. Mean over the
modules and seeds of the mean error in percent, and the worst module's; task B without its first five steps."""

ROBUSTNESS = """\
The biLSTM on rich data: errors of the true configuration in percent, mean over the modules and the worst module's;
task B without its first five steps. Noise: the orientation of every tool of the tracker, the base's included, has an
error of 0.5 degrees (standard deviation) about each axis at every step; the position error of 0.25 mm has no effect,
since the configuration does not depend on positions. Lost frames: one in ten at random; the last action is held.
Stiffness: each module 10 % stiffer or softer, at random. Payload: a point mass of one module's weight at the tip. The
seeds are those of the models. Part of the rich data is of robots with modules up to 15 % stiffer or softer and a
payload of up to four modules' weight, so the network has seen such robots in training, but neither noise nor lost
frames."""

DATA = """\
All data are of the simulated robot of four modules. Staged: in stage s = 0 to 3 the first 4 - s modules share one
sequence of uniform random actions. Random: every module has its own sequence, the traditional way. Smooth: sequences
that move from one random action to the next, with a little jitter. Varied: smooth sequences on robots of other
stiffness and payload. None of the data contain the tasks."""


def write(folder: Folder) -> None:
    """Writes report.md; `ModelError` if there are no results."""
    check_not_input(folder.report, folder.results, folder.notes)
    text = "\n".join(lines(results.load(folder.results), notes_of(folder))) + "\n"
    with written(folder.report) as temporary:
        temporary.write_text(text, encoding="utf-8")


def publish(study: Folder, to: Folder, names: Iterable[str] = figures.CAPTIONS) -> None:
    """Copies the results and the figures of these names of a study, without its data, models and runs."""
    results.load(study.results)
    make_folder(to.figures)
    pictures = [study.figures / f"{name}.png" for name in names]
    missing = [picture.name for picture in pictures if not picture.is_file()]
    if missing:
        raise ModelError(f"{study.figures}: no {', '.join(missing)}; --only figures draws them")
    for source, copy in [(study.results, to.results), *((each, to.figures / each.name) for each in pictures)]:
        with written(copy) as temporary:
            shutil.copyfile(source, temporary)


def notes_of(folder: Folder) -> str:
    return read_text(folder.notes).strip() if folder.notes.is_file() else ""


def lines(stored: Results, notes: str) -> list[str]:
    """The lines of the report."""
    records, about = stored.records, stored.about
    comparisons = {
        "Table 1: actuation estimation": tables.estimation(records),
        "Table 2: four modules": tables.control(records, "2", 4),
        "Table 3: six modules, with the model trained on four": tables.control(records, "3", 6),
    }
    met = sum(each.met for each in comparisons.values())
    missed = [line for each in comparisons.values() for line in each.missed]
    seeds = ", ".join(map(str, about.seeds))
    text = ["# The simulation study", ""]
    text += [f"Written by `modsoft-evaluate study`, version {about.code_version}, seeds {seeds}."]
    if about.steps is not None:
        text += [f"**Short form: {about.steps} steps of each task, little data and training; no valid numbers.**"]
    text += [
        f"{met} of {met + len(missed)} targets are met; the others are listed under [Missed targets](#missed-targets)."
    ]
    text += ["", HOW_TO_READ, ""]
    for title, each in comparisons.items():
        text += [f"## {title}", "", *each.lines]
    text += ["## Missed targets", "", *(f"- {line}" for line in missed), *([] if missed else ["None."]), ""]
    text += [notes, ""] if notes else []
    text += ["## The end effector", "", END_EFFECTOR, "", *tables.end_effector(records)]
    text += ["## Other numbers of modules", "", MODULES, "", *tables.module_numbers(records)]
    text += ["## Robustness", "", ROBUSTNESS, ""]
    for modules in (4, 6):
        text += [f"**{modules} modules**", "", *tables.robustness(records, modules)]
    text += ["## Figures", ""]
    for name, caption in figures.CAPTIONS.items():
        text += [f"![{caption}](figures/{name}.png)", "", f"*{caption}*", ""]
        if name == figures.WORKSPACE:
            text += [*tables.covered(records)]
    text += ["## Data", "", DATA, "", *data_sets(about)]
    return [*text, "## Models", "", *models(about)]


def data_sets(about: About) -> list[str]:
    rows = []
    for each in about.data:
        mixes = ", ".join(mix for mix, names in about.mixes.items() if each.name in names)
        rows.append([each.name, mixes, each.strategy, each.samples, each.steps, each.seed])
    return table(["data set", "part of", "strategy", "samples", "steps of an episode", "seed"], rows)


def models(about: About) -> list[str]:
    rows = []
    for each in about.models:
        settings = each.settings
        sizes = f"{settings.layers} x {settings.hidden}, T = {settings.history}, batch {settings.batch}"
        done = f"{each.iterations_done} of {settings.iterations}"
        rows.append([each.name, sizes, each.samples, done, f"{each.seconds / 60:.1f}"])
    return table(["model", "network", "samples", "iterations", "minutes"], rows)
