"""Control error on the stepped rig: compiled firmware, valves, fake tracker with noise, simulated robot.

`python tools/bench/rig.py --robot pneumatic-3x3 --model tools/models/pneumatic-3x3.onnx --task circle`. The table shows
the mean and the standard deviation over the task of the angle between the desired and the true configuration of each
module, in degrees, base first, with the network alone and with the correction. The true configuration is that of the
simulated robot, without the noise of the tracker.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np
import report

from modsoft.hil import closed_loop
from modsoft.hil.polaris_device import Polaris
from modsoft.hil.stepped import SteppedRig
from modsoft.hil.tool_errors import ToolErrors
from modsoft.runtime import robot as robot_file
from modsoft.runtime.choices import CORRECTIONS
from modsoft.runtime.control import correction, tasks
from modsoft.runtime.control.controller import Controller
from modsoft.runtime.control.features import angle_between_deg
from modsoft.runtime.control.model import Model
from modsoft.runtime.entry_point import entry
from modsoft.study.cells import table
from modsoft.training.simulation.elastica import Arm
from modsoft.training.simulation.parameters import plant_of


def measured(name: str, file: Path, task: str, each: str, errors: ToolErrors, steps: int | None) -> dict[str, Any]:
    """Figures of one run. each: the correction; steps: of the task; None for all."""
    robot, model = robot_file.load(name), Model.load(file)
    model.check(robot)
    desired = tasks.load_task(task, robot)[:steps]
    with SteppedRig(robot, Arm(plant_of(robot), robot.modules), tracker=lambda now: Polaris(now, errors=errors)) as rig:
        motion = closed_loop.run(
            rig, lambda rest: Controller(robot, model, rest, correction.by_name(each, robot.modules)), desired
        )
    off_deg = angle_between_deg(motion.true_configuration[: len(desired)], desired)
    row = {"robot": name, "task": task, "steps": len(desired), "correction": each, "noise_deg": errors.noise_deg}
    mean, std = (np.round(values, 3).tolist() for values in (off_deg.mean(axis=0), off_deg.std(axis=0)))
    return {**row, "mean_deg": mean, "std_deg": std}


def section(result: report.Result) -> str:
    """One result in Markdown."""
    rows = []
    for row in result["rows"]:
        errors = ", ".join(f"{mean:.2f} ± {std:.2f}" for mean, std in zip(row["mean_deg"], row["std_deg"], strict=True))
        rows.append([row["robot"], row["task"], row["steps"], f"{row['noise_deg']:g}", row["correction"], errors])
    heads = ["robot", "task", "steps", "noise, degrees", "correction", "error of each module, base first, degrees"]
    return "\n".join(table(heads, rows)).rstrip()


@click.command(help=__doc__)
@click.option("--robot", default="pneumatic-3", metavar="FILE|NAME", help="Robot file, or a shipped robot.")
@click.option("--model", required=True, type=click.Path(path_type=Path), help="Controller, from modsoft-export.")
@click.option("--task", required=True, metavar="NAME|FILE", help="Task, as for modsoft-runtime.")
@click.option("--correction", "corrections", multiple=True, type=click.Choice(CORRECTIONS), help="Default: all.")
@click.option("--noise-deg", default=0.1, help="Noise of the tracker about each axis of a tool, and in mm along it.")
@click.option("--steps", type=click.IntRange(1), help="The first steps of the task.")
@click.option("--json", "json_file", type=click.Path(path_type=Path, dir_okay=False), help="Write the result here.")
def main(
    robot: str,
    model: Path,
    task: str,
    corrections: tuple[str, ...],
    noise_deg: float,
    steps: int | None,
    json_file: Path | None,
) -> None:
    errors = ToolErrors(noise_deg=noise_deg, noise_mm=noise_deg)
    rows = [measured(robot, model, task, each, errors, steps) for each in corrections or CORRECTIONS]
    report.publish({"about": report.about(), "rows": rows}, section, json_file)


if __name__ == "__main__":
    entry(main)()
