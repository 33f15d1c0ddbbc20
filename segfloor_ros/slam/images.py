"""A stereo pair in the forms that tracking works on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import StereoFrame
from segfloor_ros.slam.optical_flow import shrink


@dataclass(frozen=True)
class Images:
    """left, right: rectified grey images (H, W) float32, for patches. small: the left one as
    optical flow takes it.
    """

    left: NDArray[np.float32]
    right: NDArray[np.float32]
    small: NDArray[np.uint8]

    @staticmethod
    def of(frame: StereoFrame) -> Images:
        """Prepare the images of a frame."""
        left, right = frame.left.astype(np.float32), frame.right.astype(np.float32)
        return Images(left, right, shrink(frame.left))
