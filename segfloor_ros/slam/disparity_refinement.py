"""Sub-pixel disparity of single features by normalised correlation along the rectified row."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array

HALF_PATCH_PX = 5
MIN_CORRELATION = 0.75


def refine_disparity(
    left: NDArray[np.float32],
    right: NDArray[np.float32],
    uv_px: NDArray[np.floating],
    guess_px: NDArray[np.floating],
    reach_px: int,
) -> tuple[Array, Array]:
    """Find the disparity of each feature within `reach_px` of a guess, to a fraction of a
    pixel. left, right: rectified grey images (H, W) float32. uv_px: (N, 2) in the left image.
    guess_px: (N,). The patch is compared by zero-mean normalised cross-correlation, which a
    difference in gain or brightness between the cameras does not change; the peak is refined
    by a parabola. Returns disparity (N,), NaN where there is no clear peak inside the reach or
    the patch leaves the image, and the standard deviation (N,) in pixels as the peak's
    sharpness gives it.
    """
    disparity = np.full(len(uv_px), np.nan)
    sigma = np.full(len(uv_px), np.nan)
    if len(uv_px) == 0:
        return disparity, sigma
    score = _correlation(left, right, uv_px, guess_px, reach_px)
    peak = score.argmax(axis=1)
    rows = np.arange(len(score))
    inside = (peak > 0) & (peak < 2 * reach_px) & (score[rows, peak] >= MIN_CORRELATION)
    rows, peak = rows[inside], peak[inside]
    before, at, after = score[rows, peak - 1], score[rows, peak], score[rows, peak + 1]
    curvature = np.maximum(2 * at - before - after, 1e-6)
    offset = 0.5 * (after - before) / curvature
    disparity[rows] = guess_px[rows] + reach_px - peak - offset
    # Error propagation of the peak: noise (1 - score) over the curvature of the score.
    sigma[rows] = np.sqrt(np.maximum(1 - at, 0.002) / (curvature * (2 * HALF_PATCH_PX + 1)))
    return disparity, sigma


def _correlation(
    left: NDArray[np.float32],
    right: NDArray[np.float32],
    uv_px: NDArray[np.floating],
    guess_px: NDArray[np.floating],
    reach_px: int,
) -> Array:
    """Return scores (N, 2 * reach + 1); column s shifts the right patch by s - reach pixels to
    the right.
    """
    side = 2 * HALF_PATCH_PX + 1
    uv = np.asarray(uv_px, np.float32)
    template = sample_patches(left, uv, HALF_PATCH_PX, HALF_PATCH_PX)
    uv_right = uv - np.stack([guess_px, np.zeros_like(guess_px)], axis=1).astype(np.float32)
    strip = sample_patches(right, uv_right, HALF_PATCH_PX + reach_px, HALF_PATCH_PX)
    template = template - template.mean(axis=(1, 2), keepdims=True)
    windows = np.lib.stride_tricks.sliding_window_view(strip, side, axis=2)
    total = windows.sum(axis=(1, 3))
    square = np.einsum('nhsw,nhsw->ns', windows, windows)
    product = np.einsum('nhw,nhsw->ns', template, windows)
    variance = np.maximum(square - total**2 / side**2, 1e-3)
    energy = np.maximum((template**2).sum(axis=(1, 2)), 1e-3)
    return product / np.sqrt(variance * energy[:, None])


def sample_patches(
    image: NDArray[np.float32], uv_px: NDArray[np.float32], half_width: int, half_height: int
) -> NDArray[np.float32]:
    """Return the patches (N, 2 half_height + 1, 2 half_width + 1) around sub-pixel positions
    (N, 2).
    """
    du = np.arange(-half_width, half_width + 1, dtype=np.float32)
    dv = np.arange(-half_height, half_height + 1, dtype=np.float32)
    shape = (len(uv_px), len(dv) * len(du))
    map_u = np.broadcast_to(uv_px[:, 0, None, None] + du, (len(uv_px), len(dv), len(du)))
    map_v = np.broadcast_to(uv_px[:, 1, None, None] + dv[:, None], map_u.shape)
    patches = np.empty(shape, np.float32)
    limit = 30000  # cv2.remap takes fewer than 2^15 rows
    for start in range(0, len(uv_px), limit):
        rows = slice(start, start + limit)
        patches[rows] = cv2.remap(
            image,
            np.ascontiguousarray(map_u[rows].reshape(-1, shape[1])),
            np.ascontiguousarray(map_v[rows].reshape(-1, shape[1])),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
    return patches.reshape(map_u.shape)
