"""How well the points of an image determine the pose of the camera.

A patch determines how far it shifted as well as its slopes allow against the noise of the camera
(the Cramer-Rao bound; Foerstner and Guelch 1987): an edge only across itself, a plain face not at
all. Patches that overlap hold the same pixels and err together: they count as one.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.geometry import Array, invert, se3_exp, se3_log, transform_points
from segfloor_ros.slam.map.residuals import (
    MIN_DEPTH_M,
    Observations,
    residuals,
    weighted_jacobian,
    with_moment,
)
from segfloor_ros.slam.tracking.patch_alignment import GREY_NOISE, HALF_PATCH_PX, SIDE_PX
from segfloor_ros.slam.tracking.point_measurement import MIN_SIGMA_PIXEL
from segfloor_ros.slam.tracking.pose import PoseEstimate

NOISE_SLOPE = 0.04
"""Mean square of a slope of noise of unit variance, smoothed by one pixel: 1 / (8 pi)."""

ALIASED = 0.3
"""Share of the slopes across an edge that its sampling in steps of pixels shows along it."""

STEPS = 3
"""Gauss-Newton steps to the likeliest pose; the images have it almost there."""

LEAST_SHIFT = 1e-4
"""Information in 1/px² of the shift of a pixel along an edge, or on a plain face."""

FIRST_INFORMATION = np.array([1.0] * 3 + [0.1] * 3) ** -2
"""Of a pose before any point is seen, in metres and radians: where no point determines it."""


class PoseInformation:
    """What points (N, 3) of the world, seen in a grey image (H, W), say of its pose."""

    def __init__(
        self,
        camera: StereoCamera,
        image: NDArray[Any],
        points_world: Array,
        observations: Observations,
        noise_factor: float = 1.0,
    ) -> None:
        self._camera = camera
        self._points = points_world
        self._observations = observations
        shift = _shift_information(image, observations.uvd_px[:, :2])
        variance = np.where(np.isnan(observations.uvd_px), np.inf, observations.sigma_px**2)
        self._weight: Array = np.zeros((len(points_world), 3, 3))
        self._weight[:, :2, :2] = shift @ np.linalg.inv(np.eye(2) + variance[:, :2, None] * shift)
        self._weight[:, 2, 2] = 1 / (1 / np.maximum(shift[:, 0, 0], LEAST_SHIFT) + variance[:, 2])
        self._weight /= noise_factor**2

    def covariance(self, T_camera_world: Array) -> Array:
        """Return the covariance (6, 6) of the twist of a pose (4, 4), translation first."""
        information, _ = self._normal_equations(T_camera_world)
        return np.asarray(np.linalg.inv(information + np.diag(FIRST_INFORMATION)))

    def is_prior_better(self, T_camera_world: Array, prior: PoseEstimate) -> bool:
        """Whether a prior knows some direction of a pose (4, 4) better than the points do."""
        covariance, known = self.covariance(T_camera_world), np.linalg.inv(prior.covariance)
        return bool(np.linalg.eigvals(covariance @ known).real.max() > 1)

    def fused(self, seen: PoseEstimate, prior: PoseEstimate) -> PoseEstimate:
        """Return the likeliest pose with a prior, near the one of the points alone: the prior
        adds what edges do not determine.
        """
        pose, known = seen.T_camera_world, np.linalg.inv(prior.covariance)
        for _ in range(STEPS):
            information, gradient = self._normal_equations(pose)
            gradient += known @ se3_log(pose @ invert(prior.T_camera_world))
            covariance = np.linalg.inv(information + known)
            pose = se3_exp(-covariance @ gradient) @ pose
        return replace(seen, T_camera_world=pose, covariance=covariance)

    def _normal_equations(self, T_camera_world: Array) -> tuple[Array, Array]:
        """Return the information (6, 6) of the twist of a pose (4, 4), and the gradient (6,) of
        half the squared error.
        """
        points = transform_points(T_camera_world, self._points)
        points[:, 2] = np.maximum(points[:, 2], MIN_DEPTH_M)
        J = with_moment(
            points.T, weighted_jacobian(self._camera, points, np.ones((3, len(points))))
        )
        weighted = np.einsum('ian,nab->ibn', J, self._weight)
        residual = residuals(self._camera, points, self._observations)
        return (
            np.einsum('ibn,jbn->ij', weighted, J, optimize=True),
            np.einsum('ibn,nb->i', weighted, residual),
        )


def with_patch_noise(image: NDArray[Any], observations: Observations) -> Observations:
    """Return observations (N) whose pixels have at least the noise that the patches of a grey image
    (H, W) around them allow: on an edge, that along it.
    """
    shift = _shift_information(image, observations.uvd_px[:, :2])
    variance = np.linalg.inv(shift + LEAST_SHIFT * np.eye(2))
    sigma = observations.sigma_px.copy()
    sigma[:, :2] = np.maximum(sigma[:, :2], np.sqrt(np.einsum('nii->ni', variance)))
    return replace(observations, sigma_px=sigma)


def _shift_information(image: NDArray[Any], uv_px: Array) -> Array:
    """Return the information (N, 2, 2) in 1/px² that patches around pixels (N, 2) give of their
    shift, freed of what noise alone would show.
    """
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    height, width = image.shape
    columns, rows = np.rint(uv_px).astype(np.intp).T
    steps = np.arange(-HALF_PATCH_PX - 1, HALF_PATCH_PX + 2)
    patches = smooth[
        np.clip(rows[:, None, None] + steps[:, None], 0, height - 1),
        np.clip(columns[:, None, None] + steps, 0, width - 1),
    ].astype(np.float32)
    by_u = (patches[:, 1:-1, 2:] - patches[:, 1:-1, :-2]) / 2
    by_v = (patches[:, 2:, 1:-1] - patches[:, :-2, 1:-1]) / 2
    slopes = np.stack([by_u, by_v], axis=1).reshape(len(uv_px), 2, SIDE_PX**2)
    energy, axes = np.linalg.eigh(slopes @ np.swapaxes(slopes, 1, 2))
    of_noise = NOISE_SLOPE * GREY_NOISE**2 * SIDE_PX**2
    apparent = 2 * of_noise + ALIASED * energy[:, 1:]
    known = np.maximum(energy - apparent, 0.0) / GREY_NOISE**2
    known /= 1 + MIN_SIGMA_PIXEL**2 * known
    if len(uv_px):
        tree = cKDTree(uv_px)
        crowd = tree.query_ball_point(uv_px, HALF_PATCH_PX, return_length=True)
        known /= np.asarray(crowd)[:, None]
    return np.asarray((axes * known[:, None]) @ np.swapaxes(axes, 1, 2), np.float64)
