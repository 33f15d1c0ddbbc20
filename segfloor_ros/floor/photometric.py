"""The floor tested on the images themselves.

Semi-global matching prefers surfaces that face the camera and, where texture is weak, agrees with
whatever repeats: the blocks of a compressed image, its neighbours. Here the right image is drawn
as it would look were everything floor, and compared with the left one. What then agrees as well
as it does with the matched disparities cannot be said not to be floor.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.floor.evidence import FloorView
from segfloor_ros.floor.profile import FloorProfile

_STEP_PX = 2
"""Every so many pixels are compared, in rows and in columns."""
_WINDOW = 5
_SHIFT_PX = 2.0


@dataclass(frozen=True)
class FloorCosts:
    """Mean absolute differences of left and right in grey levels, (R, W) float32.

    floor: were it floor, 0 where the right image does not reach; matched: at the matched disparity, infinite without one; shifted: at the
    better of two disparities a little off the floor's.
    """

    floor: NDArray[np.float32]
    matched: NDArray[np.float32]
    shifted: NDArray[np.float32]


def floor_costs(
    view: FloorView,
    profile: FloorProfile,
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    disparity: NDArray[np.float32],
) -> FloorCosts:
    """Return the costs of the view's rows (R, W) of a rectified pair."""
    height, width = left.shape
    step = _STEP_PX
    rows, columns = np.mgrid[0:height:step, 0:width:step].astype(np.float32)
    sampled = left[::step, ::step]
    floor_px = _floor_disparity(profile, view.derolled[::step, ::step])
    matched_px = disparity[::step, ::step]

    def cost(disparity_px: NDArray[np.float32]) -> NDArray[np.float32]:
        seen = cv2.remap(
            right, columns - disparity_px, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        return _difference(sampled, seen)

    shifted = np.minimum(cost(floor_px - _SHIFT_PX), cost(floor_px + _SHIFT_PX))
    matched = cost(matched_px)
    matched[matched_px <= 0] = np.inf
    floor = cost(floor_px)
    floor[columns < floor_px] = 0
    size = (width, height)
    return FloorCosts(
        *(
            cv2.resize(values, size, interpolation=cv2.INTER_NEAREST)
            for values in (floor, matched, shifted)
        )
    )


def _floor_disparity(profile: FloorProfile, derolled: NDArray[np.float32]) -> NDArray[np.float32]:
    first, last = int(derolled.min()), int(derolled.max()) + 2
    by_row = np.nan_to_num(profile.at_rows(np.arange(first, last))).astype(np.float32)
    index = (derolled - first).astype(np.intp)
    share = derolled - np.float32(first) - index.astype(np.float32)
    after = by_row[np.minimum(index + 1, len(by_row) - 1)]
    return by_row[index] * (1 - share) + after * share


def _difference(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the local mean absolute difference, free of differences in brightness."""
    difference = cv2.subtract(left, right, dtype=cv2.CV_32F)
    difference -= cv2.blur(difference, (_WINDOW, _WINDOW))
    return cv2.blur(cv2.absdiff(difference, 0.0), (_WINDOW, _WINDOW))
