"""Rotations as quaternions (x, y, z, w)."""

from __future__ import annotations

import numpy as np

from segfloor_ros.core.geometry import Array, make_transform, quaternions_of


def quaternion_xyzw(R: Array) -> Array:
    """Return the unit quaternion (4,) in the order x, y, z, w with w >= 0 of a (3, 3) rotation."""
    return quaternions_of(R[None])[0]


def transform_from_quaternion(translation: Array, quat_xyzw: Array) -> Array:
    """Return the (4, 4) transform of a translation (3,) and a quaternion (4,) in the order x, y,
    z, w.
    """
    return make_transform(rotations_of(quat_xyzw[None])[0], translation)


def rotations_of(quat_xyzw: Array) -> Array:
    """Return rotations (N, 3, 3) of quaternions (N, 4), x y z w, of any length but zero."""
    x, y, z, w = (quat_xyzw / np.linalg.norm(quat_xyzw, axis=1, keepdims=True)).T
    rotations = np.empty((len(quat_xyzw), 3, 3))
    rotations[:, 0] = np.stack(
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)], 1
    )
    rotations[:, 1] = np.stack(
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)], 1
    )
    rotations[:, 2] = np.stack(
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], 1
    )
    return rotations
