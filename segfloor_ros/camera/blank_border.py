"""The black border that rectification leaves around an image: nothing was seen there."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_STEP_PX = 2
_MARGIN_PX = 12
"""Blocks that are matched and windows of texture reach so far: the border's edge is no texture."""
_LEAST_PX = 40
"""Black pixels of the scene that touch the image's edge are fewer, at half the resolution."""


def blank_border(image: NDArray[np.uint8]) -> NDArray[np.uint8] | None:
    """Return a mask (H, W) uint8, 255 in the black border of a rectified grey image (H, W) and near
    it, or None where there is none.

    The border is what is exactly 0 and joined to an edge of the image.
    """
    edges = (image[0], image[-1], image[:, 0], image[:, -1])
    if sum(int(np.count_nonzero(edge == 0)) for edge in edges) < 2 * _LEAST_PX:
        return None
    black = (image[::_STEP_PX, ::_STEP_PX] == 0).astype(np.uint8)
    _, label, stats, _ = cv2.connectedComponentsWithStats(black, connectivity=4)
    touching = np.unique(np.concatenate([label[0], label[-1], label[:, 0], label[:, -1]]))
    large = touching[(touching > 0) & (stats[touching, cv2.CC_STAT_AREA] >= _LEAST_PX)]
    if len(large) == 0:
        return None
    chosen = np.zeros(len(stats), np.uint8)
    chosen[large] = 255
    size = _MARGIN_PX // _STEP_PX * 2 + 1
    border = cv2.dilate(chosen[label], np.ones((size, size), np.uint8))
    whole = cv2.resize(border, image.shape[::-1], interpolation=cv2.INTER_NEAREST)
    return np.asarray(whole, np.uint8)


def matched_in(region: NDArray[np.uint8], disparity_px: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Tell which pixels of the left image (H, W) are matched with a region (H, W) of the right."""
    rows, columns = np.indices(disparity_px.shape, np.float32)
    at = columns - disparity_px
    hit = cv2.remap(region, at, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(hit > 0)
