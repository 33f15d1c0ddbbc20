"""What wheels and IMUs measured, out of messages of `rclpy` as well as of `rosbags`."""

from __future__ import annotations

from typing import Any

import numpy as np

from segfloor_ros.core.contracts import ImuSample, WheelPose
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.quaternions import transform_from_quaternion

NOT_MEASURED = -1.0
"""First element of a covariance of what an IMU does not measure (sensor_msgs/Imu)."""


def stamp_ns(message: Any) -> int:
    """Return the stamp in a message's header in ns."""
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def wheel_pose(message: Any, name: str) -> WheelPose:
    """Return the pose that an Odometry of the wheels tells, NaN where it is none. name: of the
    topic.
    """
    pose = message.pose.pose
    try:
        T_wheels_base = rigid_motion(pose.position, pose.orientation, name)
    except InputError:
        T_wheels_base = np.full((4, 4), np.nan)
    return WheelPose(stamp_ns(message), T_wheels_base)


def imu_sample(message: Any, T_left_imu: Array) -> ImuSample:
    """Return a sample of an Imu at a pose (4, 4) in the rectified left optical frame."""
    gyro, accel = xyz(message.angular_velocity), xyz(message.linear_acceleration)
    return ImuSample.seen_from(T_left_imu, stamp_ns(message), gyro, accel)


def measures_motion(message: Any) -> bool:
    """Whether an Imu measures both angular velocity and acceleration."""
    covariances = message.angular_velocity_covariance, message.linear_acceleration_covariance
    return all(covariance[0] != NOT_MEASURED for covariance in covariances)


def rigid_motion(translation: Any, rotation: Any, name: str) -> Array:
    """Return the transform (4, 4) of a vector and a quaternion. Raises InputError where that is no
    rotation.
    """
    quat_xyzw = np.array([rotation.x, rotation.y, rotation.z, rotation.w])
    length = float(np.linalg.norm(quat_xyzw))
    if not abs(length - 1) < 0.01:
        raise InputError(f'{name}: the orientation is no rotation; its length is {length:.3g}')
    return transform_from_quaternion(xyz(translation), quat_xyzw)


def xyz(vector: Any) -> Array:
    """Return the components (3,) of a vector or point."""
    return np.array([vector.x, vector.y, vector.z])


UPRIGHT = 0.8
"""Cosine of the angle between gravity and the image's vertical up to which a camera is upright."""


def is_upright(accel_m_s2: Array) -> bool:
    """Whether up is about up in the image for what an IMU at rest feels (3,): its axes may be those
    of the image.
    """
    return bool(-accel_m_s2[1] > UPRIGHT * np.linalg.norm(accel_m_s2))
