"""A stereo pair in the forms that tracking works on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.blank_border import blank_border
from segfloor_ros.camera.depth import is_disparity
from segfloor_ros.camera.model import StereoCamera, StereoFrame
from segfloor_ros.slam.excluded import Region, dilate, join
from segfloor_ros.slam.optical_flow import shrink


@dataclass(frozen=True)
class Images:
    """left, right: rectified grey images (H, W) float32, for patches; of a depth camera its
    disparity for the right one, and depth_scale: disparity times depth, 0 of a stereo pair. small:
    the left one as optical flow takes it. excluded: where something moves, in the left image, and
    the black border that rectification leaves.
    """

    left: NDArray[np.float32]
    right: NDArray[np.float32]
    small: NDArray[np.uint8]
    excluded: Region | None = None
    depth_scale: float = 0.0

    @staticmethod
    def of(frame: StereoFrame, camera: StereoCamera, mask_dilation_px: int = 0) -> Images:
        """Prepare the images of a frame. mask_dilation_px: of the mask that came with it."""
        depth_scale = camera.disparity_times_depth if is_disparity(frame.right) else 0.0
        left, right = frame.left.astype(np.float32), frame.right.astype(np.float32)
        excluded = blank_border(frame.left)
        if frame.excluded is not None:
            excluded = join(excluded, dilate(frame.excluded, mask_dilation_px))
        return Images(left, right, shrink(frame.left), excluded, depth_scale)
