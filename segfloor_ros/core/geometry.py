"""Rigid motions and axes shared by all stages.

`T_a_b` is a (4, 4) float64 matrix that maps points of frame b into frame a. Optical frames have
x right, y down, z forward; ROS frames have x forward, y left, z up (REP-103).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]

Pose2d = tuple[float, float, float]
"""x and y in metres, yaw in radians."""

R_ROS_OPTICAL: Array = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Maps optical axes to ROS axes: (x, y, z)_ros = (z, -x, -y)_optical."""

HISTORY_NS = 10_000_000_000
MAX_DISORDER_NS = 500_000_000
"""A stamp older than the latest by no more is a late message; by more, a recording has begun again.
"""


def make_transform(rotation: Array, translation: Array) -> Array:
    """Return the (4, 4) transform of a (3, 3) rotation and a (3,) translation in metres."""
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = translation
    return transform


def invert(T_a_b: Array) -> Array:
    """Return `T_b_a`. Accepts one (4, 4) transform or a stack (..., 4, 4)."""
    R_b_a = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    T_b_a = np.zeros_like(T_a_b)
    T_b_a[..., :3, :3] = R_b_a
    T_b_a[..., :3, 3] = -(R_b_a @ T_a_b[..., :3, 3, None])[..., 0]
    T_b_a[..., 3, 3] = 1.0
    return T_b_a


def transform_points(T_a_b: Array, points_b: NDArray[np.floating]) -> Array:
    """Map points (N, 3) of frame b into frame a."""
    return points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def rotation_from_angles(yaw_rad: float, pitch_rad: float, roll_rad: float) -> Array:
    """Return the rotation (3, 3) about z by yaw, then the new y by pitch, then the new x by roll
    (REP 103).
    """
    angles = np.array([yaw_rad, pitch_rad, roll_rad])
    (cy, cp, cr), (sy, sp, sr) = np.cos(angles), np.sin(angles)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def angles_of_rotation(R: Array) -> tuple[float, float, float]:
    """Return yaw, pitch and roll in radians; the inverse of `rotation_from_angles`."""
    yaw = math.atan2(R[1, 0], R[0, 0])
    return yaw, math.asin(max(-1.0, min(1.0, -R[2, 0]))), math.atan2(R[2, 1], R[2, 2])


def planar(T: Array) -> NDArray[np.float64]:
    """Return x, y and yaw (..., 3) of poses (..., 4, 4)."""
    yaw = np.arctan2(T[..., 1, 0], T[..., 0, 0])
    return np.stack([T[..., 0, 3], T[..., 1, 3], yaw], axis=-1)


def rotation_angle(R: Array) -> Any:
    """Return the angles (...) of rotations (..., 3, 3) in radians, in [0, pi]."""
    return np.arccos(np.clip((np.trace(R, axis1=-2, axis2=-1) - 1) / 2, -1.0, 1.0))


def quaternions_of(rotations: Array) -> Array:
    """Return quaternions (N, 4), x y z w with w >= 0, of rotations (N, 3, 3).

    4 q qᵀ has the trace and the differences and sums of the entries for its own; its longest row is
    the best conditioned (Shepperd, 1978).
    """
    R = rotations
    squares = np.empty((len(R), 4, 4))
    trace = np.trace(R, axis1=1, axis2=2)
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        squares[:, i, i] = 1 + 2 * R[:, i, i] - trace
        squares[:, j, k] = squares[:, k, j] = R[:, j, k] + R[:, k, j]
        squares[:, i, 3] = squares[:, 3, i] = R[:, k, j] - R[:, j, k]
    squares[:, 3, 3] = 1 + trace
    longest = np.argmax(np.diagonal(squares, axis1=1, axis2=2), axis=1)
    found = squares[np.arange(len(R)), longest]
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    return found * np.where(found[:, 3:] < 0, -1.0, 1.0)
