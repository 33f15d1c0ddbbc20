"""What nodes broadcast over tf and hear there."""

from __future__ import annotations

import importlib.util
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

from geometry_msgs.msg import TransformStamped

from segfloor_ros.core.errors import InputError
from segfloor_ros.nodes.frame_tree import FrameTree
from segfloor_ros.nodes.messages.poses import transform_array
from segfloor_ros.nodes.messages.topics import (
    KEYFRAMES,
    LATCHED,
    LATCHED_BY_MANY,
    PATIENCE_S,
    to_ns,
)
from segfloor_ros.nodes.shared.stage_node import AnyStageNode


class TfLink:
    """What other nodes broadcast, in `frames`, and the way to broadcast oneself. Where tf2_msgs is
    not installed, no frame is ever known and nothing is sent. on_heard: gets what others broadcast.
    """

    def __init__(
        self, node: AnyStageNode, on_heard: Callable[[TransformStamped], None] | None = None
    ) -> None:
        self.frames = FrameTree()
        self._on_heard = on_heard
        self._sent: deque[TransformStamped] = deque(maxlen=2 * KEYFRAMES.depth)
        self.is_there = importlib.util.find_spec('tf2_msgs') is not None
        self._node = node
        self._outputs: dict[str, Any] = {}
        self._stop: list[Callable[[], Any]] = []
        if self.is_there:
            self._connect()

    def send(self, *transforms: TransformStamped) -> None:
        """Broadcast transforms at one time."""
        self._sent.extend(transforms)
        self._publish('/tf', transforms)

    def send_fixed(self, transform: TransformStamped) -> None:
        """Broadcast a transform that holds from now on."""
        self._publish('/tf_static', (transform,))

    def listener_count(self) -> int:
        """Return how many others listen to moving frames."""
        moving = self._outputs.get('/tf')
        return 0 if moving is None else moving.get_subscription_count() - bool(self._stop)

    def stop_listening(self) -> None:
        """Read no more."""
        while self._stop:
            self._stop.pop()()

    def listen(self) -> None:
        """Read what others broadcast, whether the node is active or not."""
        if self.is_there and not self._stop:
            for topic, profile in (('/tf', KEYFRAMES), ('/tf_static', LATCHED_BY_MANY)):
                take = partial(self._take, topic == '/tf_static')
                made = self._node.create_subscription(self._type, topic, take, profile)
                self._stop.append(partial(self._node.destroy_subscription, made))

    def _connect(self) -> None:
        """Publish and subscribe until the node is cleaned up."""
        from tf2_msgs.msg import TFMessage

        self._type: Any = TFMessage
        node = self._node
        for topic, profile in (('/tf', KEYFRAMES), ('/tf_static', LATCHED)):
            output = self._outputs[topic] = node.create_publisher(TFMessage, topic, profile)
            node.outputs.at_clean_up(partial(node.destroy_publisher, output))
        self.listen()
        node.outputs.at_clean_up(self.stop_listening)

    def _publish(self, topic: str, transforms: tuple[TransformStamped, ...]) -> None:
        if self.is_there:
            self._outputs[topic].publish(self._type(transforms=list(transforms)))

    def _take(self, is_fixed: bool, message: Any) -> None:
        for found in message.transforms:
            parent, child = found.header.frame_id, found.child_frame_id
            own = [one for one in self._sent if one.child_frame_id == child]
            if self._on_heard is not None and found not in own:
                self._on_heard(found)
            try:
                if is_fixed:
                    self.frames.add_fixed(parent, child, transform_array(found))
                else:
                    stamp_ns = to_ns(found.header.stamp)
                    self.frames.add_moving(stamp_ns, parent, child, transform_array(found))
            except InputError as error:
                text = f'tf from {parent} to {child}: {error}'
                self._node.reporter.diagnose(f'{parent} {child}', text, lasts_s=PATIENCE_S)
