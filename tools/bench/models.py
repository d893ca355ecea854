"""How well the models of tools/models drive the simulated robots that they are for, in closed loop.

The mean error of each module, base first: of the bending angle in degrees for pneumatic robots, of the unit vector in
percent for cable robots, with the network alone and with the correction. Nothing here is timed.
"""

from __future__ import annotations

import json
from pathlib import Path

import click

from modsoft.runtime import robot as robots
from modsoft.runtime.choices import CORRECTIONS
from modsoft.runtime.control import correction, tasks
from modsoft.runtime.control.model import Model
from modsoft.runtime.entry_point import entry
from modsoft.training.simulation.fleet import simulated
from modsoft.training.simulation.rollout import ControllerSetup, angle_errors_deg, configuration_errors_percent, rollout

MODELS = Path(__file__).resolve().parents[1] / "models"
FLOWN = [("pneumatic-3", "pneumatic-3"), ("pneumatic-3", "pneumatic-2"), ("cable-4", "cable-4"), ("cable-4", "cable-6")]
QUICK_STEPS = 20


def measure(model: str, name: str, steps: int | None) -> list[dict[str, object]]:
    """A row for each task and correction."""
    robot, controller = robots.load(name), Model.load(MODELS / f"{model}.onnx")
    kind = robot.kind
    flown = [(task, each) for task in tasks.available(kind, robot.modules) for each in CORRECTIONS]
    pilots = []
    for task, each in flown:
        desired = tasks.task(task, kind, robot.modules)[:steps]
        pilots.append(
            ControllerSetup(
                robot, controller.actuate, controller.history, desired, correction.by_name(each, robot.modules)
            )
        )
    errors = angle_errors_deg if kind == "pneumatic" else configuration_errors_percent
    rows: list[dict[str, object]] = []
    rollouts = rollout(simulated(kind, robot.modules, len(pilots)), pilots).robots()
    for (task, each), pilot, flight in zip(flown, pilots, rollouts, strict=True):
        mean = errors(flight.configuration, pilot.desired).mean(axis=0)
        unit = "degrees" if kind == "pneumatic" else "percent"
        rows.append(
            {
                "model": model,
                "robot": name,
                "task": task,
                "correction": each,
                "unit": unit,
                "error": [round(float(value), 3) for value in mean],
            }
        )
    return rows


@click.command()
@click.option("--json", "out", type=click.Path(path_type=Path, dir_okay=False), help="All figures as one object.")
@click.option("--quick", is_flag=True, help=f"The first {QUICK_STEPS} steps of each task.")
def main(out: Path | None, quick: bool) -> None:
    """Fly the models that ship on the robots that they are for."""
    rows = []
    click.echo("| model | robot | task | correction | mean error of each module, base first |\n" + "| --- " * 5 + "|")
    for model, name in FLOWN:
        for row in measure(model, name, QUICK_STEPS if quick else None):
            rows.append(row)
            told = ", ".join(f"{value:.2f}" for value in row["error"])
            click.echo(f"| {model} | {name} | {row['task']} | {row['correction']} | {told} {row['unit']} |")
    if out is not None:
        out.write_text(json.dumps({"quick": quick, "rows": rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    entry(main)()
