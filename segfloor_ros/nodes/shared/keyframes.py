"""The keyframes of a node, joined from their messages."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from rclpy.qos import DurabilityPolicy
from sensor_msgs.msg import TimeReference

from segfloor_ros.nodes.messages.diagnostics import HEALTH_PERIOD_S, Level
from segfloor_ros.nodes.messages.saved_maps import map_start_ns
from segfloor_ros.nodes.messages.topics import (
    KEYFRAME_DONE,
    KEYFRAMES,
    LATCHED_BY_MANY,
    MAP_START,
    make_header,
)
from segfloor_ros.nodes.shared.stage_node import AnyStageNode

Process = Callable[[int, dict[str, Any]], Mapping[str, Any]]
"""Gets the stamp and the messages by topic; returns values for the status."""


class KeyframeJoin:
    """Joins the parts of a keyframe and has the node process them, at the start of the node those
    that publishers keep. Where SLAM tells which map a keyframe belongs to, the node is reset before
    the first one of another map.

    may_process: keyframes are kept while it says no, until `process_waiting`. is_last: the
    keyframe goes no further when the node has processed it. optional: parts that are waited for
    only where somebody publishes them.
    """

    def __init__(
        self,
        node: AnyStageNode,
        parts: Sequence[str],
        process: Process,
        may_process: Callable[[], bool] = lambda: True,
        is_last: bool = False,
        optional: Sequence[str] = (),
    ) -> None:
        self.may_process = may_process
        self._node = node
        self._process = process
        self._is_last = is_last
        self._waiting: deque[tuple[int, dict[str, Any]]] = deque(maxlen=KEYFRAMES.depth)
        self._left_ns: int | None = None
        self._profile = LATCHED_BY_MANY
        self.map_start_ns: int | None = None
        """When the map was begun; None where nobody has said."""
        self.known_ns = -math.inf
        """Keyframes up to this stamp are in the map that the node was started with."""

        def is_published(topic: str) -> bool:
            return bool(node.inputs.subscriptions[topic].get_publisher_count())

        published = {topic: partial(is_published, topic) for topic in (MAP_START, *optional)}
        self._parts = (*parts, *published)
        node.inputs.join(
            parts, self._take, choose_profile=lambda: self._profile, optional=published
        )
        node.inputs.every(HEALTH_PERIOD_S, self._adapt_to_offers)

    @property
    def waiting_count(self) -> int:
        """How many keyframes are kept."""
        return len(self._waiting)

    def leave_for(self, start_ns: int | None) -> None:
        """Take the keyframes of another map from now on, and none of the one before."""
        if start_ns != self.map_start_ns:
            self._waiting.clear()
            self._left_ns, self.map_start_ns = self.map_start_ns, start_ns
            self.known_ns = -math.inf

    def process_waiting(self) -> None:
        """Process what is kept, as far as it may be."""
        while self._waiting and self.may_process():
            stamp_ns, parts = self._waiting.popleft()
            is_well = stamp_ns <= self.known_ns or self._work(stamp_ns, parts)
            if self._is_last or not is_well:
                self._node.outputs.publish(KEYFRAME_DONE, make_header(stamp_ns, ''))

    def _work(self, stamp_ns: int, parts: dict[str, Any]) -> bool:
        """Have the node process a keyframe and report how it went; returns whether it went well."""
        start = time.perf_counter()
        try:
            values = self._process(stamp_ns, parts)
        except Exception as error:
            self._node.reporter.report_fault(stamp_ns, error)
            return False
        milliseconds = 1e3 * (time.perf_counter() - start)
        self._node.reporter.report_processed(stamp_ns, Level.OK, 'running', milliseconds, **values)
        return True

    def _adapt_to_offers(self) -> None:
        """Take what others publish that keep nothing."""
        look = self._node.get_publishers_info_by_topic
        offered = {info.qos_profile.durability for name in self._parts for info in look(name)}
        if self._profile is not KEYFRAMES and DurabilityPolicy.VOLATILE in offered:
            self._profile = KEYFRAMES
            self._node.inputs.reopen()

    def _take(self, stamp_ns: int, parts: dict[str, Any]) -> None:
        self._profile = KEYFRAMES  # what comes while the inputs are closed is missed
        if MAP_START in parts and not self._follow(parts[MAP_START]):
            self._node.outputs.publish(KEYFRAME_DONE, make_header(stamp_ns, ''))
            return
        self._waiting.append((stamp_ns, parts))
        self.process_waiting()

    def _follow(self, message: TimeReference) -> bool:
        """Go to the map of a keyframe; returns False for one that was left already."""
        start_ns, last_ns = map_start_ns(message), self.map_start_ns
        if last_ns is not None and start_ns != last_ns:
            if start_ns == self._left_ns:
                return False
            self._node.reset('stereo_slam has begun a new map')
        self.leave_for(start_ns)
        return True
