"""How many points of an image determine the pose: those on edges slide along them, and neighbours
err together.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array

REACH_PX = 5
MIN_RATIO = 0.15
"""Smaller over larger eigenvalue of the structure tensor (Harris and Stephens 1988); of corners and
textures it is more, of an edge with the noise of a camera less."""


CELLS, PER_CELL = 80, 3
"""Parts into which an image is divided, and points of each that count."""


def count_firm(image: NDArray[Any], uv_px: Array) -> int:
    """Return how many pixels (N, 2) of a grey image (H, W) are on corners or in textures; of many
    in one part of the image some.
    """
    firm = uv_px[_is_firm(image, uv_px)]
    cell = (firm // np.sqrt(image.size / CELLS)).astype(np.intp)
    _, counts = np.unique(cell, axis=0, return_counts=True)
    return int(np.minimum(counts, PER_CELL).sum())


def _is_firm(image: NDArray[Any], uv_px: Array) -> NDArray[np.bool_]:
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    height, width = image.shape
    columns, rows = np.rint(uv_px).astype(np.intp).T
    steps = np.arange(-REACH_PX, REACH_PX + 1)
    patches = smooth[
        np.clip(rows[:, None, None] + steps[:, None], 0, height - 1),
        np.clip(columns[:, None, None] + steps, 0, width - 1),
    ].astype(np.float32)
    by_x = patches[:, 1:-1, 2:] - patches[:, 1:-1, :-2]
    by_y = patches[:, 2:, 1:-1] - patches[:, :-2, 1:-1]
    xx, xy, yy = ((a * b).sum(axis=(1, 2)) for a, b in ((by_x, by_x), (by_x, by_y), (by_y, by_y)))
    middle, spread = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    return np.asarray(middle - spread > MIN_RATIO * (middle + spread))
