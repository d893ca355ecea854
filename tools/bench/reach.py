"""Reach of simulated robots: how far each module bends at the largest action, with the other modules at 0.

`python tools/bench/reach.py pneumatic-3 pneumatic-2`. The module is held at the largest action for `PERIODS` control
periods from rest, in each of `DIRECTIONS` directions, or in both directions of a plane. The table shows the smallest
bending angle of each module in degrees, base first.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np
import report

from modsoft.runtime import robot as robot_file
from modsoft.runtime.arrays import Array
from modsoft.runtime.control.actuation import module_actuators
from modsoft.runtime.entry_point import entry
from modsoft.runtime.robot import Robot
from modsoft.study.cells import table
from modsoft.training.simulation.fleet import simulated

DIRECTIONS = 12  # every 30 degrees
PERIODS = 4


def largest_actions(robot: Robot) -> Array:
    """The largest action (directions, A) that the actuators of a module can apply in each direction."""
    if robot.motion == "planar":
        return np.array([[1.0], [-1.0]])
    angles = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    unit = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    towards = 2.0 * unit  # longer than any action
    return np.clip(module_actuators(robot.directions).applied(towards), -1.0, 1.0)


def reach_deg(robot: Robot) -> Array:
    """Smallest bending angle (N,), degrees, that each module reaches alone in any direction."""
    alone = largest_actions(robot)
    actions = np.zeros((robot.modules, len(alone), robot.modules, robot.action_size))
    for module in range(robot.modules):
        actions[module, :, module] = alone
    flat = actions.reshape(-1, robot.modules, robot.action_size)
    robots = simulated(robot, len(flat))
    for _ in range(PERIODS):
        robots.step(flat, robot.loop.period_s)
    bent = np.degrees(np.arccos(np.clip(robots.configuration[..., 2], -1.0, 1.0)))
    own = bent.reshape(robot.modules, len(alone), robot.modules)
    return np.array([own[module, :, module].min() for module in range(robot.modules)])


def section(result: report.Result) -> str:
    """One result in Markdown."""
    rows = [[row["robot"], ", ".join(f"{angle:.1f}" for angle in row["reach_deg"])] for row in result["rows"]]
    return "\n".join(table(["robot", "reach of each module, base first, degrees"], rows)).rstrip()


@click.command(help=__doc__)
@click.argument("robots", nargs=-1, metavar="FILE|NAME...")
@click.option("--json", "json_file", type=click.Path(path_type=Path, dir_okay=False), help="Write the result here.")
def main(robots: tuple[str, ...], json_file: Path | None) -> None:
    rows: list[dict[str, Any]] = []
    for name in robots or robot_file.names():
        reached = reach_deg(robot_file.load(name))
        rows.append({"robot": name, "reach_deg": [round(float(angle), 2) for angle in reached]})
    report.publish({"about": report.about(), "rows": rows}, section, json_file)


if __name__ == "__main__":
    entry(main)()
