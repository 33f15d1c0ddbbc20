"""How far the camera turned since the last image, from the images alone.

On a thumbnail a rotation looks like a shift. It is found without features by phase
correlation, so that tracking survives a turn that its motion model did not foresee (the "small
blurry image" of Klein and Murray, Improving the Agility of Keyframe-Based SLAM, 2008).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.geometry import Array, make_transform

THUMBNAIL_WIDTH_PX = 80
MIN_RESPONSE = 0.05


class ImageRotation:
    """Compares each image with the one before."""

    def __init__(self, camera: StereoCamera) -> None:
        self._scale = THUMBNAIL_WIDTH_PX / camera.width
        height = max(8, round(camera.height * self._scale))
        self._size = (THUMBNAIL_WIDTH_PX, height)
        self._window = cv2.createHanningWindow(self._size, cv2.CV_32F)
        self._focal = (camera.fx * self._scale, camera.fy * height / camera.height)
        self._last: NDArray[np.float32] | None = None
        self._now: NDArray[np.float32] | None = None

    def see(self, image: NDArray[np.float32]) -> None:
        """Take in the next image (H, W)."""
        small = cv2.resize(image, self._size, interpolation=cv2.INTER_AREA)
        self._last, self._now = self._now, np.asarray(cv2.GaussianBlur(small, (0, 0), 0.75))

    def turn_since_last(self) -> Array:
        """Return T_now_last (4, 4) between the last two images, a rotation about the camera's
        centre.

        The identity where there was no image before, or where the two have too little in common.
        """
        if self._last is None or self._now is None:
            return np.eye(4)
        (du, dv), response = cv2.phaseCorrelate(self._last, self._now, self._window)
        if response < MIN_RESPONSE:
            return np.eye(4)
        # A scene point that moves right by du lies further to the right now: it turned about +y.
        angles = [-np.arctan2(dv, self._focal[1]), np.arctan2(du, self._focal[0]), 0.0]
        return make_transform(Rotation.from_euler('xyz', angles).as_matrix(), np.zeros(3))
