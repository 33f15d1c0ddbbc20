"""Compares the camera's mount in use with the one that the first keyframes show of the floor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import Mount, StereoCamera
from segfloor_ros.floor.plane.mount import MountEstimator, disagreement
from segfloor_ros.geometry import Array, invert

MAX_KEYFRAMES = 20
"""Where so many do not show the floor well enough, nothing is said."""


class MountCheck:
    """Measures the mount beside its use, once. A wrong one tilts the map or shifts its heights."""

    def __init__(self, camera: StereoCamera, mount: Mount) -> None:
        self._mount = mount
        self._estimator = MountEstimator(camera, forward_m=mount.forward_m, left_m=mount.left_m)
        self._T_first_map: Array | None = None
        self._keyframes = 0
        self.is_done = False

    def add(
        self, left: NDArray[np.uint8], right: NDArray[np.uint8], T_map_base: Array
    ) -> str | None:
        """Use a keyframe: rectified images (H, W) and the base's pose (4, 4). Returns in words how
        both mounts differ, with the numbers, once that is known.
        """
        T_map_left = T_map_base @ self._mount.T_base_left
        if self._T_first_map is None:
            self._T_first_map = invert(T_map_left)
        self._estimator.add(left, right, self._T_first_map @ T_map_left)
        self._keyframes += 1
        seen = self._estimator.mount
        self.is_done = seen is not None or self._keyframes >= MAX_KEYFRAMES
        return None if seen is None else disagreement(self._mount, seen)
