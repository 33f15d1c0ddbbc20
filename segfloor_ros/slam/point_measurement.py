"""Measures map points in a stereo pair: where their patches lie, to a fraction of a pixel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.depth import disparity_at
from segfloor_ros.geometry import Array, transform_points
from segfloor_ros.slam.disparity_refinement import refine_disparity
from segfloor_ros.slam.images import Images
from segfloor_ros.slam.patch_alignment import align_patches
from segfloor_ros.slam.residuals import Observations
from segfloor_ros.slam.sparse_map import SparseMap

MIN_SIGMA_PIXEL = 0.15
MIN_SIGMA_DISPARITY = 0.1


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
