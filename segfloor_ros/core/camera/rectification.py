"""Rectification: epipolar lines become rows.

The block grid of JPEG images is smoothed first. Where texture is weaker than the quantisation a
block of 8 x 8 pixels becomes flat, and the steps between blocks are the strongest texture there is.
They stand still in the image: a stereo matcher finds them at the one disparity at which the grids
of both images coincide, however far away the surface is.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.calibration import EyeCalibration, StereoCalibration
from segfloor_ros.core.camera.model import is_disparity

Maps = tuple[NDArray[np.int16], NDArray[np.uint16]]

_BLOCK_PX = 8

_QUIET_GREY = 3

_SIGNIFICANT_GREY = 8
"""Larger steps are edges of things, wherever they are."""

_MIN_RATIO, _MIN_PIXELS = 1.5, 200
"""A grid is where steps across it are so many times as large, over so many pixels."""

_MAX_STEP_GREY = 16.0
"""Larger steps at the grid are left alone, too."""


class StereoRectifier:
    """Rectifies pairs of one calibration. The maps are computed once, in fixed point (a 32nd of
    a pixel); pairs that are rectified already keep their geometry.
    """

    def __init__(self, calibration: StereoCalibration) -> None:
        self.calibration = calibration
        self.camera = calibration.camera
        self._maps: tuple[Maps, Maps] | None = None
        if not calibration.is_rectified:
            self._maps = rectification_maps(calibration.left), rectification_maps(calibration.right)

    def rectify(
        self, left: NDArray[np.uint8], right: NDArray[Any]
    ) -> tuple[NDArray[np.uint8], NDArray[Any]]:
        """Return the rectified grey images (H, W) of a raw grey pair (H, W), uint8. A disparity in
        place of the right image is aligned with the left one.

        The block grid of compressed images is smoothed. Pixels that lie outside of the raw image
        are 0. Raises CalibrationError when the size is not the calibration's.
        """
        for side, image in (('the left image', left), ('the right image', right)):
            self.calibration.check_size(image.shape[1], image.shape[0], side)
        left, right = (im if is_disparity(im) else deblocked(im) for im in (left, right))
        if self._maps is None:
            return left, right
        left_maps, right_maps = self._maps
        rectified = cv2.remap(left, *left_maps, cv2.INTER_LINEAR)
        if is_disparity(right):
            nan = (float('nan'),)
            return rectified, cv2.remap(right, *left_maps, cv2.INTER_NEAREST, borderValue=nan)
        return rectified, cv2.remap(right, *right_maps, cv2.INTER_LINEAR)

    def rectify_colour(self, left: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the rectified left image (H, W, 3) of a raw one."""
        if self._maps is None:
            return left
        return np.asarray(cv2.remap(left, *self._maps[0], cv2.INTER_LINEAR), np.uint8)

    def rectify_mask(self, mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return a mask (H, W) of the raw left image on the rectified one: 255 where it is more
        than half, 0 elsewhere. Raises CalibrationError when the size is not the calibration's.
        """
        self.calibration.check_size(mask.shape[1], mask.shape[0], 'the mask of what moves')
        if self._maps is not None:
            mask = np.asarray(cv2.remap(mask, *self._maps[0], cv2.INTER_NEAREST), np.uint8)
        return np.where(mask > 127, np.uint8(255), np.uint8(0))


def rectification_maps(eye: EyeCalibration) -> Maps:
    """Return where each pixel of the rectified image is in the raw one, as fixed-point maps of
    `cv2.remap`.
    """
    size = (eye.width, eye.height)
    arguments = (eye.K, eye.D, eye.R, eye.P[:, :3].copy(), size, cv2.CV_16SC2)
    if eye.distortion_model != 'equidistant':
        maps = cv2.initUndistortRectifyMap(*arguments)
        return maps[0], maps[1]
    maps = cv2.fisheye.initUndistortRectifyMap(*arguments)
    maps[0][_is_beyond_lens(eye)] = np.iinfo(np.int16).min
    return maps[0], maps[1]


def _is_beyond_lens(eye: EyeCalibration) -> NDArray[np.bool_]:
    """Return which pixels (H, W) of the view of a fisheye lie further out than its model goes: up
    to where the radius in the raw image grows with the angle. What lies behind it would be a
    mirror image (Kannala and Brandt, A generic camera model, PAMI 2006).
    """
    angles = np.linspace(0, np.pi / 2, eye.width + eye.height)
    falling = np.flatnonzero(np.diff(angles * np.polyval([*eye.D[::-1], 1.0], angles**2)) <= 0)
    limit = angles[falling[0]] if len(falling) else np.pi / 2
    u, v = np.meshgrid(np.arange(eye.width), np.arange(eye.height))
    pixels = np.stack([u, v, np.ones_like(u)], axis=-1)
    rays = pixels @ np.linalg.inv(eye.P[:, :3]).T @ eye.R
    return np.asarray(np.arctan2(np.hypot(rays[..., 0], rays[..., 1]), rays[..., 2]) > limit)


def deblocked(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a raw grey image (H, W) with the steps between flat blocks smoothed, the image itself
    where it shows no block grid.

    The grid is that of the compressed image: not to be used on rectified ones.
    """
    if not is_blocky(image):
        return image
    smooth = image.astype(np.float32)
    _smooth_columns(smooth)
    _smooth_columns(smooth.T)
    return np.clip(np.rint(smooth), 0, 255).astype(np.uint8)


def is_blocky(image: NDArray[np.uint8]) -> bool:
    """Return whether quiet parts of a grey image (H, W) have larger steps on the grid of eight
    pixels than within its blocks, along the rows or along the columns.
    """
    half = _BLOCK_PX // 2
    return max(_blockiness(image[::half]), _blockiness(image[:, ::half].T)) > _MIN_RATIO


def _blockiness(image: NDArray[np.uint8]) -> float:
    """Return the ratio of the mean step across the borders of blocks to that in their middle."""
    grey = image.astype(np.int16)

    def mean_step(first: int) -> float:
        before, at, after, beyond = (
            grey[:, first + i : grey.shape[1] - 8 + i : _BLOCK_PX] for i in (-2, -1, 0, 1)
        )
        quiet = (np.abs(at - before) < _QUIET_GREY) & (np.abs(beyond - after) < _QUIET_GREY)
        step = np.abs(after - at)
        quiet &= step <= _SIGNIFICANT_GREY
        return float(step[quiet].mean()) if np.count_nonzero(quiet) >= _MIN_PIXELS else 0.0

    within = 0.5 * (mean_step(_BLOCK_PX + 3) + mean_step(_BLOCK_PX + 5))
    return mean_step(_BLOCK_PX) / max(within, 0.1)


def _smooth_columns(grey: NDArray[np.float32]) -> None:
    """Turn the steps between the columns of two blocks into ramps, in place.

    Only steps that are larger than what goes on in the half blocks beside them.
    """
    half = _BLOCK_PX // 2
    last = grey.shape[1] - half + 1

    def column(offset: int) -> NDArray[np.float32]:
        return grey[:, _BLOCK_PX + offset : last + offset : _BLOCK_PX]

    step = column(0) - column(-1)
    size = np.abs(step)
    activity = np.abs(column(-1) - column(-half))
    activity += np.abs(column(half - 1) - column(0))
    step[(size >= _MAX_STEP_GREY) | (activity >= np.maximum(size, 2))] = 0
    for i in range(half):
        share = step * np.float32(0.5 - (i + 0.5) / _BLOCK_PX)
        before, after = column(-1 - i), column(i)
        before += share
        after -= share
