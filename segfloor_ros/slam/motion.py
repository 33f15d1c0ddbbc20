"""The motion of the camera: where it is, where it will be next, and the continuous frame `odom`."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from segfloor_ros.geometry import (
    Array,
    adjoint,
    invert,
    make_transform,
    rotation_angle,
    se3_exp,
    se3_log,
)
from segfloor_ros.slam.body_motion import BodyMotion, RelativeMotion

MAX_TURN_RADPS = 6.0
"""A robot does not spin faster than once a second."""

MIN_STEP_S = 1e-3

MAX_COASTING_NS = 1_000_000_000
"""A camera whose turn is measured, but not its way, goes on at constant velocity for so long."""

SIGMA_COASTING_M_S = 0.3
"""Error of a velocity that is taken for constant."""

CONSISTENT_CHI2 = 22.46
"""Bound on the difference between images and sensors: 99.9 % of six degrees of freedom."""


class CameraMotion:
    """Measured by wheels and gyroscope, or else taken for constant velocity between frames
    (Mur-Artal et al., ORB-SLAM, 2015, section V-B).

    T_camera_world: the latest pose (4, 4). covariance: (6, 6) of its twist. T_world_odom: the
    correction of the odometry; both frames are the camera's first pose. is_lost: whether the last
    frame had no pose. carried_by: the sensor that told the last pose alone, or ''.
    """

    def __init__(self, max_speed_mps: float, body: BodyMotion) -> None:
        self._body = body
        self._max_speed_mps = max_speed_mps
        self.reset()

    def reset(self) -> None:
        """Begin at the origin."""
        self.T_camera_world: Array = np.eye(4)
        self.covariance: Array = np.zeros((6, 6))
        self.T_world_odom: Array = np.eye(4)
        self.is_lost = False
        self.carried_by = ''
        self._velocity: Array = np.zeros(6)
        self._last_stamp_ns = 0
        self._seen_ns = 0
        self._since_keyframe: RelativeMotion | None = None

    @property
    def T_odom_camera(self) -> Array:
        """The camera in the continuous frame."""
        return invert(self.T_world_odom) @ invert(self.T_camera_world)

    @property
    def is_blind(self) -> bool:
        """Whether the last pose was not seen in the images."""
        return bool(self.carried_by)

    def is_held(self, stamp_ns: int) -> bool:
        """Whether wheels tell where the camera is, too, and did so since the last keyframe."""
        measured, since = self._measured(stamp_ns), self._since_keyframe
        return all(motion is not None and motion.with_way for motion in (measured, since))

    @property
    def sigma_m(self) -> float:
        """The standard deviation of the position, along the axis on which it is largest."""
        return float(np.sqrt(np.diag(self.covariance)[:3].max()))

    def predict(self, stamp_ns: int) -> Array:
        """Return where the camera will be, T_camera_world (4, 4)."""
        measured = self.measured_pose(stamp_ns)
        return self.steady(stamp_ns) if measured is None else measured

    def measured_pose(self, stamp_ns: int) -> Array | None:
        """Return where the sensors have the camera, T_camera_world (4, 4)."""
        measured = self._measured(stamp_ns)
        return None if measured is None else measured.T_now_before @ self.T_camera_world

    def steady(self, stamp_ns: int) -> Array:
        """Return where the camera will be if it moves on as it did, T_camera_world (4, 4)."""
        return se3_exp(self._velocity * self._step_s(stamp_ns)) @ self.T_camera_world

    def is_plausible(self, T_camera_world: Array, stamp_ns: int) -> bool:
        """Whether a robot can have come to a pose since the last frame."""
        motion = T_camera_world @ invert(self.T_camera_world)
        step_s = self._step_s(stamp_ns)
        speed = float(np.linalg.norm(motion[:3, 3])) / step_s
        turn = rotation_angle(motion[:3, :3]) / step_s
        return speed <= self._max_speed_mps and turn <= MAX_TURN_RADPS

    def is_consistent(self, T_camera_world: Array, covariance: Array, stamp_ns: int) -> bool:
        """Whether a pose that the images tell, with its covariance (6, 6), fits what the sensors
        tell.
        """
        prior = self._predicted(self._measured(stamp_ns))
        if prior is None:
            return True
        error = se3_log(T_camera_world @ invert(prior[0]))
        return float(error @ np.linalg.solve(prior[1] + covariance, error)) < CONSISTENT_CHI2

    def take(self, T_camera_world: Array, covariance: Array, stamp_ns: int) -> None:
        """Go on from the pose of a frame, found in its images. After a blind stretch `odom` goes on
        where the sensors had the camera: the error of the stretch is a correction of `odom`.
        """
        measured = self._measured(stamp_ns)
        predicted = self._predicted(measured)
        if self.is_blind and predicted is not None:
            T_odom_camera = invert(predicted[0] @ self.T_world_odom)
            self.T_world_odom = _without_drift(invert(T_camera_world) @ invert(T_odom_camera))
        motion = se3_log(T_camera_world @ invert(self.T_camera_world))
        steady = not (self.is_lost or self.is_blind)
        self._velocity = motion / self._step_s(stamp_ns) if steady else np.zeros(6)
        self._note(measured)
        self.T_camera_world, self.covariance = T_camera_world, covariance
        self._last_stamp_ns = self._seen_ns = stamp_ns
        self.is_lost, self.carried_by = False, ''
        self._body.learn(stamp_ns, self.T_odom_camera, self.T_world_odom[:3, :3])

    def bridge(self, stamp_ns: int) -> bool:
        """Go on without the images to where the sensors have the camera. Returns whether they tell
        it.
        """
        measured = self._measured(stamp_ns)
        predicted = self._predicted(measured)
        if measured is None or predicted is None:
            return False
        if not measured.with_way and stamp_ns - self._seen_ns > MAX_COASTING_NS:
            return False
        self._note(measured)
        self.T_camera_world, self.covariance = _without_drift(predicted[0]), predicted[1]
        self._last_stamp_ns = stamp_ns
        self.carried_by = 'wheels' if measured.with_way else 'gyroscope'
        self._body.stop_learning()
        if measured.with_way:
            self._body.gravity.see(stamp_ns, self.T_odom_camera, self.T_world_odom[:3, :3])
        return True

    def stop(self) -> None:
        """Note that a frame has no pose."""
        self._velocity = np.zeros(6)
        self.is_lost, self.carried_by = True, ''
        self._since_keyframe = None
        self._body.stop_learning()
        self._body.gravity.stop()

    def start_keyframe(self) -> RelativeMotion | None:
        """Return the motion since the last keyframe as the wheels tell it; the next begins."""
        since, self._since_keyframe = self._since_keyframe, RelativeMotion.none()
        return since if since is not None and since.with_way else None

    def move_map(self, T_reference_before: Array, T_reference_after: Array) -> None:
        """Move the camera along with a keyframe (T_camera_world, (4, 4)) that the map has moved;
        `odom` stays where the camera sees it.
        """
        T_odom_camera = self.T_odom_camera
        T_camera_reference = self.T_camera_world @ invert(T_reference_before)
        self.T_camera_world = _without_drift(T_camera_reference @ T_reference_after)
        self.T_world_odom = _without_drift(invert(self.T_camera_world) @ invert(T_odom_camera))

    def _measured(self, stamp_ns: int) -> RelativeMotion | None:
        """Return the motion since the last pose: by wheels, or by the gyroscope with a way that is
        taken for constant.
        """
        measured = self._body.between(self._last_stamp_ns, stamp_ns)
        if measured is not None:
            return measured
        turn = self._body.turn(self._last_stamp_ns, stamp_ns)
        if turn is None:
            return None
        step_s = self._step_s(stamp_ns)
        R_now_before, sigma_rad = turn
        variance = np.array([(SIGMA_COASTING_M_S * step_s) ** 2] * 3 + [sigma_rad**2] * 3)
        T_now_before = make_transform(R_now_before, self._velocity[:3] * step_s)
        return RelativeMotion(T_now_before, np.diag(variance), with_way=False)

    def _predicted(self, measured: RelativeMotion | None) -> tuple[Array, Array] | None:
        """Return where the sensors have the camera after a motion (4, 4), and the covariance."""
        if measured is None or self.is_lost:
            return None
        A = adjoint(measured.T_now_before)
        covariance = A @ self.covariance @ A.T + measured.covariance
        return measured.T_now_before @ self.T_camera_world, covariance

    def _note(self, measured: RelativeMotion | None) -> None:
        """Add the motion of a frame to that since the last keyframe."""
        since = self._since_keyframe
        self._since_keyframe = since.then(measured) if since and measured else None

    def _step_s(self, stamp_ns: int) -> float:
        return max((stamp_ns - self._last_stamp_ns) * 1e-9, MIN_STEP_S)


def _without_drift(T: Array) -> Array:
    """Return a product of poses (4, 4) with its rotation orthonormal again: `invert` transposes,
    so the rounding errors of repeated products would grow threefold each time.
    """
    return make_transform(Rotation.from_matrix(T[:3, :3]).as_matrix(), T[:3, 3])
