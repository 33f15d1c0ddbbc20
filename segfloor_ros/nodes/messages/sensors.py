"""What wheels and IMUs measured, as messages."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Vector3
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Imu

from segfloor_ros.core.camera.measurements import NOT_MEASURED
from segfloor_ros.core.contracts import ImuSample, WheelPose
from segfloor_ros.core.geometry import Array
from segfloor_ros.nodes.messages.odometry import odometry_message
from segfloor_ros.nodes.messages.poses import WHEELS_FRAME
from segfloor_ros.nodes.messages.topics import make_header


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
