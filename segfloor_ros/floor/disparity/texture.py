"""Where the image has enough texture for a disparity to mean something."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_SIGMA_PX = 2.0
MIN_TEXTURE_GREY = 0.2
"""Below this slope of the image along a row, per pixel, a disparity says nothing."""
NOISE_TEXTURE = 0.1
"""Texture per grey level of noise that is surely no noise: its own is 0.04."""
_LAPLACIAN_GAIN = 6.0
EDGE_SLOPE = 24
"""Sobel response of the weakest edge that counts: 3 grey levels per row."""


def texture_grey(image: NDArray[np.uint8], window_px: int) -> NDArray[np.float32]:
    """Return the mean absolute slope (H, W) along the row in grey levels per pixel.

    Slopes are taken on a scale of two pixels, where sensor noise has averaged out; only slopes
    along the row tell a stereo pair anything.
    """
    radius = int(3 * _SIGMA_PX)
    x = np.arange(-radius, radius + 1, dtype=np.float64)
    smooth = np.exp(-0.5 * (x / _SIGMA_PX) ** 2)
    smooth /= smooth.sum()
    slope = x * smooth
    slope /= (x * slope).sum()
    # sepFilter2D correlates: a positive slope gives a positive response.
    response = cv2.sepFilter2D(image, cv2.CV_32F, slope, smooth)
    return cv2.blur(np.abs(response), (window_px, window_px))


def noise_grey(image: NDArray[np.uint8]) -> float:
    """Return the standard deviation of the image noise in grey levels.

    Immerkaer, Fast Noise Variance Estimation (1996), with a median in place of the mean, so that
    texture does not count.
    """
    part = image[::2]
    kernel = np.outer([1.0, -2.0, 1.0], [1.0, -2.0, 1.0])
    response = cv2.filter2D(part, cv2.CV_32F, kernel)
    return float(np.median(np.abs(response[:, ::4]))) / 0.6745 / _LAPLACIAN_GAIN


def row_slope(image: NDArray[np.uint8]) -> NDArray[np.int16]:
    """Return how steep the image (H, W) is from row to row, as Sobel's response: 8 times the grey
    levels per row.
    """
    smooth = cv2.GaussianBlur(image, (3, 5), 0)
    slope: NDArray[np.int16] = np.abs(
        cv2.Sobel(smooth, cv2.CV_16S, 0, 1, borderType=cv2.BORDER_REPLICATE)
    )
    return slope
