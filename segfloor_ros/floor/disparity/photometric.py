"""The floor tested on the images themselves.

Semi-global matching prefers surfaces that face the camera and, where texture is weak, agrees with
whatever repeats: the blocks of a compressed image, its neighbours. Here the right image is drawn
as it would look were everything floor, and compared with the left one. What then agrees about as
well as it does with the matched disparities cannot be said not to be floor. Texture, beyond the
noise of the image, says where a disparity means something.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.floor.disparity.matching import BLOCK_PX, SIGMAS
from segfloor_ros.floor.disparity.profile import FloorProfile
from segfloor_ros.floor.disparity.view import STEP_PX, FloorView
from segfloor_ros.floor.mask.pixel_evidence import Comparison

_WIDE_WINDOW = 15
"""What too little texture leaves open in a small window a larger one often tells."""
_AGAINST_GREY = 1.0
"""By how much the images must contradict the floor to deny it, beyond their noise."""
_LIKENESS_GREY = 3.0
"""How much left and right may differ on the floor, beyond their noise."""
_WIDE_RATIO = 1.15
_WIDE_MARGIN_GREY = 0.05
_WIDE_SHARE = 0.65
_MARGIN_PX = 4.0
"""So near to the right image's border interpolation is unsure."""
_NOISE_SHARE = 2.0
"""Two images of the same thing differ by 1.13 sigma of noise on average, and by interpolation."""

_SIGMA_PX = 2.0
_MIN_TEXTURE_GREY = 0.2
"""Below this slope of the image along a row, per pixel, a disparity says nothing."""
_NOISE_TEXTURE = 0.1
"""Texture per grey level of noise that is surely no noise: its own is 0.04."""
TEXTURE_WINDOW_PX = 11
"""Over so wide a square texture is measured."""
EDGE_SLOPE = 24
"""Sobel response of the weakest edge that counts: 3 grey levels per row."""


def compare(
    view: FloorView,
    profile: FloorProfile,
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    disparity: NDArray[np.float32],
    noise_grey: float,
) -> Comparison:
    """Compare the view's rows of a rectified pair under floor and under the disparities (R, W).

    left, right: whole image rows (R, image width). Where the right image does not reach,
    nothing speaks against the floor nor for it.
    """
    part = np.s_[::STEP_PX, :: STEP_PX // view.step]
    sampled = left[::STEP_PX, ::STEP_PX]
    steps = (np.arange(0, size, STEP_PX, dtype=np.float32) for size in left.shape)
    rows, columns = np.meshgrid(*steps, indexing='ij')
    floor_px = profile.at_pixels(view.derolled[part])
    matched_px = disparity[part]

    def difference(disparity_px: NDArray[np.float32]) -> NDArray[np.float32]:
        at = columns - disparity_px
        seen = cv2.remap(right, at, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return _local_difference(sampled, seen)

    floor, matched = difference(floor_px), difference(matched_px)
    margin = _AGAINST_GREY + 0.5 * noise_grey
    against = (matched_px > 0) & (floor > 1.3 * matched + np.float32(margin))
    unlike = floor > _LIKENESS_GREY + _NOISE_SHARE * noise_grey
    wide = (_WIDE_WINDOW, _WIDE_WINDOW)
    denied = cv2.blur(floor, wide) > _WIDE_RATIO * cv2.blur(matched, wide) + _WIDE_MARGIN_GREY
    worse = floor > 1.1 * matched
    denied &= (matched_px > 0) & worse
    denied &= cv2.blur(worse.astype(np.float32), wide) > _WIDE_SHARE
    contrary = against | (floor > 2 * _LIKENESS_GREY + _NOISE_SHARE * noise_grey)
    reached = columns >= floor_px + _MARGIN_PX
    contradicted = (against, denied, unlike)
    masks = (*(mask & reached for mask in contradicted), ~(contrary & reached))
    return Comparison(floor_px, *(_enlarged(mask, disparity.shape) for mask in masks))


def compare_measured(
    view: FloorView, profile: FloorProfile, disparity: NDArray[np.float32], noise_px: float
) -> Comparison:
    """Compare the floor with disparities (R, W) that a depth camera measured, 0 for none: there is
    no right image to look at. noise_px: of the disparities, one sigma.
    """
    floor_px = profile.at_pixels(view.derolled)
    against = (disparity > 0) & (np.abs(disparity - floor_px) > np.float32(SIGMAS * noise_px))
    part = np.s_[::STEP_PX, :: STEP_PX // view.step]
    return Comparison(floor_px[part], against, against, np.zeros_like(against), ~against)


def _local_difference(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the local mean absolute difference, free of differences in brightness."""
    difference = cv2.subtract(left, right, dtype=cv2.CV_32F)
    difference -= cv2.blur(difference, (BLOCK_PX, BLOCK_PX))
    return cv2.blur(np.abs(difference), (BLOCK_PX, BLOCK_PX))


def _enlarged(mask: NDArray[np.bool_], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    size = (shape[1], shape[0])
    return cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0


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
    return float(np.median(np.abs(response[:, ::4]))) / 0.6745 / float(np.linalg.norm(kernel))


def enough_texture(noise_grey: float) -> float:
    """Return the texture, in grey levels per pixel, that is surely no noise."""
    return max(_MIN_TEXTURE_GREY, _NOISE_TEXTURE * noise_grey)


def row_slope(image: NDArray[np.uint8]) -> NDArray[np.int16]:
    """Return how steep the image (H, W) is from row to row, as Sobel's response: 8 times the grey
    levels per row.
    """
    smooth = cv2.GaussianBlur(image, (3, 5), 0)
    slope: NDArray[np.int16] = np.abs(
        cv2.Sobel(smooth, cv2.CV_16S, 0, 1, borderType=cv2.BORDER_REPLICATE)
    )
    return slope
