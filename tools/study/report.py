"""report.md out of results.json alone, with the notes that people wrote beside it."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from typing import Any

from modsoft.runtime.errors import ModelError
from modsoft.runtime.files import check_not_input, make_folder, read_text, written
from modsoft.study import figures, measurements, tables
from modsoft.study.cells import table
from modsoft.study.measurements import Record
from modsoft.study.paths import Folder

HOW_TO_READ = """\
Errors of control are distances of the reached unit vector from the desired one, in percent of its length, the
configuration at the start of control step k against target k; errors of estimation are percent of the actuation range.
`0.97 ± 0.71 (0.91 to 1.03)` is the mean and the standard deviation over the steps (Table 1: the windows of the test
part), both the mean over the seeds, and the smallest and the largest mean of a seed. Ratio: ours over the paper's.
Oracle error: the smallest error that any sequence of actions is known to reach, found by optimising the actions; the
true floor may be lower. Marks, set for the biLSTM on rich data: half of the paper's for the network alone; with
correction a tenth of the paper's, or 1.1 times the floor where that is more. Task B begins with a jump from rest: the
paper leaves the first steps out, here it is the first five, and the same over all steps stands below it."""

END_EFFECTOR = """\
Task B is meant to hold the end of the robot in place while the modules turn, task C to hold its orientation. Reported
are the mean distance of the tip from the axis over the robot's length, and the mean angle between the tip's tangent and
the axis. The desired configurations themselves hold the end only about so well: the last column is what the robot does
under the best actions known."""

MODULES = """\
The biLSTM trained on four modules, on robots of other numbers of modules with tasks of the same shape. Mean over the
modules and seeds of the mean error in percent, and the worst module's; task B without its first five steps."""

ROBUSTNESS = """\
The biLSTM on rich data, errors of the true configuration in percent, mean over the modules and the worst module's; task
B without its first five steps. Noise: the orientation of every tool of the tracker, the base's too, is off by 0.5
degrees (standard deviation) about each axis at every step; an error of 0.25 mm in their positions does not show, since
no configuration is made of positions. Lost frames: one in ten at random, on which the last action is held. Stiffness:
each module stiffer or softer by 10 %, at random. Payload: a point mass as heavy as a module at the tip. Seeded as the
models are. Part of the rich data is of robots whose modules are off by up to 15 % and that carry up to four modules'
weight, so that such robots are not unknown to the network; noise and lost frames are."""


DATA = """\
All of the simulated robot of four modules. Staged: in stage s = 0 to 3 the first 4 - s modules share one sequence of
uniform random actions; random: every module has its own, the traditional way. Smooth: sequences that wander from one
random action to the next, with a little jitter. Varied: the same on robots of other stiffness and payload. None of them
knows the tasks."""


def write(folder: Folder) -> None:
    """Writes report.md; `ModelError` where there are no results."""
    check_not_input(folder.report, folder.results, folder.notes)
    text = "\n".join(lines(measurements.load(folder.results), _notes(folder))) + "\n"
    with written(folder.report) as temporary:
        temporary.write_text(text, encoding="utf-8")


def publish(study: Folder, to: Folder) -> None:
    """Copies what people read of a study, its numbers and figures; runs, models and data stay where they are."""
    measurements.load(study.results)
    make_folder(to.figures)
    pictures = [study.figures / f"{name}.png" for name in figures.CAPTIONS]
    missing = [picture.name for picture in pictures if not picture.is_file()]
    if missing:
        raise ModelError(f"{study.figures}: no {', '.join(missing)}; modsoft-evaluate study --only figures draws them")
    for source, copy in [(study.results, to.results), *((each, to.figures / each.name) for each in pictures)]:
        with written(copy) as temporary:
            shutil.copyfile(source, temporary)


def _notes(folder: Folder) -> str:
    return read_text(folder.notes).strip() if folder.notes.is_file() else ""


def lines(found: dict[str, Any], notes: str) -> list[str]:
    """The report. found: as in results.json."""
    records: Sequence[Record] = found["records"]
    about = found["about"]
    told = {
        "Table 1: actuation estimation": tables.estimation(records),
        "Table 2: four modules": tables.control(records, "2", 4),
        "Table 3: six modules, by the model trained on four": tables.control(records, "3", 6),
    }
    met = sum(each.met for each in told.values())
    missed = [line for each in told.values() for line in each.missed]
    text = ["# The simulation study", ""]
    seeds = ", ".join(map(str, about["seeds"]))
    text += [f"Made by `modsoft-evaluate study`, version {about['code_version']}, seeds {seeds}."]
    if about["steps"] is not None:
        text += [f"**Short form: {about['steps']} steps of each task, little data, short training. It says nothing.**"]
    text += [f'{met} of {met + len(missed)} marks are met; those that are not stand under "Missed".', ""]
    text += [HOW_TO_READ, ""]
    for title, each in told.items():
        text += [f"## {title}", "", *each.lines]
    text += ["## Missed", "", *(f"- {line}" for line in missed), *([] if missed else ["Nothing."]), ""]
    if notes:
        text += [notes, ""]
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
    text += ["## Data", "", DATA, "", *_collected(about)]
    return [*text, "## What was trained", "", *_trained(about)]


def _collected(about: dict[str, Any]) -> list[str]:
    rows = []
    for each in about["data"]:
        used = ", ".join(mix for mix, names in about["mixes"].items() if each["name"] in names)
        rows.append([each["name"], used, each["strategy"], each["samples"], each["steps"], each["seed"]])
    return table(["data set", "part of", "strategy", "samples", "steps of an episode", "seed"], rows)


def _trained(about: dict[str, Any]) -> list[str]:
    rows = []
    for each in about["models"]:
        settings = each["settings"]
        sizes = f"{settings['layers']} x {settings['hidden']}, T = {settings['history']}, batch {settings['batch']}"
        done = f"{each['iterations_done']} of {settings['iterations']}"
        rows.append([each["model"], sizes, each["samples"], done, f"{each['seconds'] / 60:.1f}"])
    return table(["model", "network", "samples", "iterations", "minutes"], rows)
