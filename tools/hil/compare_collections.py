"""Collects the same data twice, in real time and on the stepped rig, and compares them.

`python -m modsoft.hil.compare_collections --minutes 10 --out compared/`. In real time, each part of the rig is a
process around the unmodified modsoft-collect, with the tracker's real client. Exit code 1 where the data differ.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import click
import numpy as np

from modsoft.hil.collect import collect_on_rig
from modsoft.hil.plant import load_robot
from modsoft.hil.rig import Rig
from modsoft.runtime.control.features import angle_between_deg
from modsoft.runtime.entry_point import entry
from modsoft.runtime.errors import LostInRun
from modsoft.runtime.files import make_folder
from modsoft.training.data import dataset
from modsoft.training.data.dataset import DataSet
from modsoft.training.data.recording import Plan

LARGEST_MEAN_DEG, LARGEST_P99_DEG = 0.3, 2.0
LEAST_SHARE = 0.9  # of the steps that are recorded in real time
START_S = 120.0  # for processes and devices to start, and to end


class Comparison(NamedTuple):
    """Of the steps that both data sets have: angle between the configurations of a module, degrees; difference of the
    actions."""

    steps: int
    recorded: int  # in real time
    action: float  # largest
    mean_deg: float
    p99_deg: float
    largest_deg: float

    @property
    def agrees(self) -> bool:
        """Whether the board applied the same actions and the robot was at the same configurations."""
        alike = self.mean_deg <= LARGEST_MEAN_DEG and self.p99_deg <= LARGEST_P99_DEG
        return alike and self.action == 0.0 and self.recorded >= LEAST_SHARE * self.steps

    def __str__(self) -> str:
        return (
            f"{self.recorded} of {self.steps} steps recorded in real time; actions differ by {self.action:g} at most; "
            f"configurations by {self.mean_deg:.3f} degrees in the mean, {self.p99_deg:.3f} at the 99th percentile, "
            f"{self.largest_deg:.3f} at most"
        )


def compare(real: DataSet, stepped: DataSet) -> Comparison:
    """Compares the first episodes of two data sets with the same actions."""
    episodes = min(len(real.action), len(stepped.action))
    both = real.recorded[:episodes] & stepped.recorded[:episodes]
    after = [data.configuration[:episodes, 1:][both] for data in (real, stepped)]
    off_deg = angle_between_deg(*after)
    action = np.abs(real.action[:episodes] - stepped.action[:episodes])[both].max(initial=0.0)
    p99_deg = np.percentile(off_deg, 99, method="higher")
    return Comparison(
        both.size, int(both.sum()), float(action), float(off_deg.mean()), float(p99_deg), float(off_deg.max())
    )


def run(robot_name: str, folder: Path, samples: int, steps: int, board: str = "auto") -> Comparison:
    """Collects `samples` control steps in both ways, in `folder`, and compares them."""
    robot = load_robot(robot_name)
    real, stepped = folder / "real.h5", folder / "stepped.h5"
    episodes = -(-samples // steps)
    seconds = Plan.of(robot, 0, steps).ticks(episodes) * robot.loop.period_s
    options = ("--samples", str(samples), "--steps", str(steps))
    with Rig(robot_name, folder / "rig", board) as rig:
        rig.collect(real, *options)
        code = rig.wait(2 * seconds + START_S)
        if code != 0:
            raise LostInRun(f"modsoft-collect ended with {code}: {rig.last_message()}")
    collect_on_rig(robot, stepped, samples, steps=steps)
    return compare(dataset.read(real), dataset.read(stepped))


@click.command("modsoft-hil-compare-collections", context_settings={"show_default": True})
@click.option("--robot", "robot_name", default="pneumatic-3", help="Robot file, or a shipped robot with chambers.")
@click.option("--out", required=True, type=click.Path(path_type=Path, file_okay=False), help="Folder of the data sets.")
@click.option("--minutes", default=10.0, type=click.FloatRange(0, min_open=True), help="Duration in real time.")
@click.option("--steps", default=300, type=click.IntRange(1), help="Control steps of an episode.")
@click.option("--board", default="auto", type=click.Choice(["auto", "simavr", "native"]), help="Emulated board.")
def cli(robot_name: str, out: Path, minutes: float, steps: int, board: str) -> int:
    """Compare a collection in real time with one on the stepped rig."""
    make_folder(out)
    samples = max(1, round(60 * minutes * load_robot(robot_name).loop.hz))
    comparison = run(robot_name, out, samples, steps, board)
    click.echo(str(comparison))
    return 0 if comparison.agrees else 1


main = entry(cli)

if __name__ == "__main__":
    main()
