"""How far `odom`, which is never corrected, has gone astray: dead reckoning from keyframe to
keyframe, and errors of the calibration, which are the same in every step.

A drift is an array (6, 13) of what errs in the poses T of a body, as twists before them, exp(twist)
T: the covariance (6, 6) of what is new in each step; and what errors of the calibration of one
sigma do (6, 7), of the optical axis to two sides, of the scale of ways, of that of turns, and three
of disparities. They add up, and a way back takes them back. The drift between two poses is the
difference of theirs.
"""

from __future__ import annotations

import numpy as np

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import FrameResult, Keyframe
from segfloor_ros.core.geometry import Array, invert, transform_points
from segfloor_ros.core.least_squares import SMALLEST
from segfloor_ros.core.slam.rig import DisparityOffset, weighted_jacobian, with_moment
from segfloor_ros.core.twists import adjoint, se3_exp, se3_log, skew

AXIS_SIGMA_PX, SCALE_SIGMA = 0.7, 0.0017
"""Of a calibration by pictures of a board: principal point; focal length and baseline as shares.
Zhang, A flexible new technique for camera calibration, IEEE T-PAMI 2000."""


class DriftMeter:
    """Follows the drift of `odom`, result by result.

    The points of a keyframe lie where the camera had it, and were measured no better than it is by
    those of the one before: each keyframe adds the covariance of its own pose for both. A stretch
    without images adds that of its end. What disparities are off, as far as that is not known,
    makes ways too long or too short, and turns them, by how far the points are that the latest
    keyframe sees. T_base_left: (4, 4), the mount, as soon as it is known.
    """

    def __init__(self, camera: StereoCamera) -> None:
        self.T_base_left: Array = np.eye(4)
        self.drift: Array = np.zeros((6, 13))
        self._camera, self._offset = camera, DisparityOffset(camera)
        self._by_disparities: Array = np.zeros((3, 6, 3))
        self._last: FrameResult | None = None
        self._is_keyframe = False

    def see(self, result: FrameResult, keyframe: Keyframe | None) -> None:
        """Take in the next result, and the keyframe that it is of, which may come after it; those
        that come once more change nothing.
        """
        last = self._last
        is_more = keyframe is not None and not self._is_keyframe
        if not result.tracked or (last and result.stamp_ns < last.stamp_ns + (not is_more)):
            return
        self._last, self._is_keyframe, drift = result, keyframe is not None, self.drift.copy()
        errs = [] if keyframe is None else 2 * [result]
        if keyframe is not None:
            self._by_disparities = self._off_by_disparities(keyframe)
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

    def _off_by_disparities(self, keyframe: Keyframe) -> Array:
        """Return the twists (3, 6, 3) by which errors of all disparities of one sigma each make a
        way of 1 m along each axis of the camera err, where pixels place it among the points seen.
        """
        xyz = keyframe.features.xyz_map
        known = np.isfinite(xyz[:, 0])
        points = transform_points(invert(keyframe.T_map_base @ self.T_base_left), xyz[known])
        J = with_moment(
            points.T, weighted_jacobian(self._camera, points, np.array([[1], [1], [0]]))
        )
        root = np.linalg.cholesky(keyframe.offset_px2 + SMALLEST * np.eye(3))
        off_px = self._offset.parts_of(keyframe.features.uv_px[known]) @ root
        too_near = off_px * (points[:, 2:] / self._camera.disparity_times_depth)
        # Pixels err by one; before, a metre or a radian is as likely.
        information = np.einsum('ain,bin->ab', J, J) + np.eye(6)
        return -np.linalg.solve(information, np.einsum('np,ain,win->paw', too_near, J, J[:3]))

    def _miscalibrated(self, motion: Array) -> Array:
        """Return the twists (6, 7) by which the calibration makes a motion (6,) err."""
        way, turn = motion[:3], motion[3:]
        errors: Array = np.zeros((6, 7))
        errors[:, :2] = np.vstack([skew(way), skew(turn)])[:, :2] * -AXIS_SIGMA_PX / self._camera.fx
        # Baseline and focal length make a way err.
        errors[:3, 2] = np.sqrt(2) * SCALE_SIGMA * way
        errors[3:, 3] = SCALE_SIGMA * turn
        errors[:, 4:] = (self._by_disparities @ way).T
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
