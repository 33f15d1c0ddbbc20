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

from segfloor_ros.floor.observation import FLOOR, NO_EVIDENCE
from segfloor_ros.floor.pixel_evidence import Comparison
from segfloor_ros.floor.view import FloorView

_STEP_PX = 2
_ROWS, _COLUMNS = 5, 7
"""Size of the window above the contact in which the upright surface is measured."""
_GAP_ROWS = 2
_MIN_SHARE = 0.25
_MAX_SPREAD_PX = 1.2
_TOLERANCE_PX = 1.0
_BEHIND = 0.6
"""The wall behind may show this share of the disparity: the ground may dip, the pitch err."""


def fill_to_contact(
    view: FloorView,
    mask: NDArray[np.uint8],
    alike: NDArray[np.bool_],
    disparity: NDArray[np.float32],
    compared: Comparison,
) -> NDArray[np.bool_]:
    """Return where plain floor goes on up to the foot of something upright.

    mask, disparity: (R, W). alike: what looks like floor at half the resolution in both directions
    of the image, the shape of the result.
    """
    part = np.s_[::_STEP_PX, :: _STEP_PX // view.step]
    small = mask[part]
    open_ = alike & (small == NO_EVIDENCE)
    upright_px = _upright_above(disparity[part], ~compared.consistent[part] | compared.denied[part])
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
