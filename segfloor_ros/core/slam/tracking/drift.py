"""How far a path that is never corrected has gone astray: dead reckoning from keyframe to keyframe,
and errors of the calibration, which are the same in every step.

A drift is an array (6, 10) of what errs in the poses T of one body in one frame, as twists before
them, exp(twist) T: the covariance (6, 6) of what is new in each step; and what errors of the
calibration of one sigma do (6, 4), of the optical axis to two sides, of the scale of ways and of
that of turns. The latter add up, and a way back takes them back. The drift between two poses is the
difference of theirs.
"""

from __future__ import annotations

import numpy as np

from segfloor_ros.core.contracts import FrameResult
from segfloor_ros.core.geometry import Array, invert
from segfloor_ros.core.slam.tracking.motion import CameraMotion
from segfloor_ros.core.twists import adjoint, se3_exp, se3_log, skew

AXIS_SIGMA_PX, SCALE_SIGMA = 0.7, 0.0017
"""Of a calibration: the principal point, and focal length and baseline as shares (Zhang, A flexible
new technique for camera calibration, IEEE T-PAMI 2000, table 1)."""


def covariance_in_odom(result: FrameResult) -> Array:
    """Return the covariance (6, 6) of the base in `odom`, with the drift since it began."""
    return np.asarray(result.covariance + covariance_at(result.drift, result.T_odom_base))


def covariance_at(drift: Array, T: Array) -> Array:
    """Return the covariance (6, 6) of a pose (4, 4) by its drift: of its place and its turn, in the
    axes of the frame.
    """
    A: Array = np.eye(6)
    A[:3, 3:] = -skew(T[:3, 3])
    steps, calibration = np.hsplit(A @ drift, [6])
    return np.asarray(steps @ A.T + calibration @ calibration.T)


def in_axes(drift: Array, T: Array) -> Array:
    """Return the drift where poses in a frame and of a body alike become T pose T^-1."""
    A = adjoint(T)
    moved: Array = A @ drift
    moved[:, :6] = moved[:, :6] @ A.T
    return moved


class DriftMeter:
    """Follows the drift of `odom`, frame by frame, in the axes of its first camera pose.

    The points of a keyframe lie where the camera had it, and were measured no better than it is by
    those of the one before: each keyframe adds the covariance of its own pose for both. A stretch
    without images adds that of its end.
    """

    def __init__(self, focal_px: float) -> None:
        self.drift: Array = np.zeros((6, 10))
        self._axis_rad = AXIS_SIGMA_PX / focal_px
        self._T_odom_camera: Array | None = None
        self._of_stretch: Array | None = None

    def see(self, motion: CameraMotion, is_keyframe: bool) -> None:
        """Take in where the camera is after a frame, lost or not."""
        if motion.state.is_lost:
            return
        T, is_blind = motion.T_odom_camera, motion.state.is_blind
        self.drift, A = self.drift.copy(), adjoint(T)
        if self._T_odom_camera is not None:
            moved = se3_log(invert(self._T_odom_camera) @ T)
            halfway = adjoint(self._T_odom_camera @ se3_exp(moved / 2))
            self.drift[:, 6:] += halfway @ self._miscalibrated(moved)
        errs = 2 * [motion.covariance] if is_keyframe else []
        errs += [self._of_stretch] if self._of_stretch is not None and not is_blind else []
        for covariance in errs:
            self.drift[:, :6] += A @ covariance @ A.T
        self._T_odom_camera, self._of_stretch = T, motion.covariance if is_blind else None

    def _miscalibrated(self, motion: Array) -> Array:
        """Return the twists (6, 4) by which the calibration makes a motion (6,) err."""
        way, turn = motion[:3], motion[3:]
        errors: Array = np.zeros((6, 4))
        errors[:3, :2] = -self._axis_rad * skew(way)[:, :2]
        errors[3:, :2] = -self._axis_rad * skew(turn)[:, :2]
        # Of a way, the baseline and the focal length err.
        errors[:3, 2], errors[3:, 3] = np.sqrt(2) * SCALE_SIGMA * way, SCALE_SIGMA * turn
        return errors
