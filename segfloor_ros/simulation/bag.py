"""A simulated drive as a rosbag2 (mcap): images, CameraInfo and where the robot really was."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.bag_writer import BagWriter, ImageCoding
from segfloor_ros.camera.calibration import EyeCalibration, StereoCalibration
from segfloor_ros.camera.sources.source import RawPair
from segfloor_ros.geometry import Array, invert, quaternion_xyzw
from segfloor_ros.simulation.rig import RawCamera
from segfloor_ros.simulation.simulation import SimulatedFrame, Simulation

BAG_NAME = 'drive.mcap'
ODOMETRY_TOPIC = '/ground_truth/odometry'
ODOMETRY = 'nav_msgs/msg/Odometry'
JPEG_QUALITY = 90


class SimulatedBag(BagWriter):
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
        super().__init__(folder / BAG_NAME, StereoCalibration(left, right), coding)
        self._motion = simulation.motion
        self._T_map_world = invert(simulation.motion.T_world_base(0.0))
        self._jpeg_quality = jpeg_quality

    def add(self, frame: SimulatedFrame) -> None:
        """Append one frame and the pose of the base at that time."""
        stamp_ns = round(frame.time_s * 1e9)
        self.write(RawPair(frame.index, stamp_ns, frame.left, frame.right))
        T_map_base = self._T_map_world @ self._motion.T_world_base(frame.time_s)
        connection = self._connections['base', 'odometry']
        message = self._odometry_message(stamp_ns, T_map_base)
        data = self._typestore.serialize_cdr(message, connection.msgtype)
        self._writer.write(connection, stamp_ns, data)

    def _add_topics(self) -> None:
        super()._add_topics()
        self._connections['base', 'odometry'] = self._writer.add_connection(
            ODOMETRY_TOPIC, ODOMETRY, typestore=self._typestore
        )

    def _image_message(self, header: Any, image: NDArray[np.uint8]) -> Any:
        message = super()._image_message(header, image)
        if self._coding is ImageCoding.jpeg and self._jpeg_quality != JPEG_QUALITY:
            options = [cv2.IMWRITE_JPEG_QUALITY, self._jpeg_quality]
            message.data = cv2.imencode('.jpg', image, options)[1].ravel()
        return message

    def _odometry_message(self, stamp_ns: int, T_map_base: Array) -> Any:
        types = self._typestore.types
        vector, zeros = types['geometry_msgs/msg/Vector3'], np.zeros(36)
        twist = types['geometry_msgs/msg/Twist'](vector(0.0, 0.0, 0.0), vector(0.0, 0.0, 0.0))
        position = types['geometry_msgs/msg/Point'](*(float(v) for v in T_map_base[:3, 3]))
        turn = quaternion_xyzw(T_map_base[:3, :3])
        orientation = types['geometry_msgs/msg/Quaternion'](*(float(v) for v in turn))
        pose = types['geometry_msgs/msg/Pose'](position, orientation)
        return types[ODOMETRY](
            header=self._header(stamp_ns, 'map'),
            child_frame_id='base_link',
            pose=types['geometry_msgs/msg/PoseWithCovariance'](pose, zeros),
            twist=types['geometry_msgs/msg/TwistWithCovariance'](twist, zeros),
        )


def _eye(side: RawCamera, width: int, height: int) -> EyeCalibration:
    return EyeCalibration(width, height, side.K, side.D, side.R, side.P, origin='simulation')
