"""How well the points of an image tell the pose of the camera.

A patch tells how far it shifted as well as its slopes allow against the noise of the camera (the
Cramer-Rao bound; Foerstner and Guelch 1987): an edge only across itself, a plain face not at all.
Patches that overlap hold the same pixels and err together: they count as one.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.geometry import Array
from segfloor_ros.slam.patch_alignment import GREY_NOISE, HALF_PATCH_PX, SIDE_PX
from segfloor_ros.slam.point_measurement import MIN_SIGMA_PIXEL
from segfloor_ros.slam.residuals import weighted_jacobian, with_moment

NOISE_SLOPE = 0.04
"""Mean square of a slope of noise of unit variance, smoothed by one pixel: 1 / (8 pi)."""

ALIASED = 0.1
"""Share of the slopes across an edge that its sampling in steps of pixels shows along it."""

FIRST_INFORMATION = np.array([1.0] * 3 + [0.1] * 3) ** -2
"""Of a pose before any point is seen, in metres and radians: a direction that no point tells."""


def pose_covariance(
    camera: StereoCamera, image: NDArray[Any], uv_px: Array, points_camera: Array
) -> Array:
    """Return the covariance (6, 6) of the twist of a pose, translation first, that points (N, 3)
    seen at pixels (N, 2) of a grey image (H, W) and along the row in the right one allow.
    """
    shift = _shift_information(image, uv_px)
    J = with_moment(
        points_camera.T, weighted_jacobian(camera, points_camera, np.ones((3, len(uv_px))))
    )
    H = np.einsum('ian,nab,jbn->ij', J[:, :2], shift, J[:, :2], optimize=True)
    H += (J[:, 2] * shift[:, 0, 0]) @ J[:, 2].T
    return np.asarray(np.linalg.inv(H + np.diag(FIRST_INFORMATION)))


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
    told = np.maximum(energy - apparent, 0.0) / GREY_NOISE**2
    told /= 1 + MIN_SIGMA_PIXEL**2 * told
    if len(uv_px):
        tree = cKDTree(uv_px)
        crowd = tree.query_ball_point(uv_px, HALF_PATCH_PX, return_length=True)
        told /= np.asarray(crowd)[:, None]
    return np.asarray((axes * told[:, None]) @ np.swapaxes(axes, 1, 2), np.float64)
