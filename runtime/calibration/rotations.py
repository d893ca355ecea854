"""Rotation vectors, rotation matrices, and the mean of rotations. Axes are the columns of a matrix."""

from __future__ import annotations

import numpy as np

from modsoft.runtime.arrays import Array


def matrix(vector_deg: Array) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3), axis times angle in degrees (Rodrigues' formula)."""
    vector = np.radians(np.asarray(vector_deg, dtype=np.float64))
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    cross = np.zeros((*vector.shape, 3))
    x, y, z = np.moveaxis(vector, -1, 0)
    cross[..., 0, 1], cross[..., 0, 2], cross[..., 1, 2] = -z, y, -x
    cross[..., 1, 0], cross[..., 2, 0], cross[..., 2, 1] = z, -y, x
    # sin(a) / a and (1 - cos(a)) / a^2, also at 0; numpy's sinc(x) is sin(pi x) / (pi x).
    return np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * np.sinc(angle / (2 * np.pi)) ** 2 * (cross @ cross)


def vector_deg(rotation: Array) -> Array:
    """Rotation vectors (..., 3) in degrees of rotation matrices (..., 3, 3), angles from 0 to 180 degrees."""
    rotation = np.asarray(rotation, dtype=np.float64)
    quaternion = _quaternion(rotation)
    scalar, vector = quaternion[..., :1], quaternion[..., 1:]
    sine = np.linalg.norm(vector, axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, scalar)
    return np.degrees(vector * np.where(sine > 1e-12, angle / np.where(sine > 1e-12, sine, 1.0), 2.0))


def angle_deg(rotation: Array) -> Array:
    """Angles (...), 0 to 180 degrees, of rotation matrices (..., 3, 3)."""
    return np.linalg.norm(vector_deg(rotation), axis=-1)


def mean(rotations: Array) -> Array:
    """The rotation (..., 3, 3) with the least sum of squared distances (Frobenius norm) from rotations (K, ..., 3, 3):
    the projection of their sum onto the rotations by its singular value decomposition."""
    left, _, right = np.linalg.svd(np.asarray(rotations, dtype=np.float64).sum(axis=0))
    left[..., :, 2] *= np.sign(np.linalg.det(left @ right))[..., None]
    return left @ right


def _quaternion(rotation: Array) -> Array:
    """Unit quaternions (..., 4), w first and not negative: the eigenvector of the largest eigenvalue of Bar-Itzhack's
    symmetric matrix, which is accurate at every angle."""
    (a, b, c), (d, e, f), (g, h, i) = (np.moveaxis(rotation, (-2, -1), (0, 1))[row] for row in range(3))
    rows = [
        [a + e + i, h - f, c - g, d - b],
        [h - f, a - e - i, b + d, c + g],
        [c - g, b + d, e - a - i, f + h],
        [d - b, c + g, f + h, i - a - e],
    ]
    symmetric = np.moveaxis(np.array(rows), (0, 1), (-2, -1)) / 3.0
    quaternion = np.linalg.eigh(symmetric)[1][..., -1]
    return quaternion * np.where(quaternion[..., :1] < 0.0, -1.0, 1.0)
