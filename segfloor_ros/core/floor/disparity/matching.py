"""Disparity by semi-global matching.

Hirschmüller, Stereo Processing by Semiglobal Matching and Mutual Information (2008); OpenCV's
block variant with three path directions. What is near is matched at half the resolution: there
disparities are large, and an error of twice as many pixels is still a small share of them.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.camera.pixels import SUBPIXEL
from segfloor_ros.core.camera.shrinking import shrunk_image
from segfloor_ros.core.contracts import Mount
from segfloor_ros.core.geometry import Array

NOISE_PX = 0.5
"""Error of a disparity, one sigma."""
MEAN_NOISE = 0.35
"""Error of the mean, or median, of neighbours as a share of that of one: they err together."""
SIGMAS = 2.0
"""What differs by more sigmas is something else: one in twenty does by chance."""
SAME_PX = SIGMAS * NOISE_PX
"""Disparities that differ by no more may be of the same surface."""
BLOCK_PX = 5
"""Side of the block that is matched."""
SPECKLE_PX = 60
"""Islands of fewer pixels are dropped."""
_SMALL_STEP, _LARGE_STEP = 8, 32
"""Penalties P1 of a disparity step of one and P2 of a larger one, per pixel of the block."""
_UNIQUENESS_PERCENT = 5
"""How much better than the second the best match must be."""

_SAME_GAIN, _SAME_MEAN_GREY = 0.08, 8.0
"""Within this the two cameras are exposed alike; what they see differs anyway."""
COARSE_BLOCK_PX = 3
COARSE_ABOVE_PX = 28.0
"""Where the floor has a larger disparity, images are matched at half the resolution."""
_FINE_BLOCK = (9, 9)
"""Columns and rows of the block in which a disparity is refined."""
NOISE_SLOPE = 0.03
"""Square of the slope between pixels, of the mean of a smoothed pair, that noise of one grey level
has."""
_OVERLAP_PX = 4
"""So near to the end of its range the fine match leaves what is nearer to the coarse one."""
RUN_UP_ROWS = 16
"""The matcher's paths get a run-up, and the horizon some play."""


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
    most = camera.width // 2 // SUBPIXEL * SUBPIXEL
    least = 2 * SUBPIXEL
    return int(np.clip(math.ceil(wanted / SUBPIXEL) * SUBPIXEL, least, max(least, most)))


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

    def __init__(
        self,
        num_disparities: int,
        block_px: int = BLOCK_PX,
        speckle_px: int = SPECKLE_PX,
        mode: int = cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        left_right_check: bool = True,
    ) -> None:
        self.num_disparities = num_disparities
        area = block_px**2
        # OpenCV takes what is not positive for 1.
        tolerance = round(SAME_PX) if left_right_check else num_disparities
        self._matcher = cv2.StereoSGBM_create(
            minDisparity=0,
            numDisparities=num_disparities,
            blockSize=block_px,
            P1=_SMALL_STEP * area,
            P2=_LARGE_STEP * area,
            disp12MaxDiff=tolerance,
            preFilterCap=31,
            uniquenessRatio=_UNIQUENESS_PERCENT,
            speckleWindowSize=speckle_px,
            speckleRange=2,
            mode=mode,
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


def refined(
    left: NDArray[np.uint8],
    right: NDArray[np.uint8],
    disparity: NDArray[np.float32],
    noise_grey: float,
    at: tuple[NDArray[np.integer], NDArray[np.integer]],
) -> tuple[Array, Array, Array, Array]:
    """Return what the blocks around rows and columns `at`, (N,) each, show of a pair (H, W) by
    least squares on its grey levels, near disparities (H, W) that were matched: rows, columns and
    disparities (N,) of their texture, and the standard deviation of these, in pixels: infinite
    where both do not agree.

    Lucas and Kanade, An Iterative Image Registration Technique (1981), along the row, with grey
    levels that are off by a constant; its error by the bound of Cramer and Rao. noise_grey: of the
    images.
    """
    height, width = left.shape
    columns, rows = np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)
    smooth, smooth_right = (
        cv2.GaussianBlur(image, (3, 3), 0).astype(np.float32) for image in (left, right)
    )
    down = np.repeat(rows[:, None], width, axis=1)
    across = columns - disparity
    warped = cv2.remap(smooth_right, across, down, cv2.INTER_LINEAR)
    derivative, once = np.array([-0.25, 0.0, 0.25]), np.ones(1)
    slope = cv2.sepFilter2D(smooth + warped, cv2.CV_32F, derivative, once)
    known = ((disparity > 0) & (across >= 1)).astype(np.float32)
    slope *= known
    step = (smooth - warped) * known

    def in_block(values: NDArray[np.floating]) -> Array:
        return cv2.boxFilter(values, -1, _FINE_BLOCK, normalize=False)[at].astype(np.float64)

    squared = slope * slope
    count, by_slope = np.maximum(in_block(known), 1), in_block(slope)
    power = np.maximum(in_block(squared), 1e-3)
    # Noise has slopes, too: they are no information.
    noise = count * NOISE_SLOPE * noise_grey**2
    information = np.maximum(power - by_slope**2 / count - noise, 1e-3)
    shift = (in_block(slope * step) - by_slope * in_block(step) / count) / information
    matched = in_block(squared * disparity) / power
    shown_row = in_block(squared * rows[:, None]) / power
    shown_column = in_block(squared * columns) / power
    sigma = noise_grey * np.sqrt(2 / information)
    sigma[np.abs(shift) > SAME_PX] = np.inf
    return shown_row, shown_column, matched - shift, sigma


class TwoScaleMatcher:
    """Matches far floor at full resolution and all else at half of it.

    num_disparities: searched, a multiple of 16; one more step of 16 where it takes two scales.
    """

    def __init__(self, num_disparities: int, coarse_above_px: float = COARSE_ABOVE_PX) -> None:
        fine = math.ceil((coarse_above_px + _OVERLAP_PX) / SUBPIXEL) * SUBPIXEL
        self._coarse: DisparityMatcher | None = None
        self.num_disparities = num_disparities
        if fine + SUBPIXEL < num_disparities:
            halved = -(-num_disparities // (2 * SUBPIXEL)) * SUBPIXEL
            self._coarse = DisparityMatcher(halved, COARSE_BLOCK_PX, SPECKLE_PX // 4)
            self.num_disparities = 2 * self._coarse.num_disparities
        else:
            fine = num_disparities
        self._fine = DisparityMatcher(fine)

    def compute(
        self, left: NDArray[np.uint8], right: NDArray[np.uint8], fine_rows: int
    ) -> NDArray[np.float32]:
        """Return the disparities (H, W) float32 in pixels of a rectified pair (H, W) uint8, 0 where
        there is no match.

        fine_rows: so many rows at the top are matched at full resolution, unless what they show is
        too near for that.
        """
        if self._coarse is None:
            return self._fine.compute(left, right)
        found = self._coarse.compute(*(shrunk_image(image, 2) for image in (left, right)))
        found = 2 * found.repeat(2, axis=0).repeat(2, axis=1)
        disparity = np.zeros(left.shape, np.float32)
        disparity[: found.shape[0], : found.shape[1]] = found
        if fine_rows == 0:
            return disparity
        # The matcher's blocks and paths reach beyond the last fine row.
        part = slice(0, fine_rows + RUN_UP_ROWS // 2)
        far = self._fine.compute(left[part], right[part])[:fine_rows]
        near = disparity[:fine_rows]
        too_near = near > self._fine.num_disparities - _OVERLAP_PX
        disparity[:fine_rows] = np.where(too_near, near, far)
        return disparity
