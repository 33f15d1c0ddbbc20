"""Frames of the robot over tf, where tf2_ros is installed (it is not among the pip wheels)."""

from __future__ import annotations

from typing import Any

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.time import Time

from segfloor_ros.camera.model import Mount
from segfloor_ros.messages.poses import transform_array, transform_message
from segfloor_ros.node_settings import StereoSlamNodeSettings
from segfloor_ros.slam.results import FrameResult

try:
    import tf2_ros
except ImportError:
    tf2_ros = None


class Transforms:
    """Broadcasts map → odom → base_link → camera and looks the camera's mount up (REP-105)."""

    def __init__(self, node: Node, own: StereoSlamNodeSettings) -> None:
        self._node = node
        self._own = own
        self._buffer: Any = None
        self._dynamic: Any = None
        self._static: Any = None
        if tf2_ros is None:
            node.get_logger().info(
                'tf2_ros is not installed: no tf is broadcast or read; the mount of the camera '
                'comes from the parameters camera_height_m, camera_pitch_rad and camera_roll_rad '
                'or is measured'
            )
            return
        self._buffer = tf2_ros.Buffer(node=node)
        self._listener = tf2_ros.TransformListener(self._buffer, node, spin_thread=True)
        self._dynamic = tf2_ros.TransformBroadcaster(node)
        self._static = tf2_ros.StaticTransformBroadcaster(node)

    def find_mount(self, camera_frame: str) -> Mount | None:
        """Return where tf says the left optical frame is on the base, or None when it does not
        say so in time.
        """
        if self._buffer is None:
            return None
        base, wait = self._own.base_frame, Duration(seconds=self._own.tf_wait_s)
        if not self._buffer.can_transform(base, camera_frame, Time(), wait):
            self._node.get_logger().warning(
                f'no transform from {base} to {camera_frame} within {self._own.tf_wait_s:g} s; '
                'the mount of the camera is measured from the floor'
            )
            return None
        found = self._buffer.lookup_transform(base, camera_frame, Time())
        return Mount.from_transform(transform_array(found))

    def broadcast_mount(self, stamp_ns: int, camera_frame: str, mount: Mount) -> None:
        """Broadcast a mount that tf did not have."""
        if self._static is not None and self._own.publish_tf:
            self._static.sendTransform(
                transform_message(stamp_ns, self._own.base_frame, camera_frame, mount.T_base_left)
            )

    def broadcast(self, result: FrameResult) -> None:
        """Broadcast the frames at one tracked frame."""
        own = self._own
        if self._dynamic is None or not own.publish_tf:
            return
        stamp_ns = result.stamp_ns
        transforms = [transform_message(stamp_ns, own.map_frame, own.odom_frame, result.T_map_odom)]
        if own.publish_odom_tf:
            transforms.append(
                transform_message(stamp_ns, own.odom_frame, own.base_frame, result.T_odom_base)
            )
        self._dynamic.sendTransform(transforms)
