"""What earlier keyframes know of the floor: one surface, fixed in the map.

How the floor lies in the map is followed from keyframe to keyframe, so that a camera that sways,
on a cart or in a hand, still knows where to look. The camera's height above it is the mount's:
the robot stands on the floor, whatever height SLAM has drifted to.
"""

from __future__ import annotations

import numpy as np

from segfloor_ros.camera.model import Mount
from segfloor_ros.floor.plane import PlaneFit, angles_height_of
from segfloor_ros.floor.settings import FloorSegmentationSettings
from segfloor_ros.geometry import Array

_FULL_SUPPORT = 0.5
"""From this support on a keyframe counts in full."""
_NEW_SHARE = 0.3
"""So much of the floor's direction in the map comes from the newest keyframe, at most."""


class FloorTracker:
    """Predicts pitch, roll and height of the camera above the floor, keyframe by keyframe."""

    def __init__(self, settings: FloorSegmentationSettings) -> None:
        self._settings = settings
        self._normal_map = np.array([0.0, 0.0, 1.0])

    def predictions(self, mount: Mount, T_map_base: Array | None) -> Array:
        """Return what to expect, (P, 3) of pitch, roll and height, the likeliest first.

        By the floor's direction in the map, where the pose is known; else, or on a slope of
        its own, as the camera is mounted.
        """
        mounted = np.array([mount.pitch_rad, mount.roll_rad, mount.height_m])
        if T_map_base is None:
            return mounted[None]
        R_map_left = T_map_base[:3, :3] @ mount.T_base_left[:3, :3]
        normal = R_map_left.T @ self._normal_map
        return np.stack([angles_height_of(normal / mount.height_m), mounted])

    def sigma(self, mount: Mount) -> Array:
        """Return how far pitch, roll and height (3,) may be from a prediction."""
        tilt = self._settings.pitch_sigma_rad
        return np.array([tilt, tilt, self._settings.height_sigma * mount.height_m])

    def update(self, mount: Mount, T_map_base: Array | None, fit: PlaneFit) -> None:
        """Keep what a keyframe at T_map_base found."""
        if T_map_base is None:
            return
        pitch, roll, height = (float(value) for value in fit.angles_height)
        seen = (
            T_map_base[:3, :3] @ mount.T_base_left[:3, :3] @ Mount(height, pitch, roll).up_in_camera
        )
        share = _NEW_SHARE * min(fit.support / _FULL_SUPPORT, 1.0)
        normal = (1 - share) * self._normal_map + share * seen
        self._normal_map = normal / np.linalg.norm(normal)
