"""Wheel odometry and IMU as messages."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Vector3
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Imu

from segfloor_ros.camera.ros_messages import NOT_MEASURED
from segfloor_ros.geometry import Array
from segfloor_ros.measurements import ImuSample, WheelPose
from segfloor_ros.messages.headers import make_header
from segfloor_ros.messages.poses import odometry_message

WHEELS_FRAME = 'wheel_odom'


def wheel_message(wheels: WheelPose, base_frame: str) -> Odometry:
    """Return a pose that wheels tell as a message."""
    no_covariance = np.zeros((6, 6))
    return odometry_message(
        wheels.stamp_ns, WHEELS_FRAME, base_frame, wheels.T_wheels_base, no_covariance
    )


def imu_message(sample: ImuSample, frame_id: str, R_frame_left: Array) -> Imu:
    """Return a sample as a message in a frame that R_frame_left (3, 3) turns it into."""
    message = Imu(
        header=make_header(sample.stamp_ns, frame_id),
        angular_velocity=_vector(R_frame_left @ sample.gyro_rad_s),
        linear_acceleration=_vector(R_frame_left @ sample.accel_m_s2),
    )
    message.orientation_covariance[0] = NOT_MEASURED
    return message


def _vector(values: Array) -> Vector3:
    return Vector3(x=float(values[0]), y=float(values[1]), z=float(values[2]))
