"""Reading and broadcasting tf: by tf2_ros where it is installed, else by its messages alone.

The wheels of pip have neither tf2_ros nor tf2_msgs; `make` builds the latter.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import yaml
from geometry_msgs.msg import TransformStamped
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.time import Time

from segfloor_ros.frames import FrameTree
from segfloor_ros.geometry import Array
from segfloor_ros.messages import qos
from segfloor_ros.messages.errors import MessageError
from segfloor_ros.messages.headers import to_ns, to_time
from segfloor_ros.messages.poses import transform_array
from segfloor_ros.nodes.stage_node import AnyStageNode


class TfLink(Protocol):
    """What the nodes need of tf."""

    def lookup(self, target: str, source: str, stamp_ns: int | None = None) -> Array | None:
        """Return T_target_source (4, 4) at a time, or the latest one; None where unknown."""

    def latest_ns(self, parent: str, child: str) -> int | None:
        """Return up to when it is known where a moving frame is on its parent; None if never."""

    def clear_moving(self) -> None:
        """Drop where frames have moved: time starts over."""

    def root_of(self, frame: str) -> str:
        """Return the topmost frame that a frame hangs on; itself where it hangs on none."""

    def send(self, transforms: Sequence[TransformStamped]) -> None:
        """Broadcast transforms at one time."""

    def send_fixed(self, transform: TransformStamped) -> None:
        """Broadcast a transform that holds from now on."""

    def listener_count(self) -> int:
        """Return how many others listen to moving frames."""

    def stop_listening(self) -> None:
        """Read no more."""


def tf_link(node: AnyStageNode) -> TfLink | None:
    """Return the node's access to tf, or None where there is no tf."""
    if importlib.util.find_spec('tf2_ros') is not None:
        return Tf2Ros(node)
    if importlib.util.find_spec('tf2_msgs') is not None:
        return TfMessages(node)
    return None


class Tf2Ros:
    """tf by tf2_ros."""

    def __init__(self, node: AnyStageNode) -> None:
        import tf2_ros

        self._node = node
        self._error: type[Exception] = tf2_ros.TransformException
        self._buffer: Any = tf2_ros.Buffer()
        self._listener: Any = tf2_ros.TransformListener(self._buffer, node)
        self._moving: Any = tf2_ros.TransformBroadcaster(node)
        self._fixed: Any = tf2_ros.StaticTransformBroadcaster(node)
        node.at_clean_up(self._end)

    def lookup(self, target: str, source: str, stamp_ns: int | None = None) -> Array | None:
        """Return T_target_source (4, 4) at a time, or the latest one; None where unknown."""
        time = Time() if stamp_ns is None else Time.from_msg(to_time(stamp_ns))
        try:
            return transform_array(self._buffer.lookup_transform(target, source, time))
        except self._error:
            return None

    def latest_ns(self, parent: str, child: str) -> int | None:
        """Return up to when it is known where a moving frame is on its parent; None if never."""
        try:
            return to_ns(self._buffer.lookup_transform(parent, child, Time()).header.stamp) or None
        except self._error:
            return None

    def clear_moving(self) -> None:
        """Drop where frames have moved: time starts over. tf2 keeps the fixed ones."""
        self._buffer.clear()

    def root_of(self, frame: str) -> str:
        """Return the topmost frame that a frame hangs on; itself where it hangs on none."""
        frames = yaml.safe_load(self._buffer.all_frames_as_yaml()) or {}
        passed = set()
        while frame in frames and frame not in passed:
            passed.add(frame)
            frame = frames[frame]['parent']
        return frame

    def send(self, transforms: Sequence[TransformStamped]) -> None:
        """Broadcast transforms at one time."""
        self._moving.sendTransform(list(transforms))

    def send_fixed(self, transform: TransformStamped) -> None:
        """Broadcast a transform that holds from now on."""
        self._fixed.sendTransform(transform)

    def listener_count(self) -> int:
        """Return how many others listen to moving frames."""
        return int(self._moving.pub_tf.get_subscription_count()) - (self._listener is not None)

    def stop_listening(self) -> None:
        """Read no more."""
        if self._listener is not None:
            self._listener.unregister()
        self._listener = None

    def _end(self) -> None:
        self.stop_listening()
        for broadcaster in (self._moving, self._fixed):
            self._node.destroy_publisher(broadcaster.pub_tf)


class TfMessages:
    """tf by its messages alone."""

    def __init__(self, node: AnyStageNode) -> None:
        from tf2_msgs.msg import TFMessage

        self._type: Any = TFMessage
        self._node = node
        self._frames = FrameTree()
        self._moving = self._publisher('/tf', qos.TF)
        self._fixed = self._publisher('/tf_static', qos.TF_STATIC)
        self._stop = [
            self._subscribe('/tf', self._take_moving, qos.TF),
            self._subscribe('/tf_static', self._take_fixed, qos.TF_STATIC_LISTENER),
        ]
        node.at_clean_up(self.stop_listening)

    def lookup(self, target: str, source: str, stamp_ns: int | None = None) -> Array | None:
        """Return T_target_source (4, 4) at a time, or the latest one; None where unknown."""
        return self._frames.lookup(target, source, stamp_ns)

    def latest_ns(self, parent: str, child: str) -> int | None:
        """Return up to when it is known where a moving frame is on its parent; None if never."""
        return self._frames.latest_ns(child)

    def clear_moving(self) -> None:
        """Drop where frames have moved: time starts over."""
        self._frames.clear_moving()

    def root_of(self, frame: str) -> str:
        """Return the topmost frame that a frame hangs on; itself where it hangs on none."""
        return self._frames.root_of(frame)

    def send(self, transforms: Sequence[TransformStamped]) -> None:
        """Broadcast transforms at one time."""
        self._moving.publish(self._type(transforms=list(transforms)))

    def send_fixed(self, transform: TransformStamped) -> None:
        """Broadcast a transform that holds from now on."""
        self._fixed.publish(self._type(transforms=[transform]))

    def listener_count(self) -> int:
        """Return how many others listen to moving frames."""
        return self._moving.get_subscription_count() - bool(self._stop)

    def stop_listening(self) -> None:
        """Read no more."""
        while self._stop:
            self._stop.pop()()

    def _publisher(self, topic: str, profile: QoSProfile) -> Publisher:
        made = self._node.create_publisher(self._type, topic, profile)
        self._node.at_clean_up(lambda: self._node.destroy_publisher(made))
        return made

    def _subscribe(
        self, topic: str, take: Callable[[Any], None], profile: QoSProfile
    ) -> Callable[[], Any]:
        """Subscribe whether the node is active or not; returns what ends it."""
        made = self._node.create_subscription(self._type, topic, take, profile)
        return lambda: self._node.destroy_subscription(made)

    def _take_moving(self, message: Any) -> None:
        self._take(
            message,
            lambda found, T: self._frames.add_moving(
                to_ns(found.header.stamp), found.header.frame_id, found.child_frame_id, T
            ),
        )

    def _take_fixed(self, message: Any) -> None:
        self._take(
            message,
            lambda found, T: self._frames.add_fixed(found.header.frame_id, found.child_frame_id, T),
        )

    def _take(self, message: Any, add: Callable[[TransformStamped, Array], None]) -> None:
        for found in message.transforms:
            self._take_one(found, add)

    def _take_one(
        self, found: TransformStamped, add: Callable[[TransformStamped, Array], None]
    ) -> None:
        try:
            add(found, transform_array(found))
        except MessageError as error:
            self._node.get_logger().warning(
                f'tf from {found.header.frame_id} to {found.child_frame_id}: {error}',
                throttle_duration_sec=5.0,
            )
