"""Images of fewer pixels."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.model import is_disparity


def shrunk_image(image: NDArray[Any], factor: int) -> NDArray[Any]:
    """Return an image (H, W) at (H // factor, W // factor), each pixel the mean of a square; of a
    disparity, float32, one of its pixels.
    """
    height, width = image.shape[0] // factor, image.shape[1] // factor
    if is_disparity(image):
        half = factor // 2
        part = image[half::factor, half::factor][:height, :width]
        return np.ascontiguousarray(part / np.float32(factor))
    whole = image[: height * factor, : width * factor]
    return cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)
