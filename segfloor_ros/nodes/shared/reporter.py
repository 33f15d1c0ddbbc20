"""What a node tells about itself: a status per stamp, its health once a second, and the log."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Mapping
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from segfloor_ros.errors import SegfloorError
from segfloor_ros.messages.diagnostics import HEALTH, Health, Level, Status, status_message
from segfloor_ros.messages.join import StampJoiner
from segfloor_ros.messages.topics import DIAGNOSTICS, Topic
from segfloor_ros.timing import rss_mb

LOSS_LASTS_S = 10.0

PROBLEM_LASTS_S = 3.0

REPEAT_S = 5.0

SETTLED_S = 10.0
"""Nodes that are started together are seen one after the other: what is missing is not logged
before."""


class LossCounter:
    """Counts the gaps in the numbers of one topic. A number that does not grow is that of another
    publisher, or of one that was started again: counting starts over.
    """

    def __init__(self) -> None:
        self.total = 0
        self._last: int | None = None

    def note(self, number: int | None) -> int:
        """Take in the number of a message, None where the middleware knows none; returns how many
        are missing before it.
        """
        last, self._last = self._last, number
        if last is None or number is None or number <= last:
            return 0
        self.total += number - last - 1
        return number - last - 1

    def skip(self) -> None:
        """Let the numbers of the next messages be any: nothing was to be received meanwhile."""
        self._last = None


def loss_in_words(topic: str, lost: int, node: str, profile: QoSProfile) -> str:
    """Return what was lost, why, and what to do about it."""
    if profile.reliability == ReliabilityPolicy.BEST_EFFORT:
        return (
            f'{lost} messages lost on {topic}, which is taken best effort; set image_reliability '
            'to reliable where the driver offers it, or lower the rate or the size of the images'
        )
    return (
        f'{lost} messages lost on {topic}: {node} was too slow for its queue of {profile.depth}, '
        'or the link is; lower the rate or the size of the images, let stereo_slam make fewer '
        'keyframes, or play a recording with lossless set on stereo_camera'
    )


class Reporter:
    """Publishes on /diagnostics how a node fares, in every state, and logs it now and then."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self.publisher = node.create_publisher(
            DIAGNOSTICS.type, DIAGNOSTICS.name, DIAGNOSTICS.profile
        )
        self.health = Health()
        self._opened_s = time.monotonic()
        self._losses: dict[str, LossCounter] = {}
        self._silent_until_s: dict[str, float] = {}

    def note_received(
        self, topic: Topic, stamp_ns: int, info: Mapping[str, Any], subscription: Subscription
    ) -> None:
        """Count a message of a topic, its age, and the messages that are missing before it. info:
        what the middleware tells of it.
        """
        delay_s = 1e-9 * (self._node.get_clock().now().nanoseconds - stamp_ns)
        waited_s = 1e-9 * (time.time_ns() - int(info.get('received_timestamp') or time.time_ns()))
        self.health.received(topic.name, delay_s, waited_s)
        # Of a latched topic only the last message counts.
        if topic.profile.durability == DurabilityPolicy.TRANSIENT_LOCAL:
            return
        losses = self._losses.setdefault(topic.name, LossCounter())
        lost = losses.note(info.get('publication_sequence_number'))
        # The numbers of several publishers run side by side.
        if lost and subscription.get_publisher_count() == 1:
            self.health.lost(topic.name, lost)
            name, profile = self._node.get_name(), subscription.qos_profile
            text = loss_in_words(topic.name, lost, name, profile)
            self.diagnose(f'loss on {topic.name}', text, Level.ERROR, LOSS_LASTS_S)

    def note_opened(self) -> None:
        """Note that messages are received from now on."""
        self._opened_s = time.monotonic()

    def restart_loss_counts(self) -> None:
        """What comes from now on is not missed."""
        for losses in self._losses.values():
            losses.skip()

    def report(self, stamp_ns: int, level: Level, message: str, **values: Any) -> None:
        """Publish a status about one stamp."""
        self.publish('', stamp_ns, level, message, {**values, 'rss_mb': f'{rss_mb():.2f}'})

    def report_processed(
        self, stamp_ns: int, level: Level, message: str, milliseconds: float, **values: Any
    ) -> None:
        """Publish a status about what was processed."""
        self.health.processed(milliseconds, message)
        self.report(stamp_ns, level, message, **values, processing_ms=f'{milliseconds:.3f}')

    def report_waiting(self, stamp_ns: int, message: str, **values: Any) -> None:
        """Publish a status about what cannot be processed yet, and is kept."""
        self.health.waits(message)
        self.report(stamp_ns, Level.WARN, message, **values)

    def report_fault(self, stamp_ns: int, error: Exception) -> None:
        """Log a fault and publish a status about it."""
        self.health.count('failed')
        self.log_fault(f'stamp {stamp_ns}', error)
        self.report(stamp_ns, Level.ERROR, one_line(error))

    def report_dropped(self, joiner: StampJoiner, publishing_nodes: Callable[[str], int]) -> None:
        """Warn about sets that were given up, naming the topics of the missing parts."""
        for dropped in joiner.take_dropped():
            names = ', '.join(dropped.missing)
            counts = {name: publishing_nodes(name) for name in joiner.parts}
            crowded = ''.join(
                f'; {name} is published by {count} nodes, stop or remap one'
                for name, count in counts.items()
                if count > 1
            )
            text = f'no message on {names} with stamp {dropped.stamp_ns}; dropped{crowded}'
            self.health.count('dropped')
            # Others may still be starting; a second publisher is wrong from the first moment.
            if crowded or time.monotonic() - self._opened_s >= SETTLED_S:
                self.warn(text, about=names + crowded)
            self.report(dropped.stamp_ns, Level.ERROR, text)

    def diagnose(
        self,
        about: str,
        text: str,
        level: Level = Level.WARN,
        lasts_s: float = PROBLEM_LASTS_S,
        repeat_s: float = REPEAT_S,
    ) -> None:
        """Tell what is wrong and what to do about it: in the log now and then, on /diagnostics as
        long as it is found again within `lasts_s`.
        """
        self.health.found(about, level, text, lasts_s)
        self.warn(text, about, repeat_s)

    def warn(self, text: str, about: str = '', repeat_s: float = REPEAT_S) -> None:
        """Log a warning, at most every so many seconds about the same."""
        if self._is_due(about or text, repeat_s):
            self._node.get_logger().warning(text)

    def over(self, about: str) -> None:
        """Note that a problem is over; when it comes again it is logged again."""
        self.health.over(about)
        self._silent_until_s.pop(about, None)

    def log_fault(self, where: str, error: Exception) -> None:
        """Log a fault in one line, at most every few seconds; the traceback of an unexpected one
        goes to the debug log.
        """
        text, log = one_line(error), self._node.get_logger()
        if not self._is_due(text):
            return
        log.error(text if text.startswith(where) else f'{where}: {text}')
        if not isinstance(error, SegfloorError):
            log.debug(''.join(traceback.format_exception(error)))

    def publish_health(self, state: str) -> None:
        """Publish how the node fares. state: of the node, in a word."""
        level, words, values = self.health.summary(state)
        values['rss_mb'] = f'{rss_mb():.1f}'
        self.publish(HEALTH, self._node.get_clock().now().nanoseconds, level, words, values)

    def publish(
        self, kind: str, stamp_ns: int, level: Level, message: str, values: Mapping[str, Any]
    ) -> None:
        """Publish a status of a kind of its own."""
        name = self._node.get_fully_qualified_name() + (f': {kind}' if kind else '')
        texts = {key: str(value) for key, value in values.items()}
        self.publisher.publish(status_message(Status(stamp_ns, name, level, message, texts)))

    def _is_due(self, about: str, repeat_s: float = REPEAT_S) -> bool:
        now_s = time.monotonic()
        self._silent_until_s = {key: s for key, s in self._silent_until_s.items() if s > now_s}
        if about in self._silent_until_s:
            return False
        self._silent_until_s[about] = now_s + repeat_s
        return True


def one_line(error: Exception) -> str:
    """Return an error in one line; unexpected ones with their type."""
    text = ' '.join(str(error).split())
    return text if isinstance(error, SegfloorError) else f'{type(error).__name__}: {text}'
