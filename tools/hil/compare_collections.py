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
from modsoft.runtime.errors import DeviceAbsent, LostInRun
from modsoft.runtime.files import make_folder
from modsoft.training.data import dataset
from modsoft.training.data.dataset import DataSet
from modsoft.training.data.recording import Plan, Runs

LARGEST_MEAN_DEG, LARGEST_P99_DEG = 0.1, 1.0
DEVICE_CODES = (DeviceAbsent.exit_code, LostInRun.exit_code)
MOST_STARTS = 50  # in real time: a busy computer loses a device, and the same command continues
MOST_LATE_MS = 100.0  # the simulated robot behind real time: a quarter of a period
START_S = 120.0  # for processes and devices to start, and to end


class Comparison(NamedTuple):
    """Of the steps in real time: angle between the configurations that a module reached, degrees."""

    steps: int
    starts: int
    other: int  # episodes whose actions are none of those on the stepped rig
    mean_deg: float
    p99_deg: float
    largest_deg: float

    @property
    def agrees(self) -> bool:
        """Whether the board applied the same actions and the robot reached the same configurations."""
        return not self.other and self.mean_deg <= LARGEST_MEAN_DEG and self.p99_deg <= LARGEST_P99_DEG

    def __str__(self) -> str:
        return (
            f"{self.steps} steps in real time, {self.starts} starts; episodes with other actions: {self.other}; "
            f"configurations differ by {self.mean_deg:.3f} degrees in the mean, {self.p99_deg:.3f} at the 99th "
            f"percentile, {self.largest_deg:.3f} at most"
        )


def compare(real: DataSet, stepped: DataSet, starts: int = 1) -> Comparison:
    """Compares each episode of `real` with that of `stepped` that has the same actions."""
    off_deg, other = [], 0
    for configuration, action, recorded in zip(real.configuration, real.action, real.recorded, strict=True):
        same = [index for index, each in enumerate(stepped.action) if np.array_equal(each[recorded], action[recorded])]
        if same:
            off_deg.append(angle_between_deg(configuration[1:], stepped.configuration[same[0], 1:])[recorded].ravel())
        else:
            other += 1
    angles = np.concatenate([*off_deg, [np.nan]] if not off_deg else off_deg)
    p99_deg = float(np.percentile(angles, 99, method="higher"))
    return Comparison(real.samples, starts, other, float(angles.mean()), p99_deg, float(angles.max()))


def run(robot_name: str, folder: Path, samples: int, steps: int, board: str = "auto") -> Comparison:
    """Collects at least `samples` control steps in both ways, in `folder`, and compares them."""
    robot = load_robot(robot_name)
    real, stepped = folder / "real.h5", folder / "stepped.h5"
    seconds = Plan.of(robot, 0, steps).ticks(-(-samples // steps)) * robot.loop.period_s
    options = ("--samples", str(samples), "--steps", str(steps))
    code, starts = DEVICE_CODES[0], 0
    with Rig(robot_name, folder / "rig", board) as rig:
        while code in DEVICE_CODES and starts < MOST_STARTS:
            rig.collect(real, *options)
            code, starts = rig.wait(2 * seconds + START_S), starts + 1
        if code != 0:
            raise LostInRun(f"modsoft-collect ended with {code} after {starts} starts: {rig.last_message()}")
        late_ms = max(state["late_ms"] for state in rig.plant_states)
    if late_ms > MOST_LATE_MS:
        raise LostInRun(
            f"the simulated robot was {late_ms:.0f} ms behind real time, expected at most {MOST_LATE_MS:g}: this "
            "computer is too busy, and nothing is compared; close other programs, start again in another folder"
        )
    episodes = Runs(real.with_name(f"{real.name}.runs"), robot).read().next_episode
    collect_on_rig(robot, stepped, episodes * steps, steps=steps)
    return compare(dataset.read(real), dataset.read(stepped), starts)


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
