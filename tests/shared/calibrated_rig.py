"""Calibrations on simulated valves, hoses and sensors: directly, or through the runtime and the compiled firmware."""

from __future__ import annotations

import numpy as np
from bending_arm import BendingArm, rotation

from modsoft.hil.plant import ValvesAndArm, tool_poses
from modsoft.runtime import robot as robot_file
from modsoft.runtime.board.protocol import CHANNELS
from modsoft.runtime.calibration import procedure
from modsoft.runtime.calibration.schedule import PERIOD_S, ScheduledPressures
from modsoft.runtime.control.features import from_poses

PLANAR = robot_file.load("pneumatic-3")
SENSORS = range(6)  # as in firmware/pins.h


def spatial_robot(modules=3, directions=(0, 120, 240)):
    """A robot in space with chambers in these directions, on the channels 0, 1, ..."""
    head = robot_file.text_of("pneumatic-3").partition("[[chambers]]")[0].replace('"planar"', '"spatial"')
    head = head.replace('[simulation]\npreset = "pneumatic"', "").replace("[180, 0]", str(list(directions)))
    head = head.replace("modules = 3", f"modules = {modules}")
    chambers = [(module, direction) for module in range(1, modules + 1) for direction in directions]
    tables = [
        f"[[chambers]]\nmodule = {module}\ndirection_deg = {direction}\nchannel = {channel}\n"
        for channel, (module, direction) in enumerate(chambers)
    ]
    return robot_file.parse("\n".join([head.partition("# the chamber at 180")[0], *tables]))


def arm_of(robot):
    return BendingArm(robot.modules, robot.actuators.directions_deg)


def permute(pneumatics, order):
    """Connects the hose of channel order[k] to the valve of the k-th channel."""
    channels, hoses = sorted(pneumatics.hoses), dict(pneumatics.hoses)
    pneumatics.hoses = {channel: hoses[channels[k]] for channel, k in zip(channels, order, strict=True)}


class DirectRig:
    """Valves without a board: the rows of a plan reach them at once. Noise of every axis of every tool, degrees; tools
    are mounted with errors of up to `mounting_deg`, the base's without. `swapped`: two tools in each other's place."""

    def __init__(self, robot=PLANAR, noise_deg=0.0, mounting_deg=0.0, seed=0, sensors=SENSORS, swapped=None):
        self.robot, self.noise_deg, self.swapped = robot, noise_deg, swapped
        self.plant = ValvesAndArm(robot, arm_of(robot))
        self.pneumatics = self.plant.pneumatics
        self.sensors, self.chance = sensors, np.random.default_rng(seed)
        self.mounting = [np.eye(3)] + [self._turn(mounting_deg) for _ in range(robot.modules)]
        self.set_bar = np.zeros(CHANNELS)
        self.largest_bar = 0.0  # in any chamber
        self.time_s = 0.0
        self.on_row = lambda row: None  # called with every row

    def _turn(self, largest_deg):
        axis = self.chance.normal(size=3)
        return rotation(np.radians(self.chance.uniform(0.0, largest_deg)) * axis / np.linalg.norm(axis))

    def poses(self):
        poses = tool_poses(self.plant.arm.positions, self.plant.arm.directors)
        for pose, mounting in zip(poses, self.mounting, strict=True):
            pose[:3, :3] = pose[:3, :3] @ mounting @ rotation(np.radians(self.chance.normal(size=3) * self.noise_deg))
        if self.swapped:
            poses[list(self.swapped)] = poses[list(self.swapped)[::-1]]
        return poses

    def measured_bar(self):
        """Readings of the sensors, with the resolution of the converter."""
        readings = self.plant.channel_bar()
        bar = [readings.get(each, 0.0) if each in self.sensors else np.nan for each in range(CHANNELS)]
        return np.round(np.array(bar) * 1023) / 1023

    def measure(self, plan):
        """The samples of a plan."""
        poses = self.poses()
        control = ScheduledPressures(
            self.robot, plan.rows_bar, lambda: (poses[0], self.set_bar, self.measured_bar()), plan.watch
        )
        while control.row < len(plan.rows_bar):
            poses = self.poses()
            control.compute(from_poses(poses), np.zeros(0), np.zeros(0))
            self.on_row(control.row)
            self.set_bar = control.set_points_bar(control.applied)
            self.plant.advance(self.set_bar / self.robot.valve.full_scale_bar, PERIOD_S)
            self.largest_bar = max(self.largest_bar, float(np.max(self.plant.arm.set_bar)))
            self.time_s += PERIOD_S
        return control.samples

    def channels(self, chosen=None, pressure_bar=None):
        """`modsoft-calibrate channels` without its run."""
        chosen = tuple(sorted(each.channel for each in self.robot.chambers)) if chosen is None else chosen
        pressure_bar = pressure_bar or procedure.default_pressure_bar(self.robot)
        plan = procedure.plan_channels(self.robot, chosen, pressure_bar)
        return procedure.evaluate_channels(self.robot, plan, self.measure(plan))

    def valves(self):
        """`modsoft-calibrate valves` without its run."""
        plan = procedure.plan_valves(self.robot, tuple(self.sensors), "the board")
        return procedure.evaluate_valves(self.robot, plan, self.measure(plan))
