"""Measures map points in a stereo pair: where their patches lie, to a fraction of a pixel.

Disparity of single features along the rectified row, to a fraction of a pixel.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.depth import disparity_at
from segfloor_ros.geometry import Array, transform_points
from segfloor_ros.slam.map.residuals import Observations
from segfloor_ros.slam.map.sparse_map import SparseMap
from segfloor_ros.slam.tracking.images import Images
from segfloor_ros.slam.tracking.patch_alignment import (
    align_patches,
    correlation_along_row,
    sample_patches,
)

MIN_SIGMA_PIXEL = 0.15
MIN_SIGMA_DISPARITY = 0.1

MIN_CORRELATION = 0.7


def align_pixels(
    left: NDArray[np.float32],
    observations: Observations,
    rows: NDArray[np.intp],
    sparse_map: SparseMap,
    ids: NDArray[np.int32],
    T_camera_world: Array,
) -> NDArray[np.bool_]:
    """Move observations, in place, from where they are to where the patches of their points lie.

    left: (H, W) float32. rows, ids: (N,) the observations and their points. T_camera_world: the
    pose as known so far. Returns which patches were found (N,); the others stay as they were.
    """
    points = transform_points(T_camera_world, sparse_map.xyz_world[ids])
    zoom = sparse_map.patch_distance_m[ids] / np.linalg.norm(points, axis=1)
    template = sparse_map.patch[ids].astype(np.float32)
    found = align_patches(template, left, observations.uvd_px[rows, :2], zoom)
    sound = rows[found.sound]
    observations.uvd_px[sound, :2] = found.uv_px[found.sound]
    observations.sigma_px[sound, :2] = np.clip(found.sigma_px[found.sound], MIN_SIGMA_PIXEL, None)
    return found.sound


def measure_disparity(
    images: Images,
    observations: Observations,
    rows: NDArray[np.intp],
    guess_px: Array,
    reach_px: int = 0,
) -> None:
    """Set, in place, the disparities of observations `rows` (N,) near a guess (N,); NaN where
    there is none within the reach. A depth camera needs no guess.
    """
    uv_px = observations.uvd_px[rows, :2]
    if images.depth_scale:
        disparity, sigma = disparity_at(images.right, images.depth_scale, uv_px)
    else:
        disparity, sigma = refine_disparity(images.left, images.right, uv_px, guess_px, reach_px)
    observations.uvd_px[rows, 2] = disparity
    observations.sigma_px[rows, 2] = np.clip(sigma, MIN_SIGMA_DISPARITY, None)


def refine_disparity(
    left: NDArray[np.float32],
    right: NDArray[np.float32],
    uv_px: Array,
    guess_px: Array,
    reach_px: int,
) -> tuple[Array, Array]:
    """Find the disparity of each feature within `reach_px` of a guess.

    left, right: rectified grey images (H, W) float32. uv_px: (N, 2) in the left image. guess_px:
    (N,). First the best whole-pixel shift by normalised correlation, then the affine alignment of
    the patch along the row. Returns disparity (N,) and its standard deviation (N,) in pixels, NaN
    where there is no clear peak inside the reach.
    """
    disparity: Array = np.full(len(uv_px), np.nan)
    sigma: Array = np.full(len(uv_px), np.nan)
    if len(uv_px) == 0:
        return disparity, sigma
    template = sample_patches(left, uv_px)
    uv_right = uv_px.astype(np.float64)
    uv_right[:, 0] -= guess_px
    rows = np.arange(len(uv_px))
    if reach_px > 0:
        score = correlation_along_row(template, right, uv_right, reach_px)
        peak = score.argmax(axis=1)
        inside = (peak > 0) & (peak < 2 * reach_px)
        rows = np.flatnonzero(inside & (score[rows, peak] >= MIN_CORRELATION))
        uv_right[rows, 0] += peak[rows] - reach_px
    found = align_patches(template[rows], right, uv_right[rows], np.ones(len(rows)), along_row=True)
    rows, found_u = rows[found.sound], found.uv_px[found.sound, 0]
    disparity[rows] = uv_px[rows, 0] - found_u
    sigma[rows] = found.sigma_px[found.sound, 0]
    return disparity, sigma
