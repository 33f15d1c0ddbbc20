"""The block grid of JPEG images, found and smoothed.

Where texture is weaker than the quantisation a block of 8 x 8 pixels becomes flat, and the
steps between blocks are the strongest texture there is. They stand still in the image: a stereo
matcher finds them at the one disparity at which the grids of both images coincide, however far
away the surface is.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_BLOCK_PX = 8
_REACH_PX = 4
_QUIET_GREY = 3
_SIGNIFICANT_GREY = 8
"""Larger steps are edges of things, wherever they are."""
_ROW_STEP = 4
_MIN_RATIO = 1.5
_MIN_PIXELS = 200
_MAX_STEP_GREY = 16.0
"""Larger steps at the grid are left alone, too."""


def deblocked(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a raw grey image (H, W) with the steps between flat blocks smoothed, the image itself
    where it shows no block grid.

    The grid is that of the compressed image: not to be used on rectified ones.
    """
    if not is_blocky(image):
        return image
    smooth = image.astype(np.float32)
    _smooth_columns(smooth)
    _smooth_columns(smooth.T)
    return np.clip(np.rint(smooth), 0, 255).astype(np.uint8)


def is_blocky(image: NDArray[np.uint8]) -> bool:
    """Tell whether quiet parts of a grey image (H, W) have larger steps on the grid of eight pixels
    than within its blocks, along the rows or along the columns.
    """
    return max(_blockiness(image[::_ROW_STEP]), _blockiness(image[:, ::_ROW_STEP].T)) > _MIN_RATIO


def _blockiness(image: NDArray[np.uint8]) -> float:
    """Return the ratio of the mean step across the borders of blocks to that in their middle."""
    grey = image.astype(np.int16)

    def mean_step(first: int) -> float:
        before, at, after, beyond = (
            grey[:, first + i : grey.shape[1] - 8 + i : _BLOCK_PX] for i in (-2, -1, 0, 1)
        )
        quiet = (np.abs(at - before) < _QUIET_GREY) & (np.abs(beyond - after) < _QUIET_GREY)
        step = np.abs(after - at)
        quiet &= step <= _SIGNIFICANT_GREY
        return float(step[quiet].mean()) if np.count_nonzero(quiet) >= _MIN_PIXELS else 0.0

    within = 0.5 * (mean_step(_BLOCK_PX + 3) + mean_step(_BLOCK_PX + 5))
    return mean_step(_BLOCK_PX) / max(within, 0.1)


def _smooth_columns(grey: NDArray[np.float32]) -> None:
    """Turn the steps between the columns of two blocks into ramps, in place.

    Only steps that are larger than what goes on in the half blocks beside them.
    """
    last = grey.shape[1] - _REACH_PX + 1

    def column(offset: int) -> NDArray[np.float32]:
        return grey[:, _BLOCK_PX + offset : last + offset : _BLOCK_PX]

    step = column(0) - column(-1)
    size = np.abs(step)
    activity = np.abs(column(-1) - column(-_REACH_PX))
    activity += np.abs(column(_REACH_PX - 1) - column(0))
    step[(size >= _MAX_STEP_GREY) | (activity >= np.maximum(size, 2))] = 0
    for i in range(_REACH_PX):
        share = step * np.float32(0.5 - (i + 0.5) / (2 * _REACH_PX))
        before, after = column(-1 - i), column(i)
        before += share
        after -= share
