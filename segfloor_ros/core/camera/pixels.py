"""Grey images, masks and disparities as arrays: borders, noise, sizes."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros import MAX_PIXELS
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.geometry import Array

Region = NDArray[np.uint8]
"""A mask (H, W) uint8 of the left image, 255 where something is left out, e.g. moves."""

JPEG_QUALITY = 90
"""Above this, JPEG images grow much faster than they improve."""

SUBPIXEL = 16
"""OpenCV's semi-global disparities are in 1/16 px, and their number is a multiple of as many."""

_STEP_PX = 2

_MARGIN_PX = 12
"""Blocks that are matched and windows of texture reach so far: the border's edge is no texture."""

_BLACK = 2
"""So bright a black border is at most: JPEG is not exact."""

_SURELY = 3
"""What was seen so often to be bright is part of the scene."""

_LEAST_PX = 40
"""Black pixels of the scene that touch the image's edge are fewer, at half the resolution."""

SIGMA_PER_M = 0.0025
"""Error of a depth, in metres per square metre (Khoshelham and Elberink, Accuracy and resolution of
Kinect depth data, Sensors 2012: 0.0014 to 0.0029)."""

SIGMA_M = 0.002
"""Error of any depth: steps of a millimetre, and a registration that is not perfect."""

SAME_SURFACE_SHARE = 0.05
"""Depths around a pixel that differ by more are those of two surfaces."""

Disparity = NDArray[np.float32]


def union(a: Region | None, b: Region | None) -> Region | None:
    """Return the region that is in either; None for none at all."""
    if a is None or b is None:
        return b if a is None else a
    return np.maximum(a, b)


class BlankBorder:
    """The black border that rectification leaves in the images of one eye: what is black, joined to
    an edge, and was never seen to be anything else. A dark thing at the edge moves on.
    """

    def __init__(self) -> None:
        self._shape: tuple[int, ...] = ()

    def see(self, image: NDArray[np.uint8]) -> Region | None:
        """Take in a rectified grey image (H, W). Returns a mask (H, W) uint8, 255 in the border and
        near it, or None where there is none.
        """
        is_black = image[::_STEP_PX, ::_STEP_PX] <= _BLACK
        if self._shape != image.shape:
            self._shape, self._black = image.shape, np.zeros(0, np.uint8)
            self._times_bright = np.zeros(is_black.shape, np.uint8)
        # A single image may be spoilt.
        bright = self._times_bright
        bright[~is_black & (bright < _SURELY)] += 1
        black = (is_black & (bright < _SURELY)).astype(np.uint8)
        if not np.array_equal(black, self._black):
            self._black, self._region = black, _border(black, image.shape)
        return self._region


def _border(black: NDArray[np.uint8], shape: tuple[int, ...]) -> Region | None:
    """Return what is black (h, w), 0 or 1, along the edges, and a margin around it, as a mask of an
    image of a shape (H, W); None for nothing.
    """
    edges = (black[0], black[-1], black[:, 0], black[:, -1])
    if sum(int(np.count_nonzero(edge)) for edge in edges) < _LEAST_PX:
        return None
    _, label, stats, _ = cv2.connectedComponentsWithStats(black, connectivity=4)
    touching = np.unique(np.concatenate([label[0], label[-1], label[:, 0], label[:, -1]]))
    large = touching[(touching > 0) & (stats[touching, cv2.CC_STAT_AREA] >= _LEAST_PX)]
    if len(large) == 0:
        return None
    chosen = np.zeros(len(stats), np.uint8)
    chosen[large] = 255
    size = _MARGIN_PX // _STEP_PX * 2 + 1
    border = cv2.dilate(chosen[label], np.ones((size, size), np.uint8))
    return np.asarray(cv2.resize(border, shape[::-1], interpolation=cv2.INTER_NEAREST), np.uint8)


def disparity_at(disparity: Disparity, camera_depth: float, uv_px: Array) -> tuple[Array, Array]:
    """Return the disparity (N,) at pixels (N, 2), the median of the neighbours, and its standard
    deviation (N,); NaN at holes and where two surfaces meet. camera_depth: disparity times depth.
    """
    height, width = disparity.shape
    columns, rows = np.rint(uv_px).astype(np.intp).T
    steps = np.array([-1, 0, 1])
    around = disparity[
        np.clip(rows[:, None, None] + steps[:, None], 0, height - 1),
        np.clip(columns[:, None, None] + steps, 0, width - 1),
    ].reshape(len(uv_px), 9)
    found = np.full(len(uv_px), np.nan)
    whole = np.isfinite(around).sum(axis=1) >= 6
    near = around[whole].astype(np.float64)
    middle = np.nanmedian(near, axis=1) if len(near) else np.zeros(0)
    spread = np.nanmax(near, axis=1) - np.nanmin(near, axis=1) if len(near) else np.zeros(0)
    found[whole] = np.where(spread < SAME_SURFACE_SHARE * middle, middle, np.nan)
    return found, measured_sigma_px(camera_depth, found)


def measured_sigma_px(camera_depth: float, disparity_px: Array) -> Array:
    """Return the error (N,), one sigma, of the disparities (N,) of a depth camera. camera_depth:
    disparity times depth.
    """
    sigma: Array = np.hypot(camera_depth * SIGMA_PER_M, SIGMA_M * disparity_px**2 / camera_depth)
    return sigma


def shrunk(disparity: Disparity, size: tuple[int, int]) -> Disparity:
    """Return the disparity of an image shrunk to `size` (width, height), in its own pixels, 0 where
    there is none.
    """
    factor = size[0] / disparity.shape[1]
    small = cv2.resize(disparity, size, interpolation=cv2.INTER_NEAREST)
    return np.nan_to_num(small * np.float32(factor), nan=0.0).astype(np.float32)


def noise_grey(image: NDArray[np.uint8]) -> float:
    """Return the standard deviation of the image noise in grey levels.

    Immerkaer, Fast Noise Variance Estimation (1996), with a median in place of the mean, so that
    texture does not count.
    """
    part = image[::2]
    kernel = np.outer([1.0, -2.0, 1.0], [1.0, -2.0, 1.0])
    response = cv2.filter2D(part, cv2.CV_16S, kernel)
    return float(np.median(np.abs(response[:, ::4]))) / 0.6745 / float(np.linalg.norm(kernel))


Grey = NDArray[np.uint8] | NDArray[np.uint16]
"""A grey image (H, W), uint8 or uint16."""


def check_size(width: int, height: int, name: str) -> None:
    """Raise InputError for an image that is larger than any camera's."""
    if width * height > MAX_PIXELS:
        raise InputError(f'{name}: an image of {width}x{height} pixels is not taken')
