"""How far each module bends in the tasks of the cable robot: the paper's tables, and their like for other robots.

The supplement (S1 to S4) gives four and six modules. Its tables are alike when counted from the tip: the last modules
bend as far as a module can, those before them ever less, and however long the robot is the whole bend of task A stays
at 140 to 146 degrees; in task C the tip module bends back by what the others bend, so that the tip's orientation is
kept, and in task B by four to five times as much, so that its position nearly is. Other robots follow that: up to five
modules the table of four, above it that of six, counted from the tip; a longer robot repeats the base module. In A the
whole bend so becomes 95, 127, 152, 153 and 167 degrees for 2, 3, 5, 8 and 12 modules (each at v_z >= 0.625: two or
three modules cannot bend by 140); in B and C the modules that do not bend back are scaled to bend by what they do
together in the paper's robot (B), by what the tip module bends back (C).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modsoft.runtime.arrays import Array

PAPERS = (4, 6)
# Smallest v_z of each module, base first (A); v_z and amplitude (B); both (C).
SPIRAL_V_Z = {4: [0.975, 0.850, 0.725, 0.625], 6: [0.998, 0.995, 0.950, 0.850, 0.800, 0.650]}
CIRCLE_V_Z = {4: [0.998, 0.998, 0.996, 0.600], 6: [0.999, 0.999, 0.999, 0.998, 0.995, 0.708]}
CIRCLE_SIGN = {4: [1, 1, 1, -1], 6: [1, 1, 1, 1, -1, -1]}
BEND_V_Z = {4: [0.941, 0.998, 0.897, 0.650], 6: [0.999, 0.996, 0.985, 0.975, 0.925, 0.600]}
BEND_SIGN = {4: [1, 1, 1, -1], 6: [1, 1, 1, 1, 1, -1]}


@dataclass(frozen=True)
class Bend:
    """v_z (N,) and the sign (N,) of the direction of each module, base first."""

    v_z: Array
    sign: Array


def spiral(modules: int) -> Bend:
    """Task A: the smallest v_z, reached at the end."""
    return Bend(_from_the_tip(SPIRAL_V_Z, modules), np.ones(modules))


def circle(modules: int) -> Bend:
    """Task B: v_z of the whole task."""
    v_z, sign = _from_the_tip(CIRCLE_V_Z, modules), _from_the_tip(CIRCLE_SIGN, modules)
    papers = _papers(modules)
    whole_rad = np.arccos(CIRCLE_V_Z[papers])[np.array(CIRCLE_SIGN[papers]) > 0].sum()
    return Bend(v_z, sign) if modules in PAPERS else _scaled(v_z, sign, whole_rad)


def bend(modules: int) -> Bend:
    """Task C: the v_z that the turn is made at."""
    v_z, sign = _from_the_tip(BEND_V_Z, modules), _from_the_tip(BEND_SIGN, modules)
    return Bend(v_z, sign) if modules in PAPERS else _scaled(v_z, sign, np.arccos(v_z[-1]))


def _papers(modules: int) -> int:
    return 6 if modules >= 6 else 4


def _from_the_tip(table: dict[int, list[float]] | dict[int, list[int]], modules: int) -> Array:
    """The nearest table, cut at the base or with its base repeated, to (N,)."""
    row = np.array(table[_papers(modules)], dtype=np.float64)
    return np.concatenate([np.repeat(row[:1], max(0, modules - len(row))), row[-modules:]])


def _scaled(v_z: Array, sign: Array, whole_rad: float) -> Bend:
    """The angles of the modules that do not bend back scaled to sum up to `whole_rad`."""
    angle_rad = np.arccos(v_z)
    ahead = sign > 0
    angle_rad[ahead] *= whole_rad / angle_rad[ahead].sum()
    return Bend(np.where(ahead, np.cos(angle_rad), v_z), sign)
