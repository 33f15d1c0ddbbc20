"""What a node tells about itself: a status per stamp, its health once a second, and the log."""

from __future__ import annotations

import time
import traceback
from collections.abc import Mapping
from typing import Any

from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy
from rclpy.subscription import Subscription

from segfloor_ros.errors import SegfloorError
from segfloor_ros.messages.diagnostics import (
    CONNECTIONS,
    HEALTH,
    HEALTH_PERIOD_S,
    NEED_LASTS_S,
    Level,
    Status,
    status_message,
)
from segfloor_ros.messages.health import Health
from segfloor_ros.messages.join import StampJoiner
from segfloor_ros.messages.losses import LossCounter, loss_in_words
from segfloor_ros.messages.topics import DIAGNOSTICS, TOPICS, Topic
from segfloor_ros.nodes.hand_over import HandOver, LocalPublisher
from segfloor_ros.nodes.managed_node import ManagedNode
from segfloor_ros.nodes.qos_check import incompatible_topics
from segfloor_ros.resident_memory import rss_mb

CONNECTION_CHECK_S = 0.1
FALLS_BEHIND_S = 2.0
LOSS_LASTS_S = 10.0
PATH = 'keyframe/path'
PROBLEM_LASTS_S = 3.0
REPEAT_FAULT_S = 5.0


class ReportingNode(ManagedNode):
    """A node that says on /diagnostics how it fares, in every state, and says it in the log once in
    a while.
    """

    works_on_demand = False
    """Whether messages that nobody needs the results of may be missed."""

    def __init__(self, name: str, hand_over: HandOver | None = None) -> None:
        super().__init__(name, hand_over)
        self._diagnostics = self.create_publisher(
            DIAGNOSTICS.type, DIAGNOSTICS.name, DIAGNOSTICS.profile
        )
        self._last_needed_s = time.monotonic()
        self._outputs: dict[str, Publisher | LocalPublisher] = {}
        self._health = Health()
        self._connections: dict[str, str] = {}
        self._last_heartbeat_s = 0.0
        self._losses: dict[str, LossCounter] = {}
        self._faults: dict[str, float] = {}
        self._said: dict[str, float] = {}
        self.steady_timer(CONNECTION_CHECK_S, self._report_connections)

    def forget(self) -> None:
        """The outputs go with the topics."""
        self._outputs.clear()

    def output(self, name: str) -> Publisher | LocalPublisher:
        """Create the publisher of a topic of `TOPICS`. It lives until the node is cleaned up."""
        topic = TOPICS[name]
        self._outputs[name] = self.keep_publisher(topic.type, name, topic.profile)
        return self._outputs[name]

    def on_inputs_closed(self) -> None:
        """What comes from now on is not missed."""
        for losses in self._losses.values():
            losses.skip()

    def note_received(self, topic: Topic, stamp_ns: int | None, info: Mapping[str, Any]) -> None:
        """Count a message of a topic, its age where its stamp is known, and the messages that are
        missing before it. info: what the middleware tells of it.
        """
        now_ns = self.get_clock().now().nanoseconds
        delay_s = None if stamp_ns is None else 1e-9 * (now_ns - stamp_ns)
        waited_s = 1e-9 * (time.time_ns() - int(info.get('received_timestamp') or time.time_ns()))
        self._health.received(topic.name, delay_s, waited_s)
        # Of a latched topic only the last message counts.
        if topic.profile.durability != DurabilityPolicy.TRANSIENT_LOCAL:
            self._note_losses(topic, info.get('publication_sequence_number'))

    def _note_losses(self, topic: Topic, number: int | None) -> None:
        losses = self._losses.setdefault(topic.name, LossCounter())
        lost = losses.note(number)
        # The numbers of several publishers run side by side.
        if not lost or self.publisher_count(topic.name) != 1:
            return
        self._health.lost(topic.name, lost)
        found = self.subscriptions_by_topic[topic.name]
        profile = found.qos_profile if isinstance(found, Subscription) else topic.profile
        text = loss_in_words(topic.name, lost, self.get_name(), profile)
        self.diagnose(f'loss on {topic.name}', text, Level.ERROR, LOSS_LASTS_S)

    def note_skipped(self) -> None:
        """Count something that was left out because newer things waited."""
        self._health.skipped()

    def report_processed(
        self, stamp_ns: int, level: Level, message: str, milliseconds: float, **values: Any
    ) -> None:
        """Publish a status about what was processed."""
        self._health.processed(milliseconds, message)
        self.report(stamp_ns, level, message, **values, processing_ms=f'{milliseconds:.3f}')

    def report_waiting(self, stamp_ns: int, message: str) -> None:
        """Publish a status about what cannot be processed yet, and is kept."""
        self._health.waits(message)
        self.report(stamp_ns, Level.WARN, message)

    def report_fault(self, stamp_ns: int, error: Exception) -> None:
        """Log a fault and publish a status about it."""
        self._health.failed()
        self.say_fault(f'stamp {stamp_ns}', error)
        self.report(stamp_ns, Level.ERROR, one_line(error))

    def diagnose(
        self, about: str, text: str, level: Level = Level.WARN, lasts_s: float = PROBLEM_LASTS_S
    ) -> None:
        """Say what is wrong and what to do about it: in the log now and then, on /diagnostics as
        long as it is found again within `lasts_s`.
        """
        self._health.found(about, level, text, lasts_s)
        self.say(text, about)

    def adapt(self) -> None:
        """Follow what others offer; called once a second while the inputs are open."""

    def find_problems(self) -> None:
        """Diagnose what shows over time; called once a second while the inputs are open."""

    def report(self, stamp_ns: int, level: Level, message: str, **values: Any) -> None:
        """Publish a status about one stamp."""
        self.publish_status('', stamp_ns, level, message, {**values, 'rss_mb': f'{rss_mb():.2f}'})

    def publish_status(
        self, kind: str, stamp_ns: int, level: Level, message: str, values: Mapping[str, Any]
    ) -> None:
        """Publish a status of a kind of its own."""
        name = self.get_fully_qualified_name() + (f': {kind}' if kind else '')
        texts = {key: str(value) for key, value in values.items()}
        self._diagnostics.publish(status_message(Status(stamp_ns, name, level, message, texts)))

    def say_dropped(self, joiner: StampJoiner) -> None:
        """Warn about sets that were given up, naming the topics of the missing parts."""
        for dropped in joiner.take_dropped():
            names = ', '.join(dropped.missing)
            counts = {name: self.publishing_nodes(name) for name in joiner.parts}
            crowded = ''.join(
                f'; {name} is published by {count} nodes, stop or remap one'
                for name, count in counts.items()
                if count > 1
            )
            text = f'no message on {names} with stamp {dropped.stamp_ns}; dropped{crowded}'
            self._health.dropped()
            self.say(text, about=names + crowded)
            self.report(dropped.stamp_ns, Level.ERROR, text)

    def say_fault(self, where: str, error: Exception) -> None:
        """Log a fault in one line, at most every few seconds; the traceback of an unexpected
        one goes to the debug log.
        """
        text, now_s = one_line(error), time.monotonic()
        self._faults = {t: s for t, s in self._faults.items() if now_s - s < REPEAT_FAULT_S}
        if text in self._faults:
            return
        self._faults[text] = now_s
        self.get_logger().error(text if text.startswith(where) else f'{where}: {text}')
        if not isinstance(error, SegfloorError):
            self.get_logger().debug(''.join(traceback.format_exception(error)))

    def say(self, text: str, about: str = '') -> None:
        """Warn, at most every few seconds about the same: the text, where nothing else is named."""
        now_s = time.monotonic()
        self._said = {t: s for t, s in self._said.items() if now_s - s < REPEAT_FAULT_S}
        if (about or text) not in self._said:
            self._said[about or text] = now_s
            self.get_logger().warning(text)

    def _report_connections(self) -> None:
        counts = {
            name: str(output.get_subscription_count()) for name, output in self._outputs.items()
        }
        counts[DIAGNOSTICS.name] = str(self._diagnostics.get_subscription_count())
        self._judge_need(counts)
        now = time.monotonic()
        is_due = now - self._last_heartbeat_s >= HEALTH_PERIOD_S
        if counts != self._connections or is_due:
            self._connections = counts
            stamp_ns = self.get_clock().now().nanoseconds
            self.publish_status(CONNECTIONS, stamp_ns, Level.OK, 'subscribers by topic', counts)
        if is_due:
            self._last_heartbeat_s = now
            self._report_health()

    def listener_count(self) -> int:
        """Return how many listen to what the node publishes, its topics and status aside."""
        return 0

    def _judge_need(self, counts: Mapping[str, str]) -> None:
        """Receive nothing while nobody listens to anything that is made of it, for a node that
        works on demand.
        """
        now_s = time.monotonic()
        always = not self.works_on_demand or not self.is_active
        if always or any(int(count) for count in counts.values()) or self.listener_count():
            self._last_needed_s = now_s
        self.note_need(now_s - self._last_needed_s < NEED_LASTS_S)

    def _report_health(self) -> None:
        if self.is_open:
            self.adapt()
            self._find_unconnected()
            self._find_queues()
            self.find_problems()
        level, words, values = self._health.summary(self.state_in_words)
        values['rss_mb'] = f'{rss_mb():.1f}'
        self.publish_status(HEALTH, self.get_clock().now().nanoseconds, level, words, values)

    def _find_queues(self) -> None:
        topic, waited_s = self._health.longest_wait()
        if waited_s > FALLS_BEHIND_S:
            text = (
                f'{self.get_name()} falls behind: messages on {topic} wait {waited_s:.1f} s; lower '
                'the rate or the size of the images, or let stereo_slam make fewer keyframes'
            )
            self.diagnose('queues', text)

    def _find_unconnected(self) -> None:
        heard = self.subscriptions_by_topic
        outputs = (
            output.outside if isinstance(output, LocalPublisher) else output
            for output in self._outputs.values()
        )
        inputs = (found for found in heard.values() if isinstance(found, Subscription))
        for topic, text in incompatible_topics(self, outputs, inputs):
            self.diagnose(f'QoS of {topic}', text, Level.ERROR)
        silent = [name for name in heard if not self.publisher_count(name) and name != PATH]
        if silent:
            text = f'nobody publishes {", ".join(silent)}; start the node that does, or remap'
            self._health.found('publishers', Level.WARN, text, PROBLEM_LASTS_S)
        else:
            self._health.over('publishers')


def one_line(error: Exception) -> str:
    """Return an error in one line; unexpected ones with their type."""
    text = ' '.join(str(error).split())
    return text if isinstance(error, SegfloorError) else f'{type(error).__name__}: {text}'
