"""Entries of the calibration file from tools that were measured at rest."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import msgspec
import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.calibration import rotations
from modsoft.runtime.calibration.file import Base, Calibration, Module, Rotation
from modsoft.runtime.calibration.measure import Tools, tool_name
from modsoft.runtime.calibration.mounting import Mounting
from modsoft.runtime.entry_point import printable
from modsoft.runtime.errors import Tripped

TILT_LIMIT_DEG = 25.0  # of a tool against the base's: each of the two may be mounted 10 degrees off
LINE_LIMIT_DEG = 15.0  # of the line through the module ends against the z axis of the base's tool
MOUNTING_MM = 5.0  # of a tool from its place
LINE_LIMIT_MM = 2.0 * MOUNTING_MM  # of a tool from the line through the module ends
MARKERS_MM = (15.0, 30.0, 60.0)  # between the markers of a tool
DIGITS = 4


class Measured(NamedTuple):
    """Tools at rest, and what identifies them. device: the tracker; names, sha256: of the definition files, base first;
    date: as in the file."""

    tools: Tools
    device: str
    names: Sequence[str]
    sha256: Sequence[str]
    date: str

    def noise(self, tool: int) -> dict[str, float]:
        """The fields of a `Tool` that say how well it was measured."""
        names = ("residual_deg", "residual_mm", "noise_deg", "noise_mm")
        return {name: round(float(getattr(self.tools, name)[tool]), DIGITS) for name in names}

    def entry(self, tool: int) -> dict[str, Any]:
        """All fields of a `Tool`."""
        about = {"date": self.date, "device": printable(self.device)[:200], "tool": printable(self.names[tool])[:200]}
        return {**about, "tool_sha256": self.sha256[tool], "frames": self.tools.frames, **self.noise(tool)}

    def module(self, number: int) -> Module:
        base, tools = self.tools.rotations[0], self.tools
        turn = rotations.vector_deg(base.T @ tools.rotations[number])
        position = base.T @ (tools.positions_mm[number] - tools.positions_mm[0])
        return Module(**self.entry(number), module=number, rotation_deg=_rounded(turn), position_mm=_rounded(position))

    @property
    def poses(self) -> Array:
        """(T, 4, 4)"""
        poses = np.tile(np.eye(4), (len(self.tools.rotations), 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = self.tools.rotations, self.tools.positions_mm
        return poses


def _rounded(vector: Array) -> Rotation:
    x, y, z = (round(float(each), DIGITS) for each in vector)
    return x, y, z


def calibrated(measured: Measured, robot: str, before: Calibration | None, only: Collection[int] = ()) -> Calibration:
    """The calibration of a robot that hangs straight. before: the calibration so far; only: the modules to calibrate,
    the others and the base keep their entries; empty: all. Raises `Tripped` for a robot that is not straight, or whose
    other modules do not hang as calibrated."""
    check_straight(measured.tools)
    modules = len(measured.tools.rotations) - 1
    if before is not None and only:
        base, entries = before.base, {entry.module: entry for entry in before.modules}
    else:
        turn = before.base.rotation_deg if before and before.base.tool_sha256 == measured.sha256[0] else (0.0, 0.0, 0.0)
        base, entries = Base(**measured.entry(0), rotation_deg=turn), {}
    entries |= {number: measured.module(number) for number in only or range(1, modules + 1)}
    sequence = tuple(entries[number] for number in sorted(entries))
    calibration = Calibration(schema=1, robot=robot, base=base, modules=sequence)
    Mounting(calibration, modules).check_rest(measured.poses)
    return calibration


def with_noise(measured: Measured, before: Calibration) -> Calibration:
    """The calibration with the noise and the residuals of this measurement."""
    base = msgspec.structs.replace(before.base, **measured.noise(0))
    count = len(measured.tools.rotations) - 1
    modules = [msgspec.structs.replace(entry, **measured.noise(entry.module)) for entry in before.modules[:count]]
    return msgspec.structs.replace(before, base=base, modules=(*modules, *before.modules[count:]))


def check_straight(tools: Tools) -> None:
    """Raises `Tripped` where the tools cannot be those of a straight robot, mounted with errors of up to 10 degrees and
    5 mm."""
    z = tools.rotations[0, :, 2]
    tilts = np.degrees(np.arccos(np.clip(tools.rotations[1:, :, 2] @ z, -1.0, 1.0)))
    advice = "let the vented robot hang straight, look at the tool, and run the command again"
    if tilts.max() > TILT_LIMIT_DEG:
        worst = int(np.argmax(tilts)) + 1
        raise Tripped(
            f"the tool of module {worst} is tilted by {tilts[worst - 1]:.0f} degrees against that of the base, "
            f"expected at most {TILT_LIMIT_DEG:g} in a straight robot; {advice}"
        )
    ends = tools.positions_mm[1:]
    behind = np.diff(ends @ z) <= 0.0
    if behind.any():
        first = int(np.argmax(behind)) + 1
        raise Tripped(
            f"the tool of module {first + 1} hangs behind that of module {first}, expected further along; give the "
            "tools in the order base, module 1, ... with z from base to tip"
        )
    line_deg, off_mm = _line(ends, z)
    limit_deg = LINE_LIMIT_DEG + np.degrees(np.arctan2(2 * MOUNTING_MM, np.linalg.norm(ends[-1] - ends[0])))
    if off_mm.max() > LINE_LIMIT_MM:
        worst = int(np.argmax(off_mm)) + 1
        raise Tripped(
            f"the tool of module {worst} is {off_mm[worst - 1]:.0f} mm off the line through the tools, expected at "
            f"most {LINE_LIMIT_MM:g} in a straight robot; {advice}"
        )
    if line_deg > limit_deg:
        raise Tripped(
            f"the line through the tools is {line_deg:.0f} degrees off the z axis of the base's tool, expected at most "
            f"{limit_deg:.0f}; turn the base's tool until its z axis is that of the robot, from base to tip"
        )


def _line(ends: Array, z: Array) -> tuple[float, Array]:
    """Angle between `z` and the line through `ends` (N, 3) in degrees; their distances (N,) from it."""
    centred = ends - ends.mean(axis=0)
    direction = np.linalg.svd(centred)[2][0]
    off = centred - np.outer(centred @ direction, direction)
    return float(np.degrees(np.arccos(min(1.0, abs(direction @ z))))), np.linalg.norm(off, axis=1)


def report(measured: Measured, calibration: Calibration | None = None) -> list[str]:
    """Lines for the operator: mounting, if calibrated, noise and residual of every tool; what marker noise costs."""
    tools = measured.tools
    lines = []
    mounting = None if calibration is None else Mounting(calibration, len(tools.rotations) - 1).in_ends
    for tool in range(len(tools.rotations)):
        text = f"{tool_name(tool)}: "
        if mounting is not None:
            turned, moved = rotations.angle_deg(mounting[tool, :3, :3]), np.linalg.norm(mounting[tool, :3, 3])
            text += f"mounted {turned:.1f} degrees and {moved:.1f} mm off, "
        lines.append(
            f"{text}noise {tools.noise_deg[tool]:.2f} degrees and {tools.noise_mm[tool]:.2f} mm, residual "
            f"{tools.residual_deg[tool]:.2f} degrees and {tools.residual_mm[tool]:.2f} mm"
        )
    worst = float(tools.noise_mm.max())
    costs = ", ".join(f"{np.degrees(worst / apart):.2f} at {apart:g} mm" for apart in MARKERS_MM)
    return [
        *lines,
        f"{worst:.2f} mm of marker noise cost this many degrees, by the distance of a tool's markers: {costs}",
    ]
