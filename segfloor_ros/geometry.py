"""Rigid motions and axes shared by all stages.

`T_a_b` is a (4, 4) float64 matrix that maps points of frame b into frame a. Optical frames have
x right, y down, z forward; ROS frames have x forward, y left, z up (REP-103).

SciPy is imported where it is used: it takes 20 MB of every process, and not all need it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]

R_ROS_OPTICAL: Array = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Maps optical axes to ROS axes: (x, y, z)_ros = (z, -x, -y)_optical."""


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
    T_b_a[..., :3, 3] = -np.einsum('...ij,...j->...i', R_b_a, T_a_b[..., :3, 3])
    T_b_a[..., 3, 3] = 1.0
    return T_b_a


def transform_points(T_a_b: Array, points_b: NDArray[np.floating]) -> Array:
    """Map points (N, 3) of frame b into frame a."""
    return points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def skew(v: Array) -> Array:
    """Return the cross-product matrices (..., 3, 3) of vectors (..., 3)."""
    matrices = np.zeros((*v.shape, 3))
    matrices[..., 0, 1], matrices[..., 0, 2] = -v[..., 2], v[..., 1]
    matrices[..., 1, 0], matrices[..., 1, 2] = v[..., 2], -v[..., 0]
    matrices[..., 2, 0], matrices[..., 2, 1] = -v[..., 1], v[..., 0]
    return matrices


def se3_exp(xi: Array) -> Array:
    """Return the transforms (..., 4, 4) of twists (..., 6) = (translation part rho, rotation
    vector phi).

    Barfoot, State Estimation for Robotics (2017), eq. 7.34 and 7.37 (left Jacobian).
    """
    rho, phi = xi[..., :3], xi[..., 3:]
    theta = np.linalg.norm(phi, axis=-1)[..., None, None]
    small = theta < 1e-7
    safe = np.where(small, 1.0, theta)
    a = np.where(small, 1.0 - theta**2 / 6, np.sin(safe) / safe)
    b = np.where(small, 0.5 - theta**2 / 24, (1 - np.cos(safe)) / safe**2)
    c = np.where(small, 1 / 6 - theta**2 / 120, (safe - np.sin(safe)) / safe**3)
    K = skew(phi)
    K2 = K @ K
    transform = np.zeros((*xi.shape[:-1], 4, 4))
    transform[..., :3, :3] = np.eye(3) + a * K + b * K2
    left_jacobian = np.eye(3) + b * K + c * K2
    transform[..., :3, 3] = np.einsum('...ij,...j->...i', left_jacobian, rho)
    transform[..., 3, 3] = 1.0
    return transform


def se3_log(T: Array) -> Array:
    """Return the twist (6,) = (rho, phi) of one (4, 4) transform; the inverse of `se3_exp` for
    |phi| < pi.
    """
    from scipy.spatial.transform import Rotation

    phi = Rotation.from_matrix(T[:3, :3].copy()).as_rotvec()
    theta = float(np.linalg.norm(phi))
    K = skew(phi)
    if theta < 1e-7:
        inverse_left_jacobian = np.eye(3) - 0.5 * K + K @ K / 12
    else:
        half = theta / 2
        factor = (1 - half / np.tan(half)) / theta**2
        inverse_left_jacobian = np.eye(3) - 0.5 * K + factor * (K @ K)
    return np.concatenate([inverse_left_jacobian @ T[:3, 3], phi])


def adjoint(T: Array) -> Array:
    """Return the matrices (..., 6, 6) that carry twists (rho, phi) through transforms (..., 4, 4):
    T exp(twist) = exp(adjoint twist) T (Barfoot 2017, eq. 7.49).
    """
    R, t = T[..., :3, :3], T[..., :3, 3]
    matrix = np.zeros((*T.shape[:-2], 6, 6))
    matrix[..., :3, :3] = matrix[..., 3:, 3:] = R
    matrix[..., :3, 3:] = skew(t) @ R
    return matrix


def se3_logs(T: Array) -> Array:
    """Return the twists (N, 6) of transforms (N, 4, 4), as `se3_log` of each."""
    from scipy.spatial.transform import Rotation

    phi = Rotation.from_matrix(T[:, :3, :3].copy()).as_rotvec()
    theta = np.linalg.norm(phi, axis=1)
    small = theta < 1e-4
    safe = np.where(small, 1.0, theta)
    factor = np.where(small, 1 / 12, (1 - safe / 2 / np.tan(safe / 2)) / safe**2)
    K = skew(phi)
    inverse_left_jacobian = np.eye(3) - 0.5 * K + factor[:, None, None] * (K @ K)
    rho = np.einsum('nij,nj->ni', inverse_left_jacobian, T[:, :3, 3])
    return np.concatenate([rho, phi], axis=1)


def quaternion_xyzw(R: Array) -> Array:
    """Return the unit quaternion (4,) in the order x, y, z, w with w >= 0 of a (3, 3) rotation."""
    # SciPy 1.11 takes no array that is read-only.
    from scipy.spatial.transform import Rotation

    quaternion = Rotation.from_matrix(R.copy()).as_quat()
    return -quaternion if quaternion[3] < 0 else quaternion


def transform_from_quaternion(translation: Array, quat_xyzw: Array) -> Array:
    """Return the (4, 4) transform of a translation (3,) and a quaternion (4,) in the order x, y,
    z, w.
    """
    from scipy.spatial.transform import Rotation

    return make_transform(Rotation.from_quat(quat_xyzw.copy()).as_matrix(), translation)


def rotation_angle(R: Array) -> float:
    """Return the angle of a (3, 3) rotation in radians, in [0, pi]."""
    return float(np.arccos(np.clip((np.trace(R) - 1) / 2, -1.0, 1.0)))
