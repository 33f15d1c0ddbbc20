"""Rectified pairs at a fraction of their size, for what must be done at every frame."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.depth import is_disparity, shrunk_disparity
from segfloor_ros.camera.model import StereoCamera

SHRUNK_WIDTH_PX = 240


def shrink_factor(camera: StereoCamera) -> int:
    """Return by how much images of a camera are shrunk, at least 1."""
    return max(1, round(camera.width / SHRUNK_WIDTH_PX))


def shrunk(image: NDArray[Any], factor: int) -> NDArray[Any]:
    """Return an image (H, W) at (H // factor, W // factor), each pixel the mean of a square; of a
    disparity, float32, one of its pixels.
    """
    if is_disparity(image):
        return shrunk_disparity(image, factor)
    height, width = image.shape[0] // factor, image.shape[1] // factor
    whole = image[: height * factor, : width * factor]
    return cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA).astype(np.uint8)


def shrunk_camera(camera: StereoCamera, factor: int) -> StereoCamera:
    """Return the camera of shrunk images. Pixel centres are at whole numbers, so the principal
    point moves by half a pixel less than the size.
    """
    return StereoCamera(
        camera.width // factor,
        camera.height // factor,
        camera.fx / factor,
        camera.fy / factor,
        (camera.cx + 0.5) / factor - 0.5,
        (camera.cy + 0.5) / factor - 0.5,
        camera.baseline_m,
    )
