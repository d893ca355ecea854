"""The simulated robot, in real time and in a process of its own: valve duties in, tool poses and pressures out.

`python -m modsoft.hil.plant --robot FILE`. Standard input: one JSON line per change, `{"duty": [...]}`, the duty of
each valve channel in [0, 1]; its end ends the process. Standard output, one JSON line each:

    {"event": "ready"}                           the robot hangs at rest, time starts
    {"event": "state", "mono_ns", "t_s", ...}    every slice: `ValvesAndArm.state`; mono_ns is the CLOCK_MONOTONIC
                                                 time at which the state is due
    {"event": "summary", ...}                    slices, lateness

The valves are ideal: a duty is that share of the full-scale pressure (`Pneumatics`); null is a pin that floats
(`FilteredPins`). Lag and chamber belong to `modsoft.training`.
"""

from __future__ import annotations

import json
import math
import os
import select
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

import click
import numpy as np

from modsoft.hil.pneumatics import Pneumatics
from modsoft.runtime import robot as robot_file
from modsoft.runtime.arrays import Array
from modsoft.runtime.entry_point import entry
from modsoft.runtime.errors import RobotFileError
from modsoft.runtime.robot import Robot

SLICE_S = 0.02
# Pose of the base's tool in the tracker's frame: 1.4 m in front and turned, so that confused frames show.
_TURN_Z, _TURN_X = np.radians(35.0), np.radians(-100.0)
BASE_IN_TRACKER = np.eye(4)
BASE_IN_TRACKER[:3, :3] = np.array(
    [[1, 0, 0], [0, np.cos(_TURN_X), -np.sin(_TURN_X)], [0, np.sin(_TURN_X), np.cos(_TURN_X)]]
) @ np.array([[np.cos(_TURN_Z), -np.sin(_TURN_Z), 0], [np.sin(_TURN_Z), np.cos(_TURN_Z), 0], [0, 0, 1]])
BASE_IN_TRACKER[:3, 3] = [60.0, -110.0, -1400.0]  # mm


class PneumaticArm(Protocol):
    """The part of `modsoft.training.simulation.elastica.Arm` that the plant uses."""

    @property
    def configuration(self) -> Array: ...  # (N, 3)
    @property
    def positions(self) -> Array: ...  # (N, 3), m
    @property
    def directors(self) -> Array: ...  # (N, 3, 3), rows d1, d2, d3
    @property
    def pressures(self) -> Array: ...  # (N, n), bar, in the chambers
    def set_pressures(self, bar: Array) -> None: ...
    def advance(self, duration_s: float) -> None: ...


class FilteredPins:
    """Command at every valve, 0 to 1, behind the filter of its pin (docs/hardware.md: 1 kOhm, 10 uF).

    A driven pin sets the command to its duty. While a pin floats, the capacitor holds the command; a pull-down of
    10 kOhm discharges it.
    """

    TIME_CONSTANT_S = 11e3 * 10e-6

    def __init__(self, pull_downs: bool):
        self.command: Array = np.zeros(0)
        self._pull_downs = pull_downs

    def advance(self, duty: Array, duration_s: float) -> Array:
        """Command (channels,) after this time; duty (channels,), NaN where the pin floats."""
        if len(self.command) < len(duty):
            self.command = np.concatenate([self.command, np.zeros(len(duty) - len(self.command))])
        decay = math.exp(-duration_s / self.TIME_CONSTANT_S) if self._pull_downs else 1.0
        self.command = np.where(np.isnan(duty), self.command * decay, duty) if len(duty) else self.command
        return self.command


def tool_poses(positions: Array, directors: Array) -> Array:
    """Poses (N + 1, 4, 4) of the tools in the tracker's frame, base first: axes as columns, positions in mm.

    positions (N, 3), m, and directors (N, 3, 3), rows d1, d2, d3: module ends in the lab frame, which is the base's.
    """
    in_base = np.tile(np.eye(4), (len(positions) + 1, 1, 1))
    in_base[1:, :3, :3] = np.swapaxes(directors, -1, -2)
    in_base[1:, :3, 3] = 1000.0 * np.asarray(positions)
    return BASE_IN_TRACKER @ in_base


def load_robot(file_or_name: str | Path) -> Robot:
    """The robot file of a robot that the rig can run; `RobotFileError` for one without valves."""
    robot = robot_file.load(file_or_name)
    if robot.valve is None:
        raise RobotFileError(f"{file_or_name}: no [valve] in it, expected one; the rig runs robots with chambers")
    return robot


class ValvesAndArm:
    """The arm behind its valves: duties in, poses and readings of the pressure sensors out."""

    def __init__(self, robot: Robot, arm: PneumaticArm, pull_downs: bool = True, pneumatics: Pneumatics | None = None):
        """pneumatics: valves, hoses and sensors; those of the robot file by default."""
        self.pins = FilteredPins(pull_downs)
        self.robot = robot
        self.arm = arm
        self.pneumatics = pneumatics or Pneumatics.of(robot)
        self.time_s = 0.0
        self._outlets_bar = self.pneumatics.outlets_bar(np.zeros(0))

    def advance(self, duty: Array, duration_s: float) -> None:
        """Advances the arm with the duties (channels,) held; NaN: the pin floats."""
        self._outlets_bar = self.pneumatics.outlets_bar(self.pins.advance(duty, duration_s))
        shape = (self.robot.modules, len(self.robot.directions))
        self.arm.set_pressures(self.pneumatics.set_points_bar(self._outlets_bar, shape))
        self.arm.advance(duration_s)
        self.time_s += duration_s

    def channel_bar(self) -> dict[int, float]:
        """Reading of the pressure sensor of each valve channel in use, bar: the chamber's pressure."""
        chambers_bar = np.asarray(self.arm.pressures)
        channels = sorted(self.pneumatics.hoses)
        return {each: self.pneumatics.sensor_bar(each, self._outlets_bar, chambers_bar) for each in channels}

    def state(self) -> dict[str, Any]:
        """Plain values: time_s simulated, configuration (N, 3), pressure_bar (N, n), channel_bar {channel: bar},
        poses (N + 1, 4, 4) for the tracker."""
        return {
            "t_s": round(self.time_s, 6),
            "configuration": np.asarray(self.arm.configuration).tolist(),
            "pressure_bar": np.asarray(self.arm.pressures).tolist(),
            "channel_bar": self.channel_bar(),
            "poses": tool_poses(np.asarray(self.arm.positions), np.asarray(self.arm.directors)).tolist(),
        }


def run(
    plant: ValvesAndArm,
    duties: Iterator[Array | None],
    write: Callable[[dict[str, Any]], None],
    clock_ns: Callable[[], int] = time.monotonic_ns,
    sleep: Callable[[float], None] = time.sleep,
    slice_s: float = SLICE_S,
) -> None:
    """Advances the plant in slices with absolute deadlines until `duties` ends. `duties` yields the newest duties, or
    None if none arrived.

    A late slice is not skipped: the next ones follow without a pause until simulated time equals real time.
    """
    duty = np.zeros(0)
    slices = late = 0
    worst_ns = 0
    slice_ns = round(slice_s * 1e9)
    write({"event": "ready"})
    start_ns = clock_ns()
    for newest in duties:
        if newest is not None:
            duty = newest
        plant.advance(duty, slice_s)
        slices += 1
        deadline_ns = start_ns + slices * slice_ns
        left_ns = deadline_ns - clock_ns()
        if left_ns > 0:
            sleep(left_ns * 1e-9)
        lateness_ns = max(0, clock_ns() - deadline_ns)
        worst_ns = max(worst_ns, lateness_ns)
        late += lateness_ns > slice_ns
        write({"event": "state", "mono_ns": deadline_ns, "late_ms": lateness_ns * 1e-6, **plant.state()})
    write({"event": "summary", "slices": slices, "late_slices": int(late), "late_max_ms": worst_ns * 1e-6})


def duties_from(descriptor: int) -> Iterator[Array | None]:
    """Yields the newest duties in the pipe, None while it is empty; ends when the pipe is closed."""
    pending = b""
    while True:
        newest = None
        while select.select([descriptor], [], [], 0.0)[0]:
            chunk = os.read(descriptor, 65536)
            if not chunk:
                return
            *lines, pending = (pending + chunk).split(b"\n")
            if lines:
                newest = np.asarray(json.loads(lines[-1])["duty"], dtype=np.float64)
        yield newest


@click.command("modsoft-hil-plant")
@click.option("--robot", "file_or_name", required=True, type=Path, help="Robot file, or the name of a shipped robot.")
@click.option("--pull-downs/--no-pull-downs", default=True, help="Resistors of 10 kOhm from the valve pins to ground.")
def cli(file_or_name: Path, pull_downs: bool) -> None:
    """The simulated pneumatic robot in real time (started by modsoft-hil)."""
    from modsoft.training.simulation.elastica import Arm  # the simulator takes a second to import
    from modsoft.training.simulation.parameters import plant_of

    robot = load_robot(file_or_name)

    def write(line: dict[str, Any]) -> None:
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()

    arm = Arm(plant_of(robot), robot.modules)
    warm = ValvesAndArm(robot, arm)
    warm.advance(np.zeros(0), SLICE_S)  # compiles
    arm.reset()
    run(ValvesAndArm(robot, arm, pull_downs), duties_from(sys.stdin.fileno()), write)


main = entry(cli)

if __name__ == "__main__":
    main()
