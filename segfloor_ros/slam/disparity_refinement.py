"""Disparity of single features along the rectified row, to a fraction of a pixel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array
from segfloor_ros.slam.patch_alignment import align_patches, correlation_along_row, sample_patches

MIN_CORRELATION = 0.7


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
