"""Writes report.md of the study on the rig from results.json alone, and includes the notes that people wrote."""

from __future__ import annotations

from modsoft.runtime.files import written
from modsoft.study import report, results
from modsoft.study.paths import Folder
from modsoft.study.results import Results
from modsoft.study.rig import figures, tables
from modsoft.study.rig.plan import MODULES, MOUNTING_DEG, MOUNTING_MM, NOISE_DEG, NOISE_MM, TASKS

SIMULATED = f"""\
**The robot of these experiments is simulated.** The paper's section 3.3 is about a real pneumatic robot. Here the robot
is a rod in PyElastica whose parameters were chosen so that it reaches what the paper's robot reaches; valves and
chambers are two lags. The tracker is a fake Polaris with an error of {", ".join(f"{each:g}°" for each in NOISE_DEG)} \
(standard deviation about each axis) and {NOISE_MM:g} mm along each axis in every frame of every tool; the tools are
mounted with errors of up to {MOUNTING_DEG:g}° and {MOUNTING_MM:g} mm, which a calibration at rest removes. The firmware
is the project's own: its logic compiled for this machine in the stepped runs, the compiled image on an emulated
ATmega2560 in the runs in real time. What the numbers show is how well the data, the network and the control loop work
on a robot with such dynamics and such noise. They do not show that a real robot reaches the same."""

HOW_TO_READ = """\
Control errors are those of the true bending angle, in degrees: the simulated robot's at the start of control step k
against target k, not what the tracker measured. `0.12 ± 0.08 (0.11 to 0.13)`: mean and standard deviation over the
steps, both averaged over the runs, then the smallest and the largest mean of a run. Ratio: our error over the paper's.
The largest angle of the first module in `down` on two modules is 32.4°: the supplement prints 3.24, which contradicts
its own text. Targets, for the smallest noise: the paper's error for the network alone, half of it with the
correction. All numbers are in `results.json`; `tools/study/results.py` describes its fields."""

CLOCKS = """\
Stepped runs: the firmware, the robot, the tracker and the runtime's control loop share one clock, which advances only
while the loop waits. Runs in real time: the unmodified `modsoft-runtime`, as `modsoft-hil` starts it, on the emulated
board, the fake tracker and the simulated robot, each in a process of its own."""

FIGURES = """\
The figures have the numbers of the paper's. What its Figures S5 to S7 show is not known here: they are drawn like its
figures of the simulated robots (Figure 4, S3 and S4)."""


def write(folder: Folder) -> None:
    """Writes report.md; `ModelError` if there are no results."""
    stored = results.load(folder.results)
    text = "\n".join(lines(stored, report.notes_of(folder))) + "\n"
    with written(folder.report) as temporary:
        temporary.write_text(text, encoding="utf-8")


def lines(stored: Results, notes: str) -> list[str]:
    """The lines of the report."""
    records, about = stored.records, stored.about
    comparisons = {noise: tables.control(records, noise) for noise in NOISE_DEG}
    first = comparisons[NOISE_DEG[0]]
    text = ["# Section 3.3 on the emulated rig", "", SIMULATED, ""]
    text += [f"Written by `modsoft-evaluate rig`, version {about.code_version}."]
    if about.steps is not None:
        text += [f"**Short form: {about.steps} steps of each task, little data and training; no valid numbers.**"]
    text += [
        f"{first.met} of {first.met + len(first.missed)} targets are met"
        + ("." if not first.missed else "; the others are listed under [Missed targets](#missed-targets).")
    ]
    text += ["", HOW_TO_READ, "", "## Estimation of the actuation", "", *tables.estimation(records)]
    for noise, each in comparisons.items():
        text += [f"## Table 4, noise {noise:g}°", "", *each.lines]
    if first.missed:
        text += ["## Missed targets", "", *(f"- {line}" for line in first.missed), ""]
    text += [notes, ""] if notes else []
    text += ["## Clocks", "", CLOCKS, "", _clocks(stored), ""]
    text += ["## Figures", "", FIGURES, ""]
    for name, caption in figures.CAPTIONS.items():
        text += [f"![{caption}](figures/{name}.png)", "", f"*{caption}*", ""]
    return [*text, "## Data", "", *report.data_sets(about), "## Models", "", *report.models(about)]


def _clocks(stored: Results) -> str:
    """Which runs were in real time."""
    real = [each for each in stored.records if each.source == "real-time rig" and each.module == 1]
    names = [
        f"`{task}` on {modules} modules"
        for modules in MODULES
        for task in TASKS
        if any((each.task, each.modules) == (task, modules) for each in real)
    ]
    if not names:
        return "All runs are stepped."
    return f"In real time, one of the runs with correction at {NOISE_DEG[0]:g}°: {', '.join(names)}."
