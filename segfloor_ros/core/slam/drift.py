"""How far `odom`, which is never corrected, has gone astray: dead reckoning from keyframe to
keyframe, and errors of the calibration, which are the same in every step.

A drift is an array (6, 10) of what errs in the poses T of a body, as twists before them, exp(twist)
T: the covariance (6, 6) of what is new in each step; and what errors of the calibration of one
sigma do (6, 4), of the optical axis to two sides, of the scale of ways and of that of turns. The
latter add up, and a way back takes them back. The drift between two poses is the difference of
theirs.
"""

from __future__ import annotations

import numpy as np

from segfloor_ros.core.contracts import FrameResult
from segfloor_ros.core.geometry import Array, invert
from segfloor_ros.core.twists import adjoint, se3_exp, se3_log, skew

AXIS_SIGMA_PX, SCALE_SIGMA = 0.7, 0.0017
"""Of a calibration by some pictures of a board: the principal point, and focal length and baseline
as shares; of the size that Zhang reports (A flexible new technique for camera calibration, IEEE
T-PAMI 2000)."""


class DriftMeter:
    """Follows the drift of `odom`, result by result.

    The points of a keyframe lie where the camera had it, and were measured no better than it is by
    those of the one before: each keyframe adds the covariance of its own pose for both. A stretch
    without images adds that of its end. T_base_left: (4, 4), the mount, as soon as it is known.
    """

    def __init__(self, focal_px: float) -> None:
        self.T_base_left: Array = np.eye(4)
        self.drift: Array = np.zeros((6, 10))
        self._axis_rad = AXIS_SIGMA_PX / focal_px
        self._last: FrameResult | None = None

    def see(self, result: FrameResult, is_keyframe: bool) -> None:
        """Take in the next result; those that come once more change nothing."""
        last = self._last
        if not result.tracked or (last is not None and result.stamp_ns <= last.stamp_ns):
            return
        self._last, drift = result, self.drift.copy()
        errs = 2 * [result] if is_keyframe else []
        if last is not None:
            before, now = (one.T_odom_base @ self.T_base_left for one in (last, result))
            moved = se3_log(invert(before) @ now)
            halfway = adjoint(before @ se3_exp(moved / 2))
            drift[:, 6:] += halfway @ self._miscalibrated(moved)
            errs += [last] if last.blind and not result.blind else []
        for one in errs:
            A = twist_of_place(one.T_odom_base)
            drift[:, :6] += A @ one.covariance @ A.T
        self.drift = drift

    def covariance(self, result: FrameResult) -> Array:
        """Return the covariance (6, 6) of the base in `odom`: in the map around it, and the drift
        so far.
        """
        return np.asarray(result.covariance + covariance_at(self.drift, result.T_odom_base))

    def _miscalibrated(self, motion: Array) -> Array:
        """Return the twists (6, 4) by which the calibration makes a motion (6,) err."""
        way, turn = motion[:3], motion[3:]
        errors: Array = np.zeros((6, 4))
        errors[:3, :2] = -self._axis_rad * skew(way)[:, :2]
        errors[3:, :2] = -self._axis_rad * skew(turn)[:, :2]
        # Of a way, the baseline and the focal length err.
        errors[:3, 2], errors[3:, 3] = np.sqrt(2) * SCALE_SIGMA * way, SCALE_SIGMA * turn
        return errors


def covariance_at(drift: Array, T: Array) -> Array:
    """Return the covariance (6, 6) of a pose (4, 4) by its drift: of its place and its turn, in the
    axes of the frame.
    """
    A = np.linalg.inv(twist_of_place(T))
    steps, calibration = np.hsplit(A @ drift, [6])
    return np.asarray(steps @ A.T + calibration @ calibration.T)


def twist_of_place(T: Array) -> Array:
    """Return the matrix (6, 6) that makes the twist before a pose (4, 4) of errors of its place and
    its turn, in the axes of the frame.
    """
    A: Array = np.eye(6)
    A[:3, 3:] = skew(T[:3, 3])
    return A
