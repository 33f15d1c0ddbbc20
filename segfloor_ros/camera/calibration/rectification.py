"""Rectification of stereo pairs: epipolar lines become rows; and whether a pair is rectified."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.calibration.parameters import EyeCalibration, StereoCalibration
from segfloor_ros.camera.deblocking import deblocked
from segfloor_ros.camera.depth import is_disparity

Maps = tuple[NDArray[np.int16], NDArray[np.uint16]]

FEATURES = 800

LEVELS = 2

MIN_MATCHES = 40

BEST_SHARE = 0.5

MAX_DISPARITY_SHARE = 0.4

MAX_ROWS_APART_SHARE = 0.15


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
    if eye.distortion_model == 'equidistant':
        maps = cv2.fisheye.initUndistortRectifyMap(*arguments)
    else:
        maps = cv2.initUndistortRectifyMap(*arguments)
    return maps[0], maps[1]


def rows_apart_px(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> tuple[float, int] | None:
    """Return by how many rows matching corners of two grey images (H, W) differ, in the median, and
    how many they are; None where too few match to tell.
    """
    orb = cv2.ORB_create(FEATURES, nlevels=LEVELS)
    (left_points, left_words), (right_points, right_words) = (
        orb.detectAndCompute(image, None) for image in (left, right)
    )
    if left_words is None or right_words is None:
        return None
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(left_words, right_words)
    matches = sorted(matches, key=lambda m: m.distance)[: round(BEST_SHARE * len(matches))]
    apart = np.array(
        [np.subtract(left_points[m.queryIdx].pt, right_points[m.trainIdx].pt) for m in matches]
    ).reshape(-1, 2)
    height, width = left.shape
    possible = (apart[:, 0] > -2) & (apart[:, 0] < MAX_DISPARITY_SHARE * width)
    possible &= np.abs(apart[:, 1]) < MAX_ROWS_APART_SHARE * height
    if possible.sum() < MIN_MATCHES:
        return None
    return float(np.median(np.abs(apart[possible, 1]))), int(possible.sum())
