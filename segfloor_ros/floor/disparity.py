"""Disparity by semi-global matching.

Hirschmüller, Stereo Processing by Semiglobal Matching and Mutual Information (2008); OpenCV's
block variant with three path directions.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import Mount, StereoCamera
from segfloor_ros.floor.settings import FloorSegmentationSettings

SUBPIXEL = 16
"""Steps per pixel of the matcher's fixed-point disparities."""

_STEP = 16
_SAME_GAIN = 0.08
_SAME_MEAN_GREY = 8.0
"""Within this the two cameras are exposed alike; what they see differs anyway."""


def disparity_range(camera: StereoCamera, mount: Mount | None, share: float = 1.15) -> int:
    """Return how many disparities must be searched, a multiple of 16.

    The nearest floor is in the image's lower corners; `share` leaves room for what stands in
    front of it. Without a mount a quarter of the image width is searched.
    """
    if mount is None:
        wanted = camera.width / 4
    else:
        up = mount.up_in_camera
        v = (camera.height - 1 - camera.cy) / camera.fy
        u = (np.array([0.0, camera.width - 1.0]) - camera.cx) / camera.fx
        inverse_depth = -(up[0] * u + up[1] * v + up[2]) / mount.height_m
        wanted = float(inverse_depth.max()) * camera.disparity_times_depth * share
    most = camera.width // 2 // _STEP * _STEP
    return int(np.clip(math.ceil(wanted / _STEP) * _STEP, 2 * _STEP, max(2 * _STEP, most)))


def equal_exposure(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the right image with the left one's mean and contrast, where they clearly differ."""
    (mean_l, spread_l), (mean_r, spread_r) = cv2.meanStdDev(left), cv2.meanStdDev(right)
    gain = float(np.clip(spread_l[0, 0] / max(float(spread_r[0, 0]), 1.0), 0.5, 2.0))
    offset = float(mean_l[0, 0]) - gain * float(mean_r[0, 0])
    if abs(gain - 1) < _SAME_GAIN and abs(float(mean_l[0, 0] - mean_r[0, 0])) < _SAME_MEAN_GREY:
        return right
    adapted = right.astype(np.float32) * np.float32(gain) + np.float32(offset)
    return np.clip(np.rint(adapted), 0, 255).astype(np.uint8)


class DisparityMatcher:
    """Semi-global matching of one camera at a given range."""

    def __init__(self, num_disparities: int, settings: FloorSegmentationSettings) -> None:
        self.num_disparities = num_disparities
        area = settings.block_size_px**2
        self._matcher = cv2.StereoSGBM_create(
            minDisparity=0,
            numDisparities=num_disparities,
            blockSize=settings.block_size_px | 1,
            P1=settings.smoothness_small * area,
            P2=max(settings.smoothness_large, settings.smoothness_small + 1) * area,
            disp12MaxDiff=settings.left_right_tolerance_px,
            preFilterCap=31,
            uniquenessRatio=settings.uniqueness_percent,
            speckleWindowSize=settings.speckle_size_px,
            speckleRange=2,
            mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )

    def compute(self, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the disparities (H, W) float32 in pixels of a rectified pair (H, W) uint8.

        0 where there is no match. The matcher leaves its first columns empty, so both images
        are padded on the left and the padding is cut off again.
        """
        pad = self.num_disparities
        padded = [
            cv2.copyMakeBorder(image, 0, 0, pad, 0, cv2.BORDER_REPLICATE) for image in (left, right)
        ]
        fixed_point = self._matcher.compute(padded[0], padded[1])[:, pad:]
        disparity = np.maximum(fixed_point, 0).astype(np.float32) / np.float32(SUBPIXEL)
        # A match outside the right image is a match with the padding.
        columns = np.arange(disparity.shape[1], dtype=np.float32)
        disparity[disparity > columns + 0.5] = 0
        return disparity
