"""The figures of the study, which correspond to the paper's Figures 4 to 8, S3 and S4."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from modsoft.runtime.choices import CORRECTIONS
from modsoft.study import paper, results, rollouts
from modsoft.study.cells import Cell, cell, pick
from modsoft.study.paths import Folder
from modsoft.study.plan import MAIN, TASKS, Model, Plan, Run
from modsoft.study.results import CONTROL, CONTROL_TABLES, ESTIMATION, Record
from modsoft.study.tables import CORRECTION_LABELS, modules_of, networks_and_data
from modsoft.training import plotting
from modsoft.training.data import coverage
from modsoft.training.simulation.rollout import configuration_errors_percent

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WORKSPACE = "figure-4"
PATHS = (
    "Components v_x and v_y of each module's configuration along tasks A, B and C: desired (dashed), reached by the "
    "network alone, and with the correction (seed {seed})."
)
ERRORS = (
    "Left: mean configuration error of each module over seeds and steps (bars; thin lines: standard deviation over the "
    "steps), the paper's error and the oracle error; task B without its first five steps. Right: the error of every "
    "step, mean over the modules, network alone and with the correction (seed {seed}). Errors on logarithmic scales."
)
CAPTIONS = {
    WORKSPACE: "Figure 4. Positions of the module ends in the staged and in the traditional data, the same number of "
    "samples of each, from the side and along the axis.",
    "figure-5": "Figure 5. Actuation estimation error of the networks, mean over the seeds; thin lines: standard "
    "deviation over the test windows.",
    "figure-6": "Figure 6. Four modules, LSTM. " + PATHS.format(seed=0),
    "figure-7": "Figure 7. Four modules, biLSTM on rich data. " + PATHS.format(seed=0),
    "figure-8": "Figure 8. Six modules, biLSTM trained on four. " + PATHS.format(seed=0),
    "figure-s3": "Figure S3. Four modules, biLSTM on rich data. " + ERRORS.format(seed=0),
    "figure-s4": "Figure S4. Six modules, biLSTM trained on four. " + ERRORS.format(seed=0),
}
COLOURS = {"paper": "#9a9a9a", "none": "#1f77b4", "integral": "#2ca02c", "oracle": "#d62728"}
LABELS = {"paper": "paper", **CORRECTION_LABELS, "oracle": "oracle error"}
DPI = 110
LOGARITHMIC = (0.01, 100.0)  # percent


def draw(plan: Plan, folder: Folder) -> None:
    """Writes all figures/*.png."""
    records = results.load(folder.results).records
    seed = plan.seeds[0]
    lstm, bilstm = Model("lstm", "paper", "blocks", seed), Model(*MAIN, "blocks", seed)
    coverage.draw(
        coverage.compare([folder.data("paper"), folder.data("traditional")]), folder.figures / f"{WORKSPACE}.png"
    )
    figures = {
        "figure-5": partial(estimation, records),
        "figure-6": partial(paths, folder, lstm, 4),
        "figure-7": partial(paths, folder, bilstm, 4),
        "figure-8": partial(paths, folder, bilstm, 6),
        "figure-s3": partial(errors, records, folder, bilstm, 4),
        "figure-s4": partial(errors, records, folder, bilstm, 6),
    }
    for name, draw_figure in figures.items():
        plotting.save(draw_figure, folder.figures / f"{name}.png", dpi=DPI)


def estimation(records: Sequence[Record]) -> Figure:
    """Figure 5: a panel for each network and data, a group of bars for each module."""
    figure = plotting.figure(10.0, 3.6)
    of_table = pick(records, table="1", quantity=ESTIMATION)
    ours = pick(of_table, source="study")
    kinds = networks_and_data(ours)
    panels = figure.subplots(1, len(kinds), squeeze=False)[0]
    for panel, (network, data) in zip(panels, kinds, strict=True):
        theirs = pick(of_table, source="paper", network=network)
        modules = modules_of(ours)
        of_kind = pick(ours, network=network, data=data)
        bars = {"paper (shuffled)": ("#9a9a9a", [cell(theirs, module=module) for module in modules])}
        for split, colour in (("shuffled", "#aec7e8"), ("blocks", "#1f77b4")):
            cells = [cell(of_kind, split=split, module=module) for module in modules]
            if any(cells):
                bars[split] = (colour, cells)
        draw_bars(panel, modules, bars)
        panel.set(title=f"{network}, {data} data", xlabel="module")
    panels[0].set_ylabel("estimation error, %")
    return figure


def draw_bars(panel: Axes, modules: list[int], bars: dict[str, tuple[str, list[Cell | None]]]) -> None:
    """A group of bars for each module; the thin line above a bar is its standard deviation."""
    width = 0.8 / len(bars)
    for place, (name, (colour, cells)) in enumerate(bars.items()):
        at = np.array(modules) + (place - (len(bars) - 1) / 2) * width
        means = np.array([each.mean if each else np.nan for each in cells])
        spread = np.array([each.std if each and each.std is not None else np.nan for each in cells])
        panel.bar(at, means, width, color=colour, label=name)
        panel.errorbar(at, means, [np.zeros_like(spread), spread], fmt="none", ecolor="#333333", lw=0.7)
    panel.set_xticks(modules)
    panel.grid(axis="y", alpha=0.3)
    panel.margins(y=0.3)
    panel.set_ylim(bottom=0.0)
    panel.legend(fontsize=7)


def paths(folder: Folder, model: Model, modules: int) -> Figure:
    """Figures 6 to 8: a row of panels for each task, a column for each module."""
    figure = plotting.figure(1.2 + 2.3 * modules, 7.4)
    panels = figure.subplots(len(TASKS), modules, squeeze=False)
    for row, task in enumerate(TASKS):
        runs = {each: rollouts.read(folder.run(Run(model, task, modules, each))) for each in CORRECTIONS}
        desired = runs["none"].desired
        for module in range(modules):
            panel = panels[row, module]
            for correction, run in runs.items():
                reached = run.rollout.configuration[: len(desired), module]
                panel.plot(*reached[:, :2].T, color=COLOURS[correction], lw=1.2, label=LABELS[correction])
            panel.plot(*desired[:, module, :2].T, color="black", ls="--", lw=0.9, label="desired")
            panel.set_aspect("equal", "datalim")
            panel.grid(alpha=0.3)
            panel.tick_params(labelsize=7)
            panel.locator_params(nbins=4)
            panel.set_title(f"task {task}, module {module + 1}", fontsize=9)
        panels[row, 0].set_ylabel("v_y", fontsize=9)
    for panel in panels[-1]:
        panel.set_xlabel("v_x", fontsize=9)
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=9)
    return figure


def errors(records: Sequence[Record], folder: Folder, model: Model, modules: int) -> Figure:
    """Figures S3 and S4: for each task the errors by module as bars, and the error over the steps."""
    figure = plotting.figure(11.0, 8.0)
    panels = figure.subplots(len(TASKS), 2, squeeze=False, width_ratios=[1.0, 1.2])
    of_table = pick(records, table=CONTROL_TABLES[modules], quantity=CONTROL, modules=modules)
    ours = pick(of_table, source="study", network=model.network, data=model.data)
    numbers = list(range(1, modules + 1))
    for row, task in enumerate(TASKS):
        of_task: dict[str, Any] = {"task": task, "skipped_steps": paper.skipped_steps(task)}
        sources = {"paper": pick(of_table, source="paper", network=model.network)}
        sources |= {correction: pick(ours, correction=correction) for correction in CORRECTIONS}
        sources["oracle"] = pick(of_table, source="oracle")
        bars = {}
        for name, selected in sources.items():
            cells = [cell(selected, module=module, **of_task) for module in numbers]
            if any(cells):
                bars[LABELS[name]] = (COLOURS[name], cells)
        draw_bars(panels[row, 0], numbers, bars)
        # On a linear axis the bars of the correction would be too small to see.
        panels[row, 0].set(title=f"task {task}", ylabel="configuration error, %", yscale="log", ylim=LOGARITHMIC)
        for correction in CORRECTIONS:
            run = rollouts.read(folder.run(Run(model, task, modules, correction)))
            of_steps = configuration_errors_percent(run.rollout.configuration, run.desired).mean(axis=1)
            panels[row, 1].plot(of_steps, color=COLOURS[correction], lw=1.0, label=LABELS[correction])
        panels[row, 1].set(yscale="log", title=f"task {task}")
        panels[row, 1].grid(alpha=0.3, which="both")
        panels[row, 1].legend(fontsize=7)
    panels[-1, 0].set_xlabel("module")
    panels[-1, 1].set_xlabel("control step")
    return figure
