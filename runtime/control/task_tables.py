"""Bending of each module in the tasks of the cable robot: the paper's tables, and tables for other robots.

The supplement (S1 to S4) lists four and six modules. Counted from the tip, its tables have the same pattern. The last
modules bend to their limit and those before them less; the angles of task A sum up to 140 to 146 degrees. In task C
the tip module bends back by the sum of the others, which keeps the orientation of the tip. In task B it bends back by
four to five times as much, which nearly keeps its position.

Other robots take the table of four modules (up to N = 5) or of six (above), counted from the tip; a longer robot
repeats the base module. The angles of task A then sum up to 95, 127, 152, 153 and 167 degrees for 2, 3, 5, 8 and 12
modules (with v_z >= 0.625, two or three modules cannot reach 140). In B and C the angles of the modules that do not
bend back are scaled: in B to their sum in the paper's robot, in C to the angle of the tip module.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modsoft.runtime.arrays import Array

PAPER_MODULES = (4, 6)
# Of each module, base first: smallest v_z (A), v_z and direction (B, C).
SPIRAL_V_Z = {4: [0.975, 0.850, 0.725, 0.625], 6: [0.998, 0.995, 0.950, 0.850, 0.800, 0.650]}
CIRCLE_V_Z = {4: [0.998, 0.998, 0.996, 0.600], 6: [0.999, 0.999, 0.999, 0.998, 0.995, 0.708]}
CIRCLE_SIGN = {4: [1, 1, 1, -1], 6: [1, 1, 1, 1, -1, -1]}
BEND_V_Z = {4: [0.941, 0.998, 0.897, 0.650], 6: [0.999, 0.996, 0.985, 0.975, 0.925, 0.600]}
BEND_SIGN = {4: [1, 1, 1, -1], 6: [1, 1, 1, 1, 1, -1]}


@dataclass(frozen=True)
class Bend:
    """v_z (N,) and sign (N,) of the bending direction of each module, base first."""

    v_z: Array
    sign: Array


def spiral(modules: int) -> Bend:
    """Task A: smallest v_z, reached at the end."""
    return Bend(_from_the_tip(SPIRAL_V_Z, modules), np.ones(modules))


def circle(modules: int) -> Bend:
    """Task B: v_z, constant over the task."""
    v_z, sign = _from_the_tip(CIRCLE_V_Z, modules), _from_the_tip(CIRCLE_SIGN, modules)
    table = _table_size(modules)
    sum_rad = np.arccos(CIRCLE_V_Z[table])[np.array(CIRCLE_SIGN[table]) > 0].sum()
    return Bend(v_z, sign) if modules in PAPER_MODULES else _scaled(v_z, sign, sum_rad)


def bend(modules: int) -> Bend:
    """Task C: v_z during the turn."""
    v_z, sign = _from_the_tip(BEND_V_Z, modules), _from_the_tip(BEND_SIGN, modules)
    return Bend(v_z, sign) if modules in PAPER_MODULES else _scaled(v_z, sign, np.arccos(v_z[-1]))


def _table_size(modules: int) -> int:
    return 6 if modules >= 6 else 4


def _from_the_tip(table: dict[int, list[float]] | dict[int, list[int]], modules: int) -> Array:
    """Row (N,) of the nearest table, cut at the base or with its base module repeated."""
    row = np.array(table[_table_size(modules)], dtype=np.float64)
    return np.concatenate([np.repeat(row[:1], max(0, modules - len(row))), row[-modules:]])


def _scaled(v_z: Array, sign: Array, sum_rad: float) -> Bend:
    """Scales the angles of the modules that do not bend back, so that their sum is `sum_rad`."""
    angle_rad = np.arccos(v_z)
    forward = sign > 0
    angle_rad[forward] *= sum_rad / angle_rad[forward].sum()
    return Bend(np.where(forward, np.cos(angle_rad), v_z), sign)
