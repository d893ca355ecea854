"""Collects a data set on the stepped rig: compiled firmware, valves, fake tracker with noise, simulated robot.

`python -m modsoft.hil.collect --robot pneumatic-3 --out rig.h5`. All that `modsoft-collect --port` does, on one clock
that advances as fast as this machine allows; the data set says so (`source` rig, `clock` emulated).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from modsoft.hil.plant import PneumaticArm, load_robot
from modsoft.hil.polaris_device import Polaris
from modsoft.hil.stepped import SteppedRig
from modsoft.hil.tool_errors import NO_ERRORS, ToolErrors
from modsoft.runtime import robot as robot_file
from modsoft.runtime.calibration.use import UsedCalibration
from modsoft.runtime.devices import Devices
from modsoft.runtime.entry_point import entry
from modsoft.runtime.errors import RobotFileError
from modsoft.runtime.files import read_text
from modsoft.runtime.robot import Robot
from modsoft.training.data.dataset import Header
from modsoft.training.data.measure import Collection, Run, collect


def collect_on_rig(
    robot: Robot,
    out: Path,
    samples: int,
    strategy: str = "staged",
    seed: int = 0,
    steps: int = 300,
    errors: ToolErrors = NO_ERRORS,
    calibration: UsedCalibration | None = None,
    board: str = "native",
    arm: PneumaticArm | None = None,
    robot_text: str = "",
) -> tuple[Header, int]:
    """The data set `out` of at least `samples` control steps, and their number; see `measure.collect`.

    errors: of the tracker's tools; calibration: of their mounting. arm: the simulated robot at rest; by default
    PyElastica.
    """
    collection = Collection(robot, robot_text, out, samples, strategy, seed, steps, "rig", "emulated", errors._asdict())

    def drive(run: Run) -> None:
        simulated = arm
        if simulated is None:
            from modsoft.training.simulation.elastica import Arm  # the simulator takes a second to import
            from modsoft.training.simulation.parameters import plant_of

            simulated = Arm(plant_of(robot), robot.modules)
        with SteppedRig(robot, simulated, board, lambda now: Polaris(now, errors=errors)) as rig:
            devices = Devices(robot, rig.frames, rig.board, rig.clock, rig.wait, calibration)
            with devices.signals:
                devices.signals.hold()
                run(devices, calibration)

    return collect(collection, drive)


@click.command("modsoft-hil-collect", context_settings={"show_default": True})
@click.option("--robot", "file_or_name", default="pneumatic-3", help="Robot file, or a shipped robot with chambers.")
@click.option("--out", required=True, type=click.Path(path_type=Path, dir_okay=False), help="Data set to write (HDF5).")
@click.option("--samples", default=15000, type=click.IntRange(1), help="Number of control steps.")
@click.option("--strategy", default="staged", type=click.Choice(["staged", "random", "smooth"]))
@click.option("--seed", default=0, type=click.IntRange(0), help="Random seed of actions and noise.")
@click.option("--steps", default=300, type=click.IntRange(1), help="Control steps of an episode.")
@click.option(
    "--noise-deg", default=0.1, type=click.FloatRange(0, 10), help="Noise about each axis of a tool, degrees."
)
@click.option("--noise-mm", default=0.1, type=click.FloatRange(0, 10), help="Noise along each axis of a tool, mm.")
@click.option("--board", default="native", type=click.Choice(["native", "simavr"]), help="Emulated board.")
def cli(file_or_name: str, out: Path, samples: int, **options: Any) -> None:
    """Collect data on the stepped rig, faster than real time."""
    robot = load_robot(file_or_name)
    errors = ToolErrors(noise_deg=options.pop("noise_deg"), noise_mm=options.pop("noise_mm"), seed=options["seed"])
    path = Path(file_or_name)
    text = read_text(path, RobotFileError) if path.is_file() else robot_file.text_of(file_or_name)
    header, count = collect_on_rig(robot, out, samples, errors=errors, robot_text=text, **options)
    click.echo(f"{out}: {count} samples in {header.episodes} episodes")


main = entry(cli, resumable=True)

if __name__ == "__main__":
    main()
