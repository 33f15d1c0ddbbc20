"""A simulated drive as a rosbag2 (mcap): images, CameraInfo and where the robot really was."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from segfloor_ros.camera.bag_writer import FRAME_IDS, JPEG_QUALITY, BagWriter, ImageCoding
from segfloor_ros.camera.calibration import EyeCalibration, StereoCalibration
from segfloor_ros.camera.sources.bag_topics import IMAGE
from segfloor_ros.camera.sources.source import RawPair
from segfloor_ros.geometry import Array, invert, quaternion_xyzw
from segfloor_ros.simulation.rig import RawCamera
from segfloor_ros.simulation.sensors import ImuReadings, WheelReadings
from segfloor_ros.simulation.simulation import SimulatedFrame, Simulation

BAG_NAME = 'drive.mcap'
ODOMETRY_TOPIC = '/ground_truth/odometry'
WHEEL_TOPIC = '/wheel_odometry'
IMU_TOPIC = '/imu'
DEPTH_TOPIC = '/depth/image_raw'
ODOMETRY = 'nav_msgs/msg/Odometry'
IMU = 'sensor_msgs/msg/Imu'


class SimulatedBag:
    """Writes the frames of a simulation to a bag in a folder. Besides the images and CameraInfo it
    has the true pose of `base_link` in `map`, the base's first pose, as Odometry, and what wheels,
    IMU and depth camera tell. Use as a context manager; jpeg_quality is 1 to 100.
    """

    def __init__(
        self,
        folder: Path,
        simulation: Simulation,
        coding: ImageCoding,
        jpeg_quality: int = JPEG_QUALITY,
    ):
        left, right = (
            _eye(side, simulation.camera.width, simulation.camera.height)
            for side in simulation.imaging.raw
        )
        calibration = StereoCalibration(left, right)
        self._bag = BagWriter(folder / BAG_NAME, calibration, coding, jpeg_quality)
        self._motion = simulation.motion
        self._T_map_world = invert(simulation.motion.T_world_base(0.0))
        self._simulation = simulation
        self._readings: list[tuple[int, str, Any]] = []

    def __enter__(self) -> SimulatedBag:
        self._bag.__enter__()
        self._bag.add_topic(ODOMETRY_TOPIC, ODOMETRY)
        wheels, imu, depth = (
            self._simulation.wheels(),
            self._simulation.imu(),
            self._simulation.scene.sensors.depth,
        )
        if wheels is not None:
            self._bag.add_topic(WHEEL_TOPIC, ODOMETRY)
            self._readings += self._wheel_messages(wheels)
        if imu is not None:
            self._bag.add_topic(IMU_TOPIC, IMU)
            self._readings += self._imu_messages(imu)
        if depth.max_m:
            self._bag.add_topic(DEPTH_TOPIC, IMAGE)
        self._readings.sort(key=lambda reading: reading[0], reverse=True)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._bag.__exit__(kind, error, traceback)

    def add(self, frame: SimulatedFrame) -> None:
        """Append one frame, the pose of the base at that time, and what sensors told till then."""
        stamp_ns = round(frame.time_s * 1e9)
        while self._readings and self._readings[-1][0] <= stamp_ns:
            told_ns, topic, message = self._readings.pop()
            self._bag.write_message(topic, told_ns, message)
        if frame.depth_mm is not None:
            depth = self._bag.image_message(stamp_ns, frame.depth_mm, '16UC1')
            self._bag.write_message(DEPTH_TOPIC, stamp_ns, depth)
        self._bag.write(RawPair(frame.index, stamp_ns, frame.left, frame.right))
        T_map_base = self._T_map_world @ self._motion.T_world_base(frame.time_s)
        message = self._odometry_message(stamp_ns, 'map', T_map_base)
        self._bag.write_message(ODOMETRY_TOPIC, stamp_ns, message)

    def _wheel_messages(self, wheels: WheelReadings) -> Iterator[tuple[int, str, Any]]:
        for time_s, T_odom_base in zip(wheels.times_s, wheels.T_odom_base, strict=True):
            stamp_ns = round(time_s * 1e9)
            yield stamp_ns, WHEEL_TOPIC, self._odometry_message(stamp_ns, 'odom', T_odom_base)

    def _imu_messages(self, imu: ImuReadings) -> Iterator[tuple[int, str, Any]]:
        types, no_covariance = self._bag.types, np.zeros(9)
        vector = types['geometry_msgs/msg/Vector3']
        quaternion = types['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0)
        for time_s, gyro, accel in zip(imu.times_s, imu.gyro_rad_s, imu.accel_m_s2, strict=True):
            stamp_ns = round(time_s * 1e9)
            message = types[IMU](
                header=self._bag.header(stamp_ns, FRAME_IDS[0]),
                orientation=quaternion,
                # No orientation is measured (sensor_msgs/Imu).
                orientation_covariance=np.array([-1.0, *[0.0] * 8]),
                angular_velocity=vector(*(float(v) for v in gyro)),
                angular_velocity_covariance=no_covariance,
                linear_acceleration=vector(*(float(v) for v in accel)),
                linear_acceleration_covariance=no_covariance,
            )
            yield stamp_ns, IMU_TOPIC, message

    def _odometry_message(self, stamp_ns: int, frame_id: str, T_frame_base: Array) -> Any:
        types = self._bag.types
        vector, zeros = types['geometry_msgs/msg/Vector3'], np.zeros(36)
        twist = types['geometry_msgs/msg/Twist'](vector(0.0, 0.0, 0.0), vector(0.0, 0.0, 0.0))
        position = types['geometry_msgs/msg/Point'](*(float(v) for v in T_frame_base[:3, 3]))
        turn = quaternion_xyzw(T_frame_base[:3, :3])
        orientation = types['geometry_msgs/msg/Quaternion'](*(float(v) for v in turn))
        pose = types['geometry_msgs/msg/Pose'](position, orientation)
        return types[ODOMETRY](
            header=self._bag.header(stamp_ns, frame_id),
            child_frame_id='base_link',
            pose=types['geometry_msgs/msg/PoseWithCovariance'](pose, zeros),
            twist=types['geometry_msgs/msg/TwistWithCovariance'](twist, zeros),
        )


def _eye(side: RawCamera, width: int, height: int) -> EyeCalibration:
    return EyeCalibration(width, height, side.K, side.D, side.R, side.P, origin='simulation')
