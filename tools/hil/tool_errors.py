"""Mounting errors and noise of the fake tracker's tools, from a seed: the same seed, the same errors."""

from __future__ import annotations

import functools
import math
import random
from typing import NamedTuple

from modsoft.hil.rotations import Pose, after, turn


class ToolErrors(NamedTuple):
    """Largest mounting errors of the module's tools, and the standard deviations of noise along each axis of every
    tool. The base's tool is mounted without error: its axes are those of the robot."""

    mounting_deg: float = 0.0
    mounting_mm: float = 0.0
    noise_deg: float = 0.0
    noise_mm: float = 0.0
    seed: int = 0

    def mounted(self, tool: int, pose: Pose) -> Pose:
        """The pose of a tool (0 is the base's) where its mounting holds it: turned and moved in a random direction."""
        if tool == 0 or not (self.mounting_deg or self.mounting_mm):
            return pose
        return after(pose, *_mounting(self.mounting_deg, self.mounting_mm, self.seed, tool))

    def measured(self, number: int, poses: list[Pose]) -> list[Pose]:
        """The poses in frame `number` of the device."""
        poses = [self.mounted(tool, pose) for tool, pose in enumerate(poses)]
        if not (self.noise_deg or self.noise_mm):
            return poses
        chance = random.Random(f"{self.seed}, frame {number}")

        def noise(deviation: float) -> list[float]:
            return [chance.gauss(0.0, deviation) for _ in range(3)]

        return [after(pose, _turn(noise(self.noise_deg)), noise(self.noise_mm)) for pose in poses]


NO_ERRORS = ToolErrors()


@functools.lru_cache(maxsize=256)
def _mounting(largest_deg: float, largest_mm: float, seed: int, tool: int) -> tuple[Pose, list[float]]:
    """Rotation (3, 3) and position in mm of a tool."""
    chance = random.Random(f"{seed}, tool {tool}")
    angle, distance = chance.uniform(0.0, largest_deg), chance.uniform(0.0, largest_mm)
    return _turn([angle * x for x in _direction(chance)]), [distance * x for x in _direction(chance)]


def _direction(chance: random.Random) -> list[float]:
    """A random unit vector."""
    vector = [chance.gauss(0.0, 1.0) for _ in range(3)]
    return [each / math.hypot(*vector) for each in vector]


def _turn(vector_deg: list[float]) -> Pose:
    """The rotation (3, 3) of a rotation vector."""
    angle = math.radians(math.hypot(*vector_deg))
    size = math.hypot(*vector_deg) or 1.0
    return turn([math.cos(angle / 2), *(math.sin(angle / 2) * each / size for each in vector_deg)])
