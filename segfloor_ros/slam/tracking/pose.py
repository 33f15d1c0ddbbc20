"""The pose of one stereo frame against known map points: PnP-RANSAC and robust refinement."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.geometry import Array, make_transform, se3_exp, transform_points
from segfloor_ros.slam.map.residuals import (
    MIN_DEPTH_M,
    Observations,
    huber_cost,
    huber_weights,
    residuals,
    squared_norms,
    weighted_jacobian,
    with_moment,
)

ROUNDS = 3
STEPS_PER_ROUND = 6
CONVERGED = 1e-4
"""Relative decrease of the cost, expected or seen, that ends a round."""

SAME_INLIERS = 0.01
"""Share of the points that changes sides below which another round would change nothing."""

MAX_NOISE_FACTOR = 4.0
RANSAC_ITERATIONS = 1000
"""Enough for a quarter of right matches, five at a time; it ends early when more are right."""
RANSAC_REPROJECTION_PX = 4.0


@dataclass(frozen=True)
class PoseEstimate:
    """A refined pose.

    T_camera_world: (4, 4). inliers: (N,) bool over the observations. covariance: (6, 6) of the
    twist in T_camera_world <- exp(twist) T_camera_world, order translation (m), rotation (rad).
    """

    T_camera_world: Array
    inliers: NDArray[np.bool_]
    covariance: Array
    noise_factor: float


def solve_pnp(
    camera: StereoCamera, points_world: Array, uv_px: NDArray[np.floating]
) -> tuple[Array, NDArray[np.bool_]] | None:
    """Find T_camera_world from points (N, 3) and pixels (N, 2) by PnP in RANSAC, or None.

    Fischler and Bolles, Random sample consensus (1981), on OpenCV's EPnP; its generator is
    seeded, so that the same input gives the same pose. Also returns the inliers (N,).
    """
    if len(points_world) < 6:
        return None
    found, rotation_vector, translation, rows = cv2.solvePnPRansac(
        np.ascontiguousarray(points_world, np.float64),
        np.ascontiguousarray(uv_px, np.float64),
        camera.K,
        None,
        iterationsCount=RANSAC_ITERATIONS,
        reprojectionError=RANSAC_REPROJECTION_PX,
        confidence=0.999,
        flags=cv2.SOLVEPNP_EPNP,
    )
    if not found or rows is None:
        return None
    inliers = np.zeros(len(points_world), bool)
    inliers[np.asarray(rows).ravel()] = True
    R = Rotation.from_rotvec(np.asarray(rotation_vector).ravel()).as_matrix()
    return make_transform(R, np.asarray(translation, np.float64).ravel()), inliers


def refine_pose(
    camera: StereoCamera,
    T_camera_world: Array,
    points_world: Array,
    observations: Observations,
    max_noise_factor: float = MAX_NOISE_FACTOR,
) -> PoseEstimate:
    """Refine a pose by Levenberg-Marquardt on (u, v, d) with a Huber cost, dropping outliers
    between rounds.

    points_world: (N, 3). Points that fall behind the camera count as outliers. Blur, compression
    and a poor calibration make errors larger than the sigmas of single measurements; the median
    residual shows by how much, and the bound on outliers follows it.
    """
    inliers = np.ones(len(points_world), bool)
    pose, factor = T_camera_world, 1.0
    for _ in range(ROUNDS):
        pose = _minimise(camera, pose, points_world[inliers], observations.take(inliers))
        chi2 = squared_distances(camera, pose, points_world, observations)
        excess = chi2 / observations.chi2_median
        factor = float(np.sqrt(np.clip(np.median(excess), 1.0, max_noise_factor**2)))
        before, inliers = inliers, chi2 <= factor**2 * observations.chi2_limit
        if inliers.sum() < 4 or (inliers != before).mean() < SAME_INLIERS:
            break
    scaled = observations.take(inliers).with_noise_factor(factor)
    covariance = _covariance(camera, pose, points_world[inliers], scaled)
    return PoseEstimate(pose, inliers, covariance, factor)


def squared_distances(
    camera: StereoCamera, pose: Array, points_world: Array, observations: Observations
) -> Array:
    """Return the squared, normalised residuals (N,) of observations of points (N, 3) at a pose;
    infinite for points behind the camera.
    """
    points = transform_points(pose, points_world)
    front = points[:, 2] > MIN_DEPTH_M
    points[~front] = (0.0, 0.0, 1.0)
    chi2 = squared_norms(residuals(camera, points, observations), observations.information)
    return np.where(front, chi2, np.inf)


def _minimise(
    camera: StereoCamera, pose: Array, points_world: Array, observations: Observations
) -> Array:
    information, limit = observations.information, observations.chi2_limit
    damping = 1e-4

    def evaluate(candidate: Array) -> tuple[Array, Array, Array, float]:
        points = transform_points(candidate, points_world)
        points[:, 2] = np.maximum(points[:, 2], MIN_DEPTH_M)
        residual = residuals(camera, points, observations)
        chi2 = squared_norms(residual, information)
        return points, residual, chi2, huber_cost(chi2, limit)

    points, residual, chi2, cost = evaluate(pose)
    for _ in range(STEPS_PER_ROUND):
        H, g = _normal_equations(camera, points, residual, information, chi2, limit)
        step = np.linalg.solve(H + damping * np.diag(np.diag(H) + 1e-9), -g)
        candidate = se3_exp(step) @ pose
        if -g @ step < CONVERGED * cost:
            return candidate
        trial = evaluate(candidate)
        if trial[3] <= cost:
            converged = cost - trial[3] < CONVERGED * cost
            pose, (points, residual, chi2, cost) = candidate, trial
            damping *= 0.2
            if converged:
                break
        else:
            damping *= 10.0
    return pose


def _normal_equations(
    camera: StereoCamera,
    points: Array,
    residual: Array,
    information: Array,
    chi2: Array,
    limit: Array,
) -> tuple[Array, Array]:
    root = np.sqrt(information * huber_weights(chi2, limit)[:, None]).T
    J = with_moment(points.T, weighted_jacobian(camera, points, root)).reshape(6, -1)
    return J @ J.T, J @ (residual.T * root).ravel()


def _covariance(
    camera: StereoCamera, pose: Array, points_world: Array, observations: Observations
) -> Array:
    points = transform_points(pose, points_world)
    if len(points) < 4:
        return np.eye(6) * 1e6
    residual = residuals(camera, points, observations)
    information = observations.information
    chi2 = squared_norms(residual, information)
    H, _ = _normal_equations(camera, points, residual, information, chi2, observations.chi2_limit)
    return np.linalg.pinv(H, hermitian=True)
