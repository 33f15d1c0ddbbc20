"""The motion of the camera: where it is, where it will be next, and the continuous frame `odom`."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from segfloor_ros.geometry import (
    Array,
    invert,
    make_transform,
    rotation_angle,
    se3_exp,
    se3_log,
)

MAX_TURN_RADPS = 6.0
"""A robot does not spin faster than once a second."""

MIN_STEP_S = 1e-3


class CameraMotion:
    """Constant velocity between frames (Mur-Artal et al., ORB-SLAM, 2015, section V-B).

    T_camera_world: the latest pose (4, 4). T_world_odom: the correction of the odometry; both
    frames are the camera's first pose. is_lost: whether the last frame had no pose.
    """

    def __init__(self, max_speed_mps: float) -> None:
        self.T_camera_world: Array = np.eye(4)
        self.T_world_odom: Array = np.eye(4)
        self.is_lost = False
        self._max_speed_mps = max_speed_mps
        self._velocity: Array = np.zeros(6)
        self._last_stamp_ns = 0

    @property
    def T_odom_camera(self) -> Array:
        """The camera in the continuous frame."""
        return invert(self.T_world_odom) @ invert(self.T_camera_world)

    def predict(self, stamp_ns: int) -> Array:
        """Return where the camera will be if it moves on as it did, T_camera_world (4, 4)."""
        return se3_exp(self._velocity * self._step_s(stamp_ns)) @ self.T_camera_world

    def is_plausible(self, T_camera_world: Array, stamp_ns: int) -> bool:
        """Whether a robot can have come to a pose since the last frame."""
        motion = T_camera_world @ invert(self.T_camera_world)
        step_s = self._step_s(stamp_ns)
        speed = float(np.linalg.norm(motion[:3, 3])) / step_s
        turn = rotation_angle(motion[:3, :3]) / step_s
        return speed <= self._max_speed_mps and turn <= MAX_TURN_RADPS

    def take(self, T_camera_world: Array, stamp_ns: int) -> None:
        """Go on from the pose of a frame."""
        motion = se3_log(T_camera_world @ invert(self.T_camera_world))
        self._velocity = np.zeros(6) if self.is_lost else motion / self._step_s(stamp_ns)
        self.T_camera_world = T_camera_world
        self._last_stamp_ns = stamp_ns
        self.is_lost = False

    def stop(self) -> None:
        """Note that a frame has no pose."""
        self._velocity = np.zeros(6)
        self.is_lost = True

    def move_map(self, T_reference_before: Array, T_reference_after: Array) -> None:
        """Move the camera along with a keyframe (T_camera_world, (4, 4)) that the map has moved;
        `odom` stays where the camera sees it.
        """
        T_odom_camera = self.T_odom_camera
        T_camera_reference = self.T_camera_world @ invert(T_reference_before)
        self.T_camera_world = _without_drift(T_camera_reference @ T_reference_after)
        self.T_world_odom = _without_drift(invert(self.T_camera_world) @ invert(T_odom_camera))

    def _step_s(self, stamp_ns: int) -> float:
        return max((stamp_ns - self._last_stamp_ns) * 1e-9, MIN_STEP_S)


def _without_drift(T: Array) -> Array:
    """Return a product of poses (4, 4) with its rotation orthonormal again: `invert` transposes,
    so the rounding errors of repeated products would grow threefold each time.
    """
    return make_transform(Rotation.from_matrix(T[:3, :3]).as_matrix(), T[:3, 3])
