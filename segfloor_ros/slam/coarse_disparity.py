"""A first guess of the disparity everywhere, to two pixels: block matching of shrunken images
(Konolige, Small Vision Systems, ISRR 1997, as in OpenCV).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array

WIDTH_PX = 320
"""Images are shrunk to about this width."""

MAX_DISPARITY_SHARE = 0.5
"""Largest disparity, as a share of the image's width."""

BLOCK_PX = 11
MIN_TEXTURE = 5
STEP = 16
"""OpenCV's disparities are in 1/16 px, and their number is a multiple of 16."""


def guess_disparity(left: NDArray[np.uint8], right: NDArray[np.uint8], uv_px: Array) -> Array:
    """Return about the disparity (N,) px at pixels (N, 2) of the left image; NaN where none is
    found. left, right: rectified grey images (H, W).
    """
    factor = max(1, round(left.shape[1] / WIDTH_PX))
    size = (left.shape[1] // factor, left.shape[0] // factor)
    count = -(-round(MAX_DISPARITY_SHARE * size[0]) // STEP) * STEP
    matcher = cv2.StereoBM_create(count, BLOCK_PX)
    matcher.setTextureThreshold(MIN_TEXTURE)
    matcher.setUniquenessRatio(0)
    # Without a margin the matcher leaves the leftmost columns empty.
    small = (cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in (left, right))
    wide = (cv2.copyMakeBorder(i, 0, 0, count, 0, cv2.BORDER_REPLICATE) for i in small)
    disparity = matcher.compute(*wide)[:, count:]
    column, row = ((uv_px.T + 0.5) / factor).astype(np.intp)
    at = disparity[np.clip(row, 0, size[1] - 1), np.clip(column, 0, size[0] - 1)]
    return np.where(at > 0, at * (factor / STEP), np.nan)
