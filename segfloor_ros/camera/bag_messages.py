"""What a robot measures besides images as ROS messages of a bag, by `rosbags`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from segfloor_ros.camera.ros_messages import NOT_MEASURED
from segfloor_ros.geometry import Array, quaternion_xyzw
from segfloor_ros.measurements import ImuSample

ODOMETRY = 'nav_msgs/msg/Odometry'
IMU = 'sensor_msgs/msg/Imu'
TF = 'tf2_msgs/msg/TFMessage'
IMU_FRAME = 'imu_link'
"""Of an IMU that is not where the left camera is; its axes are those of the raw left images."""


class BagMessages:
    """Makes messages of the classes of a typestore, by name."""

    def __init__(self, types: Mapping[str, Any]) -> None:
        self.types = types

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        """Return a std_msgs/Header."""
        sec, nanosec = divmod(stamp_ns, 1_000_000_000)
        stamp = self.types['builtin_interfaces/msg/Time'](sec=sec, nanosec=nanosec)
        return self.types['std_msgs/msg/Header'](stamp=stamp, frame_id=frame_id)

    def odometry(self, stamp_ns: int, frame_id: str, T_frame_base: Array) -> Any:
        """Return the pose (4, 4) of `base_link` as nav_msgs/Odometry."""
        types, no_covariance = self.types, np.zeros(36)
        pose = types['geometry_msgs/msg/Pose'](
            types['geometry_msgs/msg/Point'](*(float(v) for v in T_frame_base[:3, 3])),
            self._quaternion(quaternion_xyzw(T_frame_base[:3, :3])),
        )
        twist = types['geometry_msgs/msg/Twist'](*(self._vector(np.zeros(3)) for _ in range(2)))
        return types[ODOMETRY](
            header=self.header(stamp_ns, frame_id),
            child_frame_id='base_link',
            pose=types['geometry_msgs/msg/PoseWithCovariance'](pose, no_covariance),
            twist=types['geometry_msgs/msg/TwistWithCovariance'](twist, no_covariance),
        )

    def imu(self, sample: ImuSample, frame_id: str, R_frame_left: Array) -> Any:
        """Return a sample as sensor_msgs/Imu in a frame that R_frame_left (3, 3) turns it into."""
        no_covariance = np.zeros(9)
        return self.types[IMU](
            header=self.header(sample.stamp_ns, frame_id),
            orientation=self._quaternion(np.array([0.0, 0.0, 0.0, 1.0])),
            orientation_covariance=np.array([NOT_MEASURED, *[0.0] * 8]),
            angular_velocity=self._vector(R_frame_left @ sample.gyro_rad_s),
            angular_velocity_covariance=no_covariance,
            linear_acceleration=self._vector(R_frame_left @ sample.accel_m_s2),
            linear_acceleration_covariance=no_covariance,
        )

    def transform(self, frame_id: str, child: str, T_frame_child: Array) -> Any:
        """Return a fixed transform (4, 4) as tf2_msgs/TFMessage."""
        turn = self._quaternion(quaternion_xyzw(T_frame_child[:3, :3]))
        types, shift = self.types, self._vector(T_frame_child[:3, 3])
        transform = types['geometry_msgs/msg/Transform'](shift, turn)
        stamped = types['geometry_msgs/msg/TransformStamped']
        return types[TF]([stamped(self.header(0, frame_id), child, transform)])

    def _vector(self, values: Array) -> Any:
        return self.types['geometry_msgs/msg/Vector3'](*(float(v) for v in values))

    def _quaternion(self, xyzw: Array) -> Any:
        return self.types['geometry_msgs/msg/Quaternion'](*(float(v) for v in xyzw))
