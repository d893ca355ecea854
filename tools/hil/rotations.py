"""Rotations of the fake tracker's tools, in plain numbers: its process imports no numpy."""

from __future__ import annotations

import math
from collections.abc import Sequence

Pose = list[list[float]]


def quaternion(pose: Pose) -> tuple[float, float, float, float]:
    """Unit quaternion (w, x, y, z), w >= 0, of a pose's rotation: the largest component first, so that none is lost."""
    (a, b, c), (d, e, f), (g, h, i) = (row[:3] for row in pose[:3])
    squares = [1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i]  # 4 w^2, 4 x^2, 4 y^2, 4 z^2
    largest = max(range(4), key=squares.__getitem__)
    products = [
        (squares[0], h - f, c - g, d - b),
        (h - f, squares[1], b + d, c + g),
        (c - g, b + d, squares[2], f + h),
        (d - b, c + g, f + h, squares[3]),
    ][largest]
    scale = math.sqrt(sum(value * value for value in products)) * (1 if products[0] >= 0 else -1)
    w, x, y, z = (value / scale for value in products)
    return w, x, y, z


def turned(pose: Pose, mm: list[float], deg: float) -> Pose:
    """A pose moved by `mm` in the tracker's frame and turned about its own y axis, as a planar module bends."""
    cos, sin = math.cos(math.radians(deg)), math.sin(math.radians(deg))
    rows = [
        [row[0] * cos - row[2] * sin, row[1], row[2] * cos + row[0] * sin, row[3] + mm[axis]]
        for axis, row in enumerate(pose[:3])
    ]
    return [*rows, [0.0, 0.0, 0.0, 1.0]]


def turn(q: Sequence[float]) -> Pose:
    """The rotation (3, 3) of a quaternion of any length, w first."""
    w, x, y, z = (value / math.hypot(*q) for value in q)
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]


def seen_from(rotation: Pose, pose: Pose) -> Pose:
    """A pose in the coordinate frame of a turned device."""
    rows = [[sum(r * pose[k][j] for k, r in enumerate(row)) for j in range(4)] for row in rotation]
    return [*rows, [0.0, 0.0, 0.0, 1.0]]


def without_roll(q: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    """What a sensor of five degrees of freedom reports: the quaternion without its rotation about the tool's z axis."""
    w, x, y, z = q
    size = math.hypot(w, z)
    if size < 1e-12:  # z turned over: every roll gives such a quaternion, and this one has none
        return 0.0, x, y, 0.0
    w, x, y = size, (x * w - y * z) / size, (y * w + x * z) / size
    return w, x, y, 0.0


def after(pose: Pose, rotation: Pose, mm: Sequence[float]) -> Pose:
    """A pose moved by `mm` and then turned by `rotation` (3, 3), both in its own frame."""
    rows = [
        [
            *(sum(row[k] * rotation[k][j] for k in range(3)) for j in range(3)),
            row[3] + sum(row[k] * mm[k] for k in range(3)),
        ]
        for row in pose[:3]
    ]
    return [*rows, [0.0, 0.0, 0.0, 1.0]]
