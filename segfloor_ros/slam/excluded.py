"""Parts of an image that do not count, because they move or lie on the border of rectification.

Two sources say so: a segmentation network (`StereoFrame.excluded`) and `moving_regions`.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Region = NDArray[np.uint8]
"""A mask (H, W) uint8 of the left image, 255 where something moves."""


def join(a: Region | None, b: Region | None) -> Region | None:
    """Return the region that is in either; None for none at all."""
    if a is None or b is None:
        return b if a is None else a
    return np.maximum(a, b)


def dilate(region: Region, radius_px: int) -> Region:
    """Return the region and everything within a radius of it."""
    if radius_px == 0:
        return region
    size = 2 * radius_px + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return np.asarray(cv2.dilate(region, disc), np.uint8)


def is_inside(region: Region | None, uv_px: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return which pixels (N, 2) lie in a region; none of them where there is no region."""
    if region is None:
        return np.zeros(len(uv_px), bool)
    height, width = region.shape
    u = np.clip(np.rint(uv_px[:, 0]), 0, width - 1).astype(np.intp)
    v = np.clip(np.rint(uv_px[:, 1]), 0, height - 1).astype(np.intp)
    return region[v, u] > 0
