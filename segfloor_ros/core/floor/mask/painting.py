"""What changes in a mask, and pictures of half its resolution."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.contracts import FLOOR, NO_EVIDENCE

LEAST_KNOWN = 0.2
"""What is known less well than this share says nothing."""


def with_floor(mask: NDArray[np.uint8], where: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return the mask (R, W) with floor where nothing is known and `where` (R, W) is set."""
    return _changed(mask, (mask == NO_EVIDENCE) & where)


def without_floor(mask: NDArray[np.uint8], where: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return the mask (R, W) with nothing known where it is floor and `where` (R, W) is set."""
    return _changed(mask, (mask == FLOOR) & where)


def _changed(mask: NDArray[np.uint8], where: NDArray[np.bool_]) -> NDArray[np.uint8]:
    return mask ^ (where.view(np.uint8) * np.uint8(NO_EVIDENCE ^ FLOOR))


def enlarged(picture: NDArray[np.bool_], like: NDArray[Any]) -> NDArray[np.bool_]:
    """Return a picture of half the resolution (h, w) in the size of another (R, W)."""
    size = (like.shape[1], like.shape[0])
    return cv2.resize(picture.view(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0


def mean_of_known(
    values: NDArray[np.float32], known: NDArray[np.float32], size: tuple[int, int]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the sum of values around each pixel (R, W) over how much is known there, and which
    share of a window of `size` (columns, rows) that is.
    """
    share = cv2.blur(known, size)
    return cv2.blur(values, size) / np.maximum(share, np.float32(LEAST_KNOWN)), share
