"""The figures of the study on the rig, which correspond to the paper's Figures 9, 10, S5, S6 and S7."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

from modsoft.runtime.choices import CORRECTIONS
from modsoft.runtime.control.features import bending_angle_deg, bending_error_deg
from modsoft.study import results
from modsoft.study.figures import COLOURS, DPI, LABELS, draw_bars
from modsoft.study.paths import Folder
from modsoft.study.plan import Model
from modsoft.study.results import Record
from modsoft.study.rig import runs
from modsoft.study.rig.plan import NOISE_DEG, TASKS, RigPlan, Run, name_of
from modsoft.study.rig.tables import cells_of
from modsoft.training import plotting
from modsoft.training.data import coverage

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WORKSPACE = "figure-s5"
ANGLES = (
    "True bending angle of each module: desired (dashed), reached by the network alone and with the correction, all "
    f"runs, noise {NOISE_DEG[0]:g}°."
)
ERRORS = (
    "Left: mean error of the true bending angle of each module over runs and steps (bars; thin lines: standard "
    "deviation over the steps) and the paper's error. Right: the error of every step, mean over the modules, first "
    f"run. Noise {NOISE_DEG[0]:g}°."
)
CAPTIONS = {
    "figure-9": f"Figure 9. Three modules, tasks `edge` and `down`. {ANGLES}",
    "figure-10": f"Figure 10. Two modules, tasks `edge` and `down`, by the model trained on three. {ANGLES}",
    WORKSPACE: "Figure S5. Positions of the module ends in the collected data, at both noises of the tracker, from the "
    "side.",
    "figure-s6": f"Figure S6. Three modules. {ERRORS}",
    "figure-s7": f"Figure S7. Two modules. {ERRORS}",
}


def draw(plan: RigPlan, folder: Folder) -> None:
    """Writes all figures/*.png."""
    records = results.load(folder.results).records
    sets = coverage.compare([folder.data(name) for name in plan.noise_deg])
    coverage.draw(sets, folder.figures / f"{WORKSPACE}.png")
    figures = {
        "figure-9": partial(angles, plan, folder, 3),
        "figure-10": partial(angles, plan, folder, 2),
        "figure-s6": partial(errors, plan, folder, records, 3),
        "figure-s7": partial(errors, plan, folder, records, 2),
    }
    for name, draw_figure in figures.items():
        plotting.save(draw_figure, folder.figures / f"{name}.png", dpi=DPI)


def runs_of(plan: RigPlan, task: str, modules: int, correction: str) -> list[Run]:
    """The runs at the smallest noise, by their numbers."""
    model = Model("bilstm", name_of(NOISE_DEG[0]), "blocks", 0)
    of_cell = {"model": model, "task": task, "modules": modules, "correction": correction}
    return [
        run
        for run in plan.runs
        if isinstance(run, Run) and all(getattr(run, name) == value for name, value in of_cell.items())
    ]


def angles(plan: RigPlan, folder: Folder, modules: int) -> Figure:
    """Figures 9 and 10: a row of panels for each task, a column for each module."""
    figure = plotting.figure(1.2 + 3.0 * modules, 5.2)
    panels = figure.subplots(len(TASKS), modules, squeeze=False)
    for row, task in enumerate(TASKS):
        for correction in CORRECTIONS:
            for number, run in enumerate(runs_of(plan, task, modules, correction)):
                reached = bending_angle_deg(runs.read(folder.run(run)).true_configuration)
                label = LABELS[correction] if number == 0 else None
                for module in range(modules):
                    panels[row, module].plot(reached[:, module], color=COLOURS[correction], lw=1.0, label=label)
        desired = bending_angle_deg(runs.desired_of(plan, runs_of(plan, task, modules, "none")[0]))
        for module, panel in enumerate(panels[row]):
            panel.plot(desired[:, module], color="black", ls="--", lw=0.9, label="desired")
            panel.set_title(f"{task}, module {module + 1}", fontsize=9)
            panel.grid(alpha=0.3)
            panel.tick_params(labelsize=7)
        panels[row, 0].set_ylabel("bending angle, °", fontsize=9)
    for panel in panels[-1]:
        panel.set_xlabel("control step", fontsize=9)
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=9)
    return figure


def errors(plan: RigPlan, folder: Folder, records: Sequence[Record], modules: int) -> Figure:
    """Figures S6 and S7: for each task the errors by module as bars, and the error over the steps."""
    figure = plotting.figure(11.0, 5.6)
    panels = figure.subplots(len(TASKS), 2, squeeze=False, width_ratios=[1.0, 1.2])
    numbers = list(range(1, modules + 1))
    for row, task in enumerate(TASKS):
        cells = [cells_of(records, NOISE_DEG[0], task, modules, module) for module in numbers]
        named = {LABELS["paper"]: (COLOURS["paper"], [known for known, _ in cells])}
        for correction in CORRECTIONS:
            named[LABELS[correction]] = (COLOURS[correction], [ours[correction] for _, ours in cells])
        draw_bars(panels[row, 0], numbers, named)
        panels[row, 0].set(title=task, ylabel="error, °")
        for correction in CORRECTIONS:
            stored = runs.read(folder.run(runs_of(plan, task, modules, correction)[0]))
            of_steps = bending_error_deg(stored.true_configuration, stored.desired).mean(axis=1)
            panels[row, 1].plot(of_steps, color=COLOURS[correction], lw=1.0, label=LABELS[correction])
        panels[row, 1].set(title=task, ylabel="error, °")
        panels[row, 1].grid(alpha=0.3)
        panels[row, 1].legend(fontsize=7)
    panels[-1, 0].set_xlabel("module")
    panels[-1, 1].set_xlabel("control step")
    return figure
