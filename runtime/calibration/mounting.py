"""Corrects the tracker's poses for the mounting of its tools.

A tool that is mounted with the rotation M and the position t in the frame of a module's end is seen at the pose
(C M, c + C t), where (C, c) is that of the end. In a straight robot all ends have the rotation of the base, and lie at
equal distances on a line along its z axis; the calibration holds where the tools were seen then.
"""

from __future__ import annotations

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.calibration import rotations
from modsoft.runtime.calibration.file import Calibration
from modsoft.runtime.errors import Tripped

MOVED_LIMIT_DEG = 5.0  # a vented robot does not return to its rest exactly


class Mounting:
    """The mounting of the tools of a robot with `modules` modules. `in_ends` (N + 1, 4, 4): pose of each tool in the
    frame of its module's end, or of the base; mm."""

    def __init__(self, calibration: Calibration, modules: int):
        """Uses the first `modules` entries."""
        entries = calibration.modules[:modules]
        self.date = calibration.date
        self.dates = [entry.date for entry in (calibration.base, *entries)]
        base = rotations.matrix(np.array(calibration.base.rotation_deg))
        self.in_ends = np.tile(np.eye(4), (modules + 1, 1, 1))
        self.in_ends[0, :3, :3] = base
        self.in_ends[1:, :3, :3] = base @ rotations.matrix(np.array([entry.rotation_deg for entry in entries]))
        positions = np.array([entry.position_mm for entry in entries]) @ base.T
        self.in_ends[1:, :3, 3] = positions - straight_mm(positions)
        self._in_tools = np.linalg.inv(self.in_ends)

    def corrected(self, poses: Array) -> Array:
        """Poses (N + 1, 4, 4) of the base and the module ends from those of their tools."""
        return poses @ self._in_tools

    def check_rest(self, poses: Array) -> None:
        """Raises `Tripped` where the vented robot, by its tools' poses (N + 1, 4, 4), is not as at its calibration."""
        off_deg = turned_deg(self.corrected(poses))
        if off_deg.max() > MOVED_LIMIT_DEG:
            worst = int(np.argmax(off_deg > MOVED_LIMIT_DEG)) + 1  # the first: its tool is that of the next one's base
            raise Tripped(
                f"module {worst} hangs {off_deg[worst - 1]:.0f} degrees from where it hung at the calibration on "
                f"{self.dates[worst]}, expected at most {MOVED_LIMIT_DEG:g}: its tool has moved, or the robot does not "
                f"hang freely; look at it, then run modsoft-calibrate rest --module {worst}"
            )


def straight_mm(positions: Array) -> Array:
    """The positions (N, 3) that the straight robot should have by `positions` (N, 3), in the base's frame, mm: at equal
    distances on a line along z, by least squares."""
    expected = np.tile(positions.mean(axis=0), (len(positions), 1))
    if len(positions) > 1:
        expected[:, 2] = np.polyval(
            np.polyfit(np.arange(len(positions)), positions[:, 2], 1), np.arange(len(positions))
        )
    return expected


def turned_deg(poses: Array) -> Array:
    """Angle (N,) between the frames of each module's end and of the end before it, or the base, degrees."""
    return rotations.angle_deg(np.swapaxes(poses[:-1, :3, :3], -1, -2) @ poses[1:, :3, :3])
