"""Wheel odometry and IMU as messages."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Vector3
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Imu

from segfloor_ros.geometry import Array
from segfloor_ros.measurements import ImuSample, WheelPose
from segfloor_ros.messages.errors import MessageError
from segfloor_ros.messages.headers import make_header, to_ns
from segfloor_ros.messages.poses import odometry_message, pose_array

WHEELS_FRAME = 'wheel_odom'
NOT_MEASURED = -1.0
"""First element of a covariance of what an IMU does not measure (sensor_msgs/Imu)."""


def wheel_message(wheels: WheelPose, base_frame: str) -> Odometry:
    """Return a pose that wheels tell as a message."""
    no_covariance = np.zeros((6, 6))
    return odometry_message(
        wheels.stamp_ns, WHEELS_FRAME, base_frame, wheels.T_wheels_base, no_covariance
    )


def wheel_pose(message: Odometry, topic: str) -> WheelPose:
    """Return the pose that wheels tell. Raises MessageError where it is none."""
    quaternion = message.pose.pose.orientation
    norm = np.linalg.norm([quaternion.x, quaternion.y, quaternion.z, quaternion.w])
    if not abs(norm - 1) < 0.01:
        raise MessageError(f'{topic}: the orientation is no rotation; its length is {norm:.3g}')
    return WheelPose(to_ns(message.header.stamp), pose_array(message.pose.pose))


def imu_message(sample: ImuSample, frame_id: str, R_frame_left: Array) -> Imu:
    """Return a sample as a message in a frame that R_frame_left (3, 3) turns it into."""
    message = Imu(
        header=make_header(sample.stamp_ns, frame_id),
        angular_velocity=_vector(R_frame_left @ sample.gyro_rad_s),
        linear_acceleration=_vector(R_frame_left @ sample.accel_m_s2),
    )
    message.orientation_covariance[0] = NOT_MEASURED
    return message


def imu_sample(message: Imu, R_left_imu: Array) -> ImuSample:
    """Return a sample in the rectified left optical frame."""
    gyro, accel = message.angular_velocity, message.linear_acceleration
    return ImuSample(
        to_ns(message.header.stamp),
        R_left_imu @ np.array([gyro.x, gyro.y, gyro.z]),
        R_left_imu @ np.array([accel.x, accel.y, accel.z]),
    )


def _vector(values: Array) -> Vector3:
    return Vector3(x=float(values[0]), y=float(values[1]), z=float(values[2]))
