"""Where upright things stand on a blank floor: the feet of walls and furniture.

A floor of one colour shows nothing that both cameras see alike, but what stands on it ends there:
below the lower edge of a textured upright surface there is nothing but blank floor. The disparity
of the surface places that edge.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.floor.disparity.texture import (
    EDGE_SLOPE,
    MIN_TEXTURE_GREY,
    NOISE_TEXTURE,
    noise_grey,
    row_slope,
    texture_grey,
)

COLUMN_STEP_PX = 2
"""Every other column is looked at."""
_TEXTURE_WINDOW_PX = 11
_AROUND_ROWS = 15
"""An edge is the strongest of so many rows."""
_BLANK_GAP, _BLANK_ROWS = 7, 12
"""Below an edge, beyond what borrows its texture, so many rows are blank."""
_UPRIGHT_GAP, _UPRIGHT_ROWS, _UPRIGHT_COLUMNS = 3, 12, 5
"""Above an edge, beyond where the matcher mixes both surfaces, so much is upright."""
_UPRIGHT_SHARE = 0.8
_UPRIGHT_SPREAD_PX = 0.6
"""On floor of that many rows disparities spread more."""


def find_feet(
    left: NDArray[np.uint8], disparity_px: NDArray[np.float32]
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.floating]]:
    """Return rows, columns (N,) and disparities (N,) of the feet in an image (H, W) of known
    disparities (H, W), 0 for none.
    """
    image, disparity = left[:, ::COLUMN_STEP_PX], disparity_px[:, ::COLUMN_STEP_PX]
    enough = max(MIN_TEXTURE_GREY, NOISE_TEXTURE * noise_grey(left))
    texture = texture_grey(left, _TEXTURE_WINDOW_PX)[:, ::COLUMN_STEP_PX]
    slope = row_slope(image)
    strongest = cv2.dilate(slope, np.ones((_AROUND_ROWS, 1), np.uint8))
    foot = (slope == strongest) & (slope >= EDGE_SLOPE)
    foot &= _below((texture < 1.5 * enough).astype(np.float32))
    counted = ((disparity >= 1) & (texture > 2 * enough)).astype(np.float32)
    share = _mean_above(counted)
    safe = np.maximum(share, np.float32(1e-6))
    mean = _mean_above(counted * disparity) / safe
    variance = _mean_above(counted * disparity**2) / safe - mean**2
    foot &= (share > _UPRIGHT_SHARE) & (variance < _UPRIGHT_SPREAD_PX**2)
    foot[-_BLANK_GAP - _BLANK_ROWS :] = False
    rows, columns = np.nonzero(foot)
    return rows, COLUMN_STEP_PX * columns, mean[rows, columns]


def _below(blank: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Tell of each pixel whether what is below it is blank (H, W)."""
    mean = cv2.blur(blank, (1, _BLANK_ROWS), anchor=(0, 0))
    below = np.zeros(blank.shape, np.bool_)
    below[:-_BLANK_GAP] = mean[_BLANK_GAP:] > 0.95
    return below


def _mean_above(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the mean of the values (H, W) in the window above each pixel."""
    anchor = (_UPRIGHT_COLUMNS // 2, _UPRIGHT_ROWS - 1)
    mean = cv2.blur(values, (_UPRIGHT_COLUMNS, _UPRIGHT_ROWS), anchor=anchor)
    above = np.zeros_like(mean)
    above[_UPRIGHT_GAP:] = mean[:-_UPRIGHT_GAP]
    return above
