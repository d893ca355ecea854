"""Frames of a straight or planar robot, and robots with other limits."""

from __future__ import annotations

import numpy as np
from virtual_loop import ROBOT, planar_poses

from modsoft.runtime import robot as robot_file
from modsoft.runtime.robot import Robot
from modsoft.runtime.tracking.frame import TrackerFrame


def tracker_frame(number: int, at_s: float, angles=(0.0, 0.0, 0.0), **changes) -> TrackerFrame:
    """A frame without errors at 60 Hz, with `changes` of its fields."""
    poses = planar_poses(angles)
    parts = {"poses": poses, "valid": np.ones(len(poses), bool), "quality": np.full(len(poses), 0.1), "device_hz": 60.0}
    return TrackerFrame(number, at_s, **(parts | changes))


def in_space() -> Robot:
    """A robot of three modules that bend in every direction, with the limits and the period of pneumatic-3."""
    table = robot_file.load("cable-4").to_dict()
    table["robot"]["modules"] = ROBOT.modules
    table["loop"], table["limits"] = ROBOT.to_dict()["loop"], ROBOT.to_dict()["limits"]
    return robot_file.from_dict(table)


def with_limits(**limits) -> Robot:
    """pneumatic-3 with these limits."""
    table = ROBOT.to_dict()
    table["limits"].update(limits)
    return robot_file.from_dict(table)
