"""Floor up to the foot of what stands on it.

Plain floor shows nothing that both cameras see alike, but what stands behind it does: an upright
surface has the disparity of the floor on which it stands. Where a plain stretch that begins with
floor, or at the lower edge of the image, ends at such a surface, and at the row where that surface
meets the floor, all of it is floor.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.floor.disparity.texture import EDGE_SLOPE
from segfloor_ros.floor.mask.pixel_evidence import Comparison
from segfloor_ros.floor.mask.view import FloorView
from segfloor_ros.floor.observation import FLOOR, NO_EVIDENCE

_STEP_PX = 2
_ROWS, _COLUMNS = 5, 7
"""Size of the window above the contact in which the upright surface is measured."""
_GAP_ROWS = 2
_MIN_SHARE = 0.25
_MAX_SPREAD_PX = 1.2
_TOLERANCE_PX = 1.0
_BEHIND = 0.6
"""The wall behind may show this share of the disparity: the ground may dip, the pitch err."""
_EDGE_ROWS = 4
"""So near to the end of the floor is the edge at which it ends."""
_WEAK_EDGE = 16
"""Sobel response of the weakest edge that shows that more than one face is seen."""
_SETTLED_ROWS = 9
"""So far above an edge, what is measured over a window does not know of it."""
_LEAST_BLANK_ROWS = 3


def fill_to_contact(
    view: FloorView,
    mask: NDArray[np.uint8],
    alike: NDArray[np.bool_],
    disparity: NDArray[np.float32],
    compared: Comparison,
    textured: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Return where plain floor goes on up to the foot of something upright.

    mask, disparity, textured: (R, W); where nothing has texture, disparities are of noise. alike:
    what looks like floor at half the resolution in both directions of the image, the shape of the
    result.
    """
    part = np.s_[::_STEP_PX, :: _STEP_PX // view.step]
    small = mask[part]
    open_ = alike & (small == NO_EVIDENCE)
    if not open_.any():
        return open_
    contrary = ~compared.consistent[part] | compared.denied[part]
    upright_px = _upright_above(disparity[part], contrary & textured[part])
    floor_px = compared.floor_px
    nearest, farthest = floor_px + np.float32(_TOLERANCE_PX), np.float32(_BEHIND) * floor_px
    contact = (upright_px < nearest) & (upright_px > farthest - np.float32(_TOLERANCE_PX))
    rows = np.arange(small.shape[0], dtype=np.int32)[:, None]
    above = np.maximum.accumulate(np.where(open_, 0, rows), axis=0)
    last = small.shape[0] - 1
    below = np.minimum.accumulate(np.where(open_, last, rows)[::-1], axis=0)[::-1]
    starts = np.take_along_axis(small, below, axis=0) == FLOOR
    starts |= open_[last] & (below == last)
    return open_ & starts & np.take_along_axis(contact, above, axis=0)


def _upright_above(
    disparity: NDArray[np.float32], contrary: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Return the disparity of the upright surface right above each pixel, NaN where none is."""
    counted = (contrary & (disparity > 0)).astype(np.float32)
    window = (_COLUMNS, _ROWS)
    # The window ends some rows above the pixel, where the matcher does not mix the two surfaces.
    anchor = (_COLUMNS // 2, _ROWS - 1)

    def mean(values: NDArray[np.float32]) -> NDArray[np.float32]:
        shifted = np.zeros_like(values)
        shifted[_GAP_ROWS:] = values[:-_GAP_ROWS]
        return cv2.blur(shifted, window, anchor=anchor)

    share = mean(counted)
    safe = np.maximum(share, 1e-6)
    average = mean(counted * disparity) / safe
    variance = mean(counted * disparity**2) / safe - average**2
    good = (share >= _MIN_SHARE) & (variance < _MAX_SPREAD_PX**2)
    return np.where(good, average, np.float32(np.nan))


def blank_feet(
    view: FloorView,
    mask: NDArray[np.uint8],
    slope: NDArray[np.int16],
    textured: NDArray[np.bool_],
) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Return rows and columns (N,) of the view where blank faces stand on the floor of a mask
    (R, W). slope: `row_slope` of the image (R, W).

    Such a face shows nothing but where it begins: up a column the floor ends at an edge of the
    image, and from there to the horizon there is no texture, and no other edge. Beyond a shadow or
    a blank patch the floor goes on, and ends at another edge.
    """
    height, width = mask.shape
    columns = np.arange(width)
    top = (mask == FLOOR).argmax(axis=0)
    near = np.clip(top + np.arange(-_EDGE_ROWS, _EDGE_ROWS + 1)[:, None], 1, height - 2)
    edge = np.take_along_axis(near, slope[near, columns].argmax(axis=0)[None], axis=0)[0]
    seen = (textured | (slope >= _WEAK_EDGE)).cumsum(axis=0, dtype=np.int16)
    horizon = np.clip(np.rint(view.line.horizon - view.shear_px - view.first_row), 0, height - 1)
    end = edge - _SETTLED_ROWS
    begin = horizon.astype(np.intp)
    blank = (end - begin >= _LEAST_BLANK_ROWS) & (mask[top, columns] == FLOOR)
    blank &= seen[np.maximum(end, 0), columns] == seen[begin, columns]
    found = np.flatnonzero(blank & (slope[edge, columns] >= EDGE_SLOPE))
    rows = edge[found]
    before, at, after = (slope[rows + i, found].astype(np.float32) for i in (-1, 0, 1))
    bend = np.maximum(2 * at - before - after, 1)
    return rows + np.clip((after - before) / (2 * bend), -0.5, 0.5), found
