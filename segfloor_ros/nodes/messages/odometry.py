"""Odometry: poses with covariances and twists."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist, Vector3
from nav_msgs.msg import Odometry

from segfloor_ros.core.geometry import Array, invert
from segfloor_ros.core.twists import se3_log
from segfloor_ros.nodes.messages.poses import LEAST_VARIANCE, pose_message
from segfloor_ros.nodes.messages.topics import make_header


def odometry_message(
    stamp_ns: int,
    frame_id: str,
    child_frame_id: str,
    T_a_b: Array,
    covariance: Array,
    twist: Array | None = None,
    twist_covariance: Array | None = None,
) -> Odometry:
    """Return the odometry of frame b in frame a.

    covariance: (6, 6), order x y z roll pitch yaw. twist: (6,) linear and angular velocity in
    frame b, m/s and rad/s, with its covariance (6, 6); None is marked as unknown by a large
    variance.
    """
    message = Odometry(header=make_header(stamp_ns, frame_id), child_frame_id=child_frame_id)
    message.pose.pose = pose_message(T_a_b)
    message.pose.covariance = np.ascontiguousarray(covariance, np.float64).ravel()
    if twist is None:
        message.twist.covariance = (np.eye(6) / LEAST_VARIANCE).ravel()
    else:
        vx, vy, vz, wx, wy, wz = (float(value) for value in twist)
        message.twist.twist = Twist(
            linear=Vector3(x=vx, y=vy, z=vz), angular=Vector3(x=wx, y=wy, z=wz)
        )
        if twist_covariance is not None:
            message.twist.covariance = np.ascontiguousarray(twist_covariance, np.float64).ravel()
    return message


def pose_with_covariance_message(
    stamp_ns: int, frame_id: str, T_a_b: Array, covariance: Array
) -> PoseWithCovarianceStamped:
    """Return the pose of frame b in frame a. covariance: (6, 6), order x y z roll pitch yaw."""
    message = PoseWithCovarianceStamped(header=make_header(stamp_ns, frame_id))
    message.pose.pose = pose_message(T_a_b)
    message.pose.covariance = np.ascontiguousarray(covariance, np.float64).ravel()
    return message


def body_twist(T_a_before: Array, T_a_now: Array, duration_s: float) -> Array:
    """Return the mean velocity (6,) between two poses in the moving frame: m/s, rad/s."""
    return se3_log(invert(T_a_before) @ T_a_now) / duration_s


def twist_covariance(
    covariance_before: Array, T_a_now: Array, covariance_now: Array, duration_s: float
) -> Array:
    """Return the covariance (6, 6) of the velocity between two poses, in the moving frame: what is
    wrong with one has nothing to do with what is wrong with the other.

    covariance_before, covariance_now: (6, 6) of the poses, in the axes of frame a.
    """
    axes = np.zeros((6, 6))
    axes[:3, :3] = axes[3:, 3:] = T_a_now[:3, :3].T
    return axes @ (covariance_before + covariance_now) @ axes.T / duration_s**2


def never_certain(covariance: Array) -> Array:
    """Return a covariance (6, 6) with `LEAST_VARIANCE` at least: the first pose is the origin by
    definition.
    """
    return covariance + np.diag(np.maximum(LEAST_VARIANCE - np.diag(covariance), 0.0))
