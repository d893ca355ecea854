"""The rotation of the robot's frame from bends: how the base's tool is mounted.

At rest only rotations of tools against each other are seen. A module that bends without twist turns its end about an
axis across the robot: those of a planar robot are its y axis, those of a spatial one are all perpendicular to its z
axis. Seen from the base's tool, the axes of many bends give y, or z. What bends do not show is that of the tool: in the
plane of a planar robot, where it changes no angle, and about the z axis of a spatial one.
"""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.calibration import rotations
from modsoft.runtime.calibration.file import Calibration
from modsoft.runtime.calibration.mounting import Mounting
from modsoft.runtime.errors import Tripped

LEAST_BEND_DEG = 10.0  # root mean square, planar
LEAST_ACROSS_DEG = 5.0  # spatial: in the direction in which the modules bent least
LARGEST_SHARE = 0.3  # of the bends: rotation about an axis that no bend should have
TURN_LIMIT_DEG = 45.0  # of the base's tool


class Frame(NamedTuple):
    """rotation (3, 3): of the base's tool in the robot's frame. Root mean squares, degrees: `bend_deg` of the bends (in
    space: in the direction in which they were least), `off_deg` of their rotation about other axes."""

    rotation: Array
    bend_deg: float
    off_deg: float

    def __str__(self) -> str:
        return (
            f"the base's tool is turned by {rotations.angle_deg(self.rotation):.1f} degrees against the robot's frame; "
            f"bends of {self.bend_deg:.1f} degrees, {self.off_deg:.2f} degrees about other axes (root mean squares)"
        )


def frame_of(poses: Array, calibration: Calibration, planar: bool) -> Frame:
    """The robot's frame by the tools' poses (K, N + 1, 4, 4) while the modules bend. calibration: of the tools at rest;
    planar: whether the modules bend in one plane."""
    straight = msgspec.structs.replace(
        calibration, base=msgspec.structs.replace(calibration.base, rotation_deg=(0.0, 0.0, 0.0))
    )
    turns = Mounting(straight, poses.shape[1] - 1).corrected(poses)[..., :3, :3]
    bends = rotations.vector_deg(np.swapaxes(turns[:, :-1], -1, -2) @ turns[:, 1:]).reshape(-1, 3)
    squares, axes = np.linalg.eigh(bends.T @ bends / len(bends))  # ascending
    sizes = np.sqrt(np.maximum(squares, 0.0))
    x, y, z = np.eye(3)
    if planar:
        y = axes[:, 2] * np.sign(axes[1, 2] or 1.0)
        z = _unit(z - (z @ y) * y)
        x = np.cross(y, z)
        return Frame(np.array([x, y, z]), float(sizes[2]), float(np.hypot(sizes[0], sizes[1])))
    z = axes[:, 0] * np.sign(axes[2, 0] or 1.0)
    x = _unit(x - (x @ z) * z)
    return Frame(np.array([x, np.cross(z, x), z]), float(sizes[1]), float(sizes[0]))


def _unit(vector: Array) -> Array:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)  # none in a straight robot


def aligned(frame: Frame, calibration: Calibration, planar: bool, date: str) -> Calibration:
    """The calibration with the robot's frame. Raises `Tripped` for bends that do not show it."""
    least_deg = LEAST_BEND_DEG if planar else LEAST_ACROSS_DEG
    where = "in its plane" if planar else "in every direction"
    if frame.bend_deg < least_deg:
        raise Tripped(
            f"found bends of {frame.bend_deg:.1f} degrees (root mean square), expected at least {least_deg:g} {where}; "
            "bend every module further"
        )
    if frame.off_deg > LARGEST_SHARE * frame.bend_deg:
        kind = "planar" if planar else "spatial"
        raise Tripped(
            f"found bends of {frame.bend_deg:.1f} degrees, {frame.off_deg:.1f} of them about other axes, expected "
            f"at most {LARGEST_SHARE * frame.bend_deg:.1f} for a {kind} robot; bend it without twisting, {where}"
        )
    turned = rotations.angle_deg(frame.rotation)
    if turned > TURN_LIMIT_DEG:
        raise Tripped(
            f"the base's tool is turned by {turned:.0f} degrees against the robot's frame, expected at most "
            f"{TURN_LIMIT_DEG:g}; mount it with z from base to tip and x in the plane of a planar robot, then run "
            "modsoft-calibrate rest"
        )
    x, y, z = (round(float(each), 4) for each in rotations.vector_deg(frame.rotation))
    base = msgspec.structs.replace(
        calibration.base,
        rotation_deg=(x, y, z),
        rotation_date=date,
        rotation_residual_deg=round(frame.off_deg, 4),
    )
    return msgspec.structs.replace(calibration, base=base)
