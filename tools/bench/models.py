"""Closed-loop errors of the models of tools/models on the simulated robots that they control.

`python tools/bench/models.py`. The mean error of each module, base first: of the bending angle in degrees for planar
robots, of the unit vector in percent for others, with the network alone and with the correction.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import report

from modsoft.runtime import robot as robot_file
from modsoft.runtime.choices import CORRECTIONS
from modsoft.runtime.control import correction, tasks
from modsoft.runtime.control.model import Model
from modsoft.runtime.entry_point import entry
from modsoft.study.cells import table
from modsoft.training.simulation.fleet import simulated
from modsoft.training.simulation.rollout import ControllerSetup, angle_errors_deg, configuration_errors_percent, rollout

MODELS = report.ROOT / "tools" / "models"
# Model, robot and its tasks: those of the cable robot are out of reach of one that hangs.
CASES = [
    ("pneumatic-3", "pneumatic-3", ["edge", "down"]),
    ("pneumatic-3", "pneumatic-2", ["edge", "down"]),
    ("pneumatic-3x3", "pneumatic-3x3", ["circle"]),
    ("cable-4", "cable-4", ["A", "B", "C"]),
    ("cable-4", "cable-6", ["A", "B", "C"]),
]
QUICK_STEPS = 20


def measured(name: str, robot_name: str, names: list[str], steps: int | None) -> list[dict[str, Any]]:
    """A row for each task (`names`) and correction. steps: of each task; None for all."""
    robot, model = robot_file.load(robot_name), Model.load(MODELS / f"{name}.onnx")
    cases = [(task, each) for task in names for each in CORRECTIONS]
    setups = [
        ControllerSetup(
            robot,
            model.actuate,
            model.history,
            tasks.task(task, robot.motion, robot.modules)[:steps],
            correction.by_name(each, robot.modules),
        )
        for task, each in cases
    ]
    errors_of, unit = {
        "planar": (angle_errors_deg, "degrees"),
        "spatial": (configuration_errors_percent, "percent"),
    }[robot.motion]
    rows = []
    rollouts = rollout(simulated(robot, len(setups)), setups).robots()
    for (task, each), setup, motion in zip(cases, setups, rollouts, strict=True):
        mean = errors_of(motion.configuration, setup.desired).mean(axis=0)
        row = {"model": name, "robot": robot_name, "task": task, "correction": each, "unit": unit}
        rows.append({**row, "error": [round(float(value), 3) for value in mean]})
    return rows


def section(result: report.Result) -> str:
    """One result in Markdown."""
    rows = []
    for row in result["rows"]:
        errors = ", ".join(f"{value:.2f}" for value in row["error"])
        rows.append([row["model"], row["robot"], row["task"], row["correction"], f"{errors} {row['unit']}"])
    heads = ["model", "robot", "task", "correction", "mean error of each module, base first"]
    return "\n".join(table(heads, rows)).rstrip()


@click.command(help=__doc__)
@report.options(f"The first {QUICK_STEPS} steps of each task.")
def main(json_file: Path | None, quick: bool) -> None:
    steps = QUICK_STEPS if quick else None
    rows = [row for case in CASES for row in measured(*case, steps)]
    result = {"about": report.about(quick=quick), "rows": rows}
    report.publish(result, section, json_file)


if __name__ == "__main__":
    entry(main)()
