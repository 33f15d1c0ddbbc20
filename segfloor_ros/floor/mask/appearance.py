"""What does not look like the floor around it.

Texture tells where a disparity means something; how bright a surface is tells it from the floor
where there is none: a black tyre, the shade below a car. What looks like no more than a few of the
floor's own pixels is floor only if that was measured.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_WINDOW_SHARE = 0.25
"""Of the image's width: floor so near looks alike. A sun, a lamp and dust change it slowly."""
_FEW = 0.1
"""Where floor covers less than this share of the window, all floor of the image counts."""
_SIGMAS = 2.0
"""One in twenty of the floor's own pixels differs by more."""
_SMOOTH_PX = 5
_SHRINK = 4
_STEP_GREY = 1.0
"""Grey levels are whole: no surface is known better."""


def unlike_floor(image: NDArray[np.uint8], floor: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Tell which pixels of an image (R, W) are darker or brighter than nearly all of the floor
    (R, W) around them.

    What is measured as floor may be a thing that is hardly higher: the mean is taken twice, the
    second time without what stood out.
    """
    grey = cv2.blur(image, (_SMOOTH_PX, _SMOOTH_PX)).astype(np.float32)
    odd: NDArray[np.bool_] = np.zeros(image.shape, np.bool_)
    for _ in range(2):
        counted = (floor & ~odd).astype(np.float32)
        if not counted.any():
            return odd
        mean, variance = _around(grey, counted)
        odd = (grey - mean) ** 2 > _SIGMAS**2 * (variance + _STEP_GREY**2)
    return odd


def _around(
    grey: NDArray[np.float32], counted: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return mean and variance (R, W) of what counts around each pixel. Both change slowly: they
    are computed at a quarter of the resolution.
    """
    width, height = grey.shape[1], grey.shape[0]
    small = (max(1, width // _SHRINK), max(1, height // _SHRINK))
    side = int(_WINDOW_SHARE * small[0]) | 1
    sums = []
    for value in (counted, counted * grey, counted * grey**2):
        shrunk = cv2.resize(value, small, interpolation=cv2.INTER_AREA)
        share = cv2.blur(shrunk, (side, side), borderType=cv2.BORDER_CONSTANT)
        sums.append(share + np.float32(_FEW / counted.mean() * value.mean()))
    mean = sums[1] / sums[0]
    variance = np.maximum(sums[2] / sums[0] - mean**2, 0)
    return (
        cv2.resize(mean, (width, height), interpolation=cv2.INTER_LINEAR),
        cv2.resize(variance, (width, height), interpolation=cv2.INTER_LINEAR),
    )
