"""A simulated drive as a rosbag2 (mcap): images, CameraInfo and where the robot really was."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from segfloor_ros.camera.bag_writer import JPEG_QUALITY, BagWriter, ImageCoding
from segfloor_ros.camera.calibration import EyeCalibration, StereoCalibration
from segfloor_ros.camera.sources.source import RawPair
from segfloor_ros.geometry import Array, invert, quaternion_xyzw
from segfloor_ros.simulation.rig import RawCamera
from segfloor_ros.simulation.simulation import SimulatedFrame, Simulation

BAG_NAME = 'drive.mcap'
ODOMETRY_TOPIC = '/ground_truth/odometry'
ODOMETRY = 'nav_msgs/msg/Odometry'


class SimulatedBag:
    """Writes the frames of a simulation to a bag in a folder. Besides the images and CameraInfo it
    has the true pose of `base_link` in `map`, the base's first pose, as Odometry. Use as a
    context manager; jpeg_quality is 1 to 100.
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

    def __enter__(self) -> SimulatedBag:
        self._bag.__enter__()
        self._bag.add_topic(ODOMETRY_TOPIC, ODOMETRY)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._bag.__exit__(kind, error, traceback)

    def add(self, frame: SimulatedFrame) -> None:
        """Append one frame and the pose of the base at that time."""
        stamp_ns = round(frame.time_s * 1e9)
        self._bag.write(RawPair(frame.index, stamp_ns, frame.left, frame.right))
        T_map_base = self._T_map_world @ self._motion.T_world_base(frame.time_s)
        message = self._odometry_message(stamp_ns, T_map_base)
        self._bag.write_message(ODOMETRY_TOPIC, stamp_ns, message)

    def _odometry_message(self, stamp_ns: int, T_map_base: Array) -> Any:
        types = self._bag.types
        vector, zeros = types['geometry_msgs/msg/Vector3'], np.zeros(36)
        twist = types['geometry_msgs/msg/Twist'](vector(0.0, 0.0, 0.0), vector(0.0, 0.0, 0.0))
        position = types['geometry_msgs/msg/Point'](*(float(v) for v in T_map_base[:3, 3]))
        turn = quaternion_xyzw(T_map_base[:3, :3])
        orientation = types['geometry_msgs/msg/Quaternion'](*(float(v) for v in turn))
        pose = types['geometry_msgs/msg/Pose'](position, orientation)
        return types[ODOMETRY](
            header=self._bag.header(stamp_ns, 'map'),
            child_frame_id='base_link',
            pose=types['geometry_msgs/msg/PoseWithCovariance'](pose, zeros),
            twist=types['geometry_msgs/msg/TwistWithCovariance'](twist, zeros),
        )


def _eye(side: RawCamera, width: int, height: int) -> EyeCalibration:
    return EyeCalibration(width, height, side.K, side.D, side.R, side.P, origin='simulation')
