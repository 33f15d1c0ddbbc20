"""Odometry: poses with covariances and twists."""

from __future__ import annotations

import numpy as np

from segfloor_ros.core.geometry import Array, invert
from segfloor_ros.core.twists import se3_log
from segfloor_ros.nodes.messages.making import Make, Message, make_header, ros_message
from segfloor_ros.nodes.messages.poses import filled, pose_message

LEAST_VARIANCE = 1e-6
"""Of a millimetre and a milliradian, in m² and rad²: filters take a zero for certainty."""


def odometry_message(
    stamp_ns: int,
    frame_id: str,
    child_frame_id: str,
    T_a_b: Array,
    covariance: Array,
    twist: Array | None = None,
    twist_covariance: Array | None = None,
    make: Make = ros_message,
) -> Message:
    """Return the odometry of frame b in frame a.

    covariance: (6, 6), order x y z roll pitch yaw. twist: (6,) linear and angular velocity in
    frame b, m/s and rad/s, with its covariance (6, 6); None is marked as unknown by a large
    variance.
    """
    if twist is None:
        twist, twist_covariance = np.zeros(6), np.eye(6) / LEAST_VARIANCE
    linear, angular = filled('Vector3', twist[:3], make), filled('Vector3', twist[3:], make)
    velocity = make('geometry_msgs/msg/Twist', linear=linear, angular=angular)
    uncertainty = np.zeros(36) if twist_covariance is None else twist_covariance
    return make(
        'nav_msgs/msg/Odometry',
        header=make_header(stamp_ns, frame_id, make),
        child_frame_id=child_frame_id,
        pose=_uncertain('Pose', pose_message(T_a_b, make), covariance, make),
        twist=_uncertain('Twist', velocity, uncertainty, make),
    )


def pose_with_covariance_message(
    stamp_ns: int, frame_id: str, T_a_b: Array, covariance: Array
) -> Message:
    """Return the pose of frame b in frame a. covariance: (6, 6), order x y z roll pitch yaw."""
    header, pose = make_header(stamp_ns, frame_id), pose_message(T_a_b)
    uncertain = _uncertain('Pose', pose, covariance, ros_message)
    return ros_message('geometry_msgs/msg/PoseWithCovarianceStamped', header=header, pose=uncertain)


def _uncertain(kind: str, value: Message, covariance: Array, make: Make) -> Message:
    numbers = np.ascontiguousarray(covariance, np.float64).ravel()
    whole = {kind.lower(): value, 'covariance': numbers}
    return make(f'geometry_msgs/msg/{kind}WithCovariance', **whole)


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
