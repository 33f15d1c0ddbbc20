"""Twists of rigid motions, translation first: exponential, logarithm and adjoint (Barfoot, State
Estimation for Robotics, 2017, section 7.1).
"""

from __future__ import annotations

import math

import numpy as np

from segfloor_ros.core.geometry import Array, make_transform, quaternions_of, rotation_angle

Uncertain = tuple[Array, Array]
"""A transform (4, 4), and the covariance (6, 6) of the twist before it."""


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
    if xi.ndim == 1:
        return _exp_of_one(xi)
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


def _exp_of_one(xi: Array) -> Array:
    """Return the transform (4, 4) of one twist (6,): a tenth of the time of a stack of one."""
    u, v, w, x, y, z = (float(value) for value in xi)
    squared = x * x + y * y + z * z
    theta = math.sqrt(squared)
    if theta < 1e-4:
        a, b, c = 1.0 - squared / 6, 0.5 - squared / 24, 1 / 6
    else:
        a = math.sin(theta) / theta
        b, c = (1.0 - math.cos(theta)) / squared, (1.0 - a) / squared
    d, along = 1.0 - b * squared, c * (x * u + y * v + z * w)
    transform = [
        [d + b * x * x, b * x * y - a * z, b * x * z + a * y],
        [b * x * y + a * z, d + b * y * y, b * y * z - a * x],
        [b * x * z - a * y, b * y * z + a * x, d + b * z * z],
    ]
    turned = y * w - z * v, z * u - x * w, x * v - y * u
    for row, of_rho, of_turn, of_phi in zip(transform, (u, v, w), turned, (x, y, z), strict=True):
        row.append(a * of_rho + b * of_turn + along * of_phi)
    return np.array([*transform, [0.0, 0.0, 0.0, 1.0]])


def se3_log(T: Array) -> Array:
    """Return the twist (6,) = (rho, phi) of one (4, 4) transform; the inverse of `se3_exp` for
    |phi| < pi.
    """
    return se3_logs(T[None])[0]


def adjoint(T: Array) -> Array:
    """Return the matrices (..., 6, 6) that carry twists (rho, phi) through transforms (..., 4, 4):
    T exp(twist) = exp(adjoint twist) T (Barfoot 2017, eq. 7.49).
    """
    R, t = T[..., :3, :3], T[..., :3, 3]
    matrix = np.zeros((*T.shape[:-2], 6, 6))
    matrix[..., :3, :3] = matrix[..., 3:, 3:] = R
    matrix[..., :3, 3:] = skew(t) @ R
    return matrix


def compounded(before: Uncertain, motion: Uncertain) -> Uncertain:
    """Return a pose (4, 4) and its covariance (6, 6) after a motion (Barfoot 2017, section 7.3.3,
    to second order).
    """
    (T_before, of_before), (T_motion, of_motion) = before, motion
    A = adjoint(T_motion)
    return T_motion @ T_before, A @ of_before @ A.T + of_motion


def se3_logs(T: Array) -> Array:
    """Return the twists (N, 6) of transforms (N, 4, 4), as `se3_log` of each."""
    phi = rotation_vectors(T[:, :3, :3])
    theta = np.sqrt((phi**2).sum(axis=1))
    small = theta < 1e-4
    safe = np.where(small, 1.0, theta)
    factor = np.where(small, 1 / 12, (1 - safe / 2 / np.tan(safe / 2)) / safe**2)
    K = skew(phi)
    inverse_left_jacobian = np.eye(3) - 0.5 * K + factor[:, None, None] * (K @ K)
    rho = (inverse_left_jacobian @ T[:, :3, 3:])[:, :, 0]
    return np.concatenate([rho, phi], axis=1)


def rotation_vectors(rotations: Array) -> Array:
    """Return axis times angle (N, 3), in radians up to pi, of rotations (N, 3, 3)."""
    quat_xyzw = quaternions_of(rotations)
    sine = np.sqrt((quat_xyzw[:, :3] ** 2).sum(axis=1))
    angle = 2 * np.arctan2(sine, quat_xyzw[:, 3])
    ratio = np.divide(angle, sine, out=np.full(len(sine), 2.0), where=sine > 0)
    return quat_xyzw[:, :3] * ratio[:, None]


def rotations_by(vectors: Array) -> Array:
    """Return the rotations (N, 3, 3) whose axis times angle are vectors (N, 3)."""
    return np.asarray(se3_exp(np.concatenate([np.zeros_like(vectors), vectors], 1))[:, :3, :3])


def between(T_a: Array, T_b: Array, share: float) -> Array:
    """Return the pose (4, 4) at a share of the way from one pose to another: the position on the
    straight line, the rotation on the shortest turn.
    """
    turn = rotation_vectors((T_a[:3, :3].T @ T_b[:3, :3])[None])[0]
    rotation = T_a[:3, :3] @ rotations_by(share * turn[None])[0]
    return make_transform(rotation, (1 - share) * T_a[:3, 3] + share * T_b[:3, 3])


def without_drift(T: Array) -> Array:
    """Return products of poses (..., 4, 4) with the nearest rotations: `invert` transposes, so the
    rounding errors of repeated products would grow threefold each time.
    """
    result = T.copy()
    U, _, V = np.linalg.svd(T[..., :3, :3])
    result[..., :3, :3] = U @ V
    return result


def is_within(motion: Array, reach: tuple[float, float]) -> bool:
    """Whether a motion (4, 4) is at most as far as a reach in metres and a turn in radians."""
    moved_m = float(np.linalg.norm(motion[:3, 3]))
    return moved_m <= reach[0] and rotation_angle(motion[:3, :3]) <= reach[1]
