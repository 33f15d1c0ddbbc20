"""What earlier keyframes know of the floor: one surface, fixed in the map.

The floor is tracked as a plane in the map. A keyframe whose camera has tilted, on a cart that
sways or by hand, still knows where to look for it; on a ramp the plane follows what is seen.
"""

from __future__ import annotations

import math

import numpy as np

from segfloor_ros.camera.model import Mount
from segfloor_ros.floor.plane import PlaneFit, angles_height_of
from segfloor_ros.floor.settings import FloorSegmentationSettings
from segfloor_ros.geometry import Array

_TILT_PER_M = math.radians(0.4)
"""How far a floor's slope drifts from what it was a metre ago, with SLAM's drift; one sigma."""
_CLIMB_PER_M = 0.01
_MAX_PRIOR_TILT_RAD = math.radians(5.0)
_MAX_PRIOR_HEIGHT = 0.15


class FloorTracker:
    """Predicts pitch, roll and height of the camera above the floor, keyframe by keyframe."""

    def __init__(self, settings: FloorSegmentationSettings) -> None:
        self._settings = settings
        self._normal_map = np.array([0.0, 0.0, 1.0])
        self._point_map = np.zeros(3)
        self._sigma: Array | None = None
        self._position: Array | None = None

    def predict(self, mount: Mount, T_map_base: Array | None) -> tuple[Array, Array]:
        """Return pitch, roll, height (3,) of the camera above the floor and their sigmas (3,).

        Without a pose they are the mount's.
        """
        level = self._level_sigma(mount)
        if T_map_base is None:
            return np.array([mount.pitch_rad, mount.roll_rad, mount.height_m]), level
        T_map_left = T_map_base @ mount.T_base_left
        normal = T_map_left[:3, :3].T @ self._normal_map
        height = float(self._normal_map @ (T_map_left[:3, 3] - self._point_map))
        if height <= 0.2 * mount.height_m:
            return np.array([mount.pitch_rad, mount.roll_rad, mount.height_m]), level
        if self._sigma is None or self._position is None:
            return angles_height_of(normal / height), level
        moved = float(np.linalg.norm(T_map_base[:3, 3] - self._position))
        drift = np.array([_TILT_PER_M, _TILT_PER_M, _CLIMB_PER_M]) * moved
        sigma = np.hypot(self._sigma, drift)
        limit = np.array([*[_MAX_PRIOR_TILT_RAD] * 2, _MAX_PRIOR_HEIGHT * mount.height_m])
        return angles_height_of(normal / height), np.clip(sigma, 0.3 * level, limit)

    def update(self, mount: Mount, T_map_base: Array | None, fit: PlaneFit) -> None:
        """Keep what a keyframe at T_map_base found."""
        if T_map_base is None:
            return
        T_map_left = T_map_base @ mount.T_base_left
        pitch, roll, height = fit.angles_height
        seen = Mount(float(height), float(pitch), float(roll))
        self._normal_map = T_map_left[:3, :3] @ seen.up_in_camera
        self._point_map = T_map_left[:3, 3] - height * self._normal_map
        self._sigma = fit.sigma
        self._position = T_map_base[:3, 3].copy()

    def _level_sigma(self, mount: Mount) -> Array:
        settings = self._settings
        tilt = settings.pitch_sigma_rad
        return np.array([tilt, tilt, settings.height_sigma * mount.height_m])
