"""Where pixels of the last image are in this one: Lucas-Kanade on a pyramid (Bouguet, Pyramidal
Implementation of the Lucas Kanade Feature Tracker, 2000, as in OpenCV).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array

WINDOW_PX = 11
LEVELS = 3
SMALLEST_WIDTH_PX = 300
STEPS = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 0.05)


def shrink(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the image (H, W) at half its size where it is large: a start for patch alignment
    need not be better than a pixel.
    """
    if image.shape[1] < 2 * SMALLEST_WIDTH_PX:
        return image
    half = (image.shape[1] // 2, image.shape[0] // 2)
    return np.asarray(cv2.resize(image, half, interpolation=cv2.INTER_AREA), np.uint8)


def follow_pixels(
    last: NDArray[np.uint8],
    now: NDArray[np.uint8],
    width_px: int,
    uv_last_px: Array,
    uv_guess_px: Array,
) -> tuple[Array, NDArray[np.bool_]]:
    """Find pixels (N, 2) of one image in the next one, starting from a guess (N, 2).

    last, now: shrunk images; width_px: of the full ones, in whose pixels all positions are.
    Returns positions (N, 2) and whether each was found (N,).
    """
    scale = last.shape[1] / width_px
    start, guess = (
        ((uv + 0.5) * scale - 0.5).astype(np.float32).reshape(-1, 1, 2)
        for uv in (uv_last_px, uv_guess_px)
    )
    found_uv, status, _ = cv2.calcOpticalFlowPyrLK(
        last,
        now,
        start,
        guess,
        winSize=(WINDOW_PX, WINDOW_PX),
        maxLevel=LEVELS,
        criteria=STEPS,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    uv = (np.asarray(found_uv, np.float64).reshape(-1, 2) + 0.5) / scale - 0.5
    return uv, np.asarray(status).ravel() > 0
