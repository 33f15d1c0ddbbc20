"""What wheels and IMUs measured, as messages."""

from __future__ import annotations

import numpy as np

from segfloor_ros.core.camera.measurements import NOT_MEASURED
from segfloor_ros.core.contracts import ImuSample, WheelPose
from segfloor_ros.core.geometry import Array
from segfloor_ros.nodes.messages.making import Make, Message, make_header, ros_message
from segfloor_ros.nodes.messages.odometry import odometry_message
from segfloor_ros.nodes.messages.poses import filled

WHEELS_FRAME = 'wheel_odom'


def wheel_message(
    wheels: WheelPose, base_frame: str, twist: Array | None = None, make: Make = ros_message
) -> Message:
    """Return a pose that wheels tell as a message. twist: as of `odometry_message`."""
    at, zeros = (wheels.stamp_ns, WHEELS_FRAME, base_frame), np.zeros((6, 6))
    return odometry_message(*at, wheels.T_wheels_base, zeros, twist, make=make)


def imu_message(
    sample: ImuSample, frame_id: str, R_frame_left: Array, make: Make = ros_message
) -> Message:
    """Return a sample as a message in a frame that R_frame_left (3, 3) turns it into."""
    unknown = np.zeros(9)
    return make(
        'sensor_msgs/msg/Imu',
        header=make_header(sample.stamp_ns, frame_id, make),
        orientation=filled('Quaternion', np.eye(4)[3], make),
        orientation_covariance=np.array([NOT_MEASURED, *unknown[1:]]),
        angular_velocity=filled('Vector3', R_frame_left @ sample.gyro_rad_s, make),
        angular_velocity_covariance=unknown,
        linear_acceleration=filled('Vector3', R_frame_left @ sample.accel_m_s2, make),
        linear_acceleration_covariance=unknown,
    )
