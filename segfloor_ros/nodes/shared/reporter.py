"""What a node reports: a status per stamp, its health once a second, who listens to it and who it
listens to, topics that do not connect, or look like one that nobody publishes; and the log.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo
from sensor_msgs.msg import CameraInfo

from segfloor_ros.core.errors import SegfloorError
from segfloor_ros.core.memory import rss_mb
from segfloor_ros.nodes.messages.diagnostics import (
    CONNECTIONS,
    HEALTH,
    LASTS_S,
    Health,
    Level,
    Status,
    status_message,
)
from segfloor_ros.nodes.messages.topics import (
    DIAGNOSTICS,
    FRAMES,
    IMAGES,
    NAMED_BY,
    NODES,
    PATIENCE_S,
    PROFILES,
    SENSORS,
    TOPICS,
    Topic,
    describe_policies,
)

if TYPE_CHECKING:
    from segfloor_ros.nodes.shared.joining import StampJoiner


class LossCounter:
    """Counts the gaps in the numbers of one topic. A number that does not grow is that of another
    publisher, or of one that was started again: counting starts over.
    """

    def __init__(self) -> None:
        self._last: int | None = None

    def note(self, number: int | None) -> int:
        """Take in the number of a message, None where the middleware knows none; returns how many
        are missing before it.
        """
        last, self._last = self._last, number
        if last is None or number is None or number <= last:
            return 0
        return number - last - 1


def loss_level(topic: Topic) -> Level:
    """Return how bad it is to lose a message of a topic: nothing where the next one says the same
    or only the latest counts, slower than asked where a sensor is missed once, wrong where the map
    lacks something for good.
    """
    if topic.profile is FRAMES or (topic.type is CameraInfo and topic.profile is IMAGES):
        return Level.OK
    return Level.WARN if topic.profile in (IMAGES, SENSORS) else Level.ERROR


def loss_in_words(topic: str, lost: int, node: str, profile: QoSProfile) -> str:
    """Return what was lost, why, and what to do about it."""
    slower = 'lower the rate or the size of the images'
    if 'image' in topic:
        slower = f'start the driver with {NAMED_BY}={PROFILES}, or {slower}'
    if profile.reliability == ReliabilityPolicy.BEST_EFFORT:
        return (
            f'{lost} messages lost on {topic}, which is taken best effort; set image_reliability '
            f'to reliable where the driver offers it, {slower}'
        )
    return (
        f'{lost} messages lost on {topic}: {node} was too slow for its queue of {profile.depth}, '
        f'or the link is; {slower}, let stereo_slam make fewer keyframes, or play a recording with '
        'lossless set on stereo_camera'
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
        self._said: dict[str, str] = {}
        self._silent_until_s: dict[str, float] = {}

    def note_received(
        self, topic: Topic, stamp_ns: int, info: Mapping[str, Any], subscription: Subscription
    ) -> None:
        """Count a message of a topic, its age, and the messages that are missing before it. info:
        what the middleware tells of it.
        """
        delay_s = 1e-9 * (self._node.get_clock().now().nanoseconds - stamp_ns)
        waited_s = 1e-9 * (time.time_ns() - int(info.get('received_timestamp') or time.time_ns()))
        is_latched = topic.profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        self.health.received(topic.name, delay_s, 0.0 if is_latched else waited_s)
        if is_latched:  # only the last message counts
            return
        losses = self._losses.setdefault(topic.name, LossCounter())
        lost = losses.note(info.get('publication_sequence_number'))
        # The numbers of several publishers run side by side.
        if lost and subscription.get_publisher_count() == 1:
            self.health.lost(topic.name, lost)
            if loss_level(topic) is Level.OK:
                return
            name, profile = self._node.get_name(), subscription.qos_profile
            text = loss_in_words(topic.name, lost, name, profile)
            self.diagnose(f'loss on {topic.name}', text, loss_level(topic), PATIENCE_S)

    def note_opened(self) -> None:
        """Note that messages are received from now on; what came before is not missed."""
        self._opened_s = time.monotonic()
        self._losses.clear()

    def report(self, stamp_ns: int, level: Level, message: str, **values: Any) -> None:
        """Publish a status about one stamp."""
        self.publish('', stamp_ns, level, message, {**values, 'rss_mb': f'{rss_mb():.2f}'})

    def report_processed(
        self, stamp_ns: int, level: Level, message: str, milliseconds: float, **values: Any
    ) -> None:
        """Publish a status about what was processed."""
        self.health.processed(milliseconds, message)
        self.report(stamp_ns, level, message, **values, processing_ms=f'{milliseconds:.3f}')

    def report_fault(self, stamp_ns: int, error: Exception) -> None:
        """Log a fault and publish a status about it."""
        self.health.count('failed')
        self.log_fault(f'stamp {stamp_ns}', error)
        self.report(stamp_ns, Level.ERROR, one_line(error))

    def report_dropped(self, joiner: StampJoiner, publishing_nodes: Callable[[str], int]) -> None:
        """Warn about sets that were given up, naming the topics of the missing parts; those of
        which only the latest counts are nothing.
        """
        is_passing = all(TOPICS[name].profile is FRAMES for name in joiner.parts)
        for dropped in joiner.take_dropped():
            if is_passing:
                continue
            names = ', '.join(dropped.missing)
            crowded = ''.join(
                f'; {name} is published by {count} nodes, stop or remap one'
                for name in joiner.parts
                if (count := publishing_nodes(name)) > 1
            )
            text = f'no message on {names} with stamp {dropped.stamp_ns}; dropped{crowded}'
            self.health.count('dropped')
            # Others may still be starting; a second publisher is wrong from the first moment.
            if crowded or time.monotonic() - self._opened_s >= PATIENCE_S:
                self.diagnose(f'parts {names}{crowded}', text, lasts_s=PATIENCE_S)
            self.report(dropped.stamp_ns, Level.ERROR, text)

    def diagnose(
        self,
        about: str,
        text: str,
        level: Level = Level.WARN,
        lasts_s: float = LASTS_S,
        line: str | None = '',
    ) -> None:
        """Report what is wrong and what to do about it: on /diagnostics as long as it is found
        again within `lasts_s`, in the log when it begins and when it is over. line: what the log
        says, if less; None for nothing yet.
        """
        self.health.found(about, level, text, lasts_s)
        if about not in self._said and line is not None:
            self._node.get_logger().warning(line or text)
            self._said[about] = line or text

    def over(self, about: str) -> None:
        """Note that a problem is over; when it comes again it is logged again."""
        self.health.over(about)
        self._said.pop(about, None)

    def log_fault(self, where: str, error: Exception) -> None:
        """Log a fault in one line, at most every few seconds; the traceback of an unexpected one
        goes to the debug log.
        """
        text, log, now_s = one_line(error), self._node.get_logger(), time.monotonic()
        self._silent_until_s = {k: s for k, s in self._silent_until_s.items() if s > now_s}
        if text in self._silent_until_s:
            return
        self._silent_until_s[text] = now_s + PATIENCE_S
        log.error(text if text.startswith(where) else f'{where}: {text}')
        if not isinstance(error, SegfloorError):
            log.debug(''.join(traceback.format_exception(error)))

    def publish_health(self, state: str) -> None:
        """Publish how the node fares. state: of the node, in a word."""
        level, words, values = self.health.summary(state)
        for about in self._said.keys() - self.health.problems.keys():
            what = self._said.pop(about).partition(';')[0]
            self._node.get_logger().info(f'over: {what}')
        values['rss_mb'] = f'{rss_mb():.1f}'
        self.publish(HEALTH, self._node.get_clock().now().nanoseconds, level, words, values)

    def publish(
        self, kind: str, stamp_ns: int, level: Level, message: str, values: Mapping[str, Any]
    ) -> None:
        """Publish a status of a kind of its own."""
        name = self._node.get_fully_qualified_name() + (f': {kind}' if kind else '')
        texts = {key: str(value) for key, value in values.items()}
        self.publisher.publish(status_message(Status(stamp_ns, name, level, message, texts)))


def one_line(error: Exception) -> str:
    """Return an error in one line; unexpected ones with their type."""
    text = ' '.join(str(error).split())
    return text if isinstance(error, SegfloorError) else f'{type(error).__name__}: {text}'


def incompatible_topics(
    node: Node, publishers: Iterable[Publisher], subscriptions: Iterable[Subscription]
) -> Iterator[tuple[str, str]]:
    """Yield the topics whose other side cannot connect, each with what to do about it."""
    for subscription in subscriptions:
        topic, wanted = subscription.topic_name, subscription.qos_profile
        for other in node.get_publishers_info_by_topic(topic):
            if not _fits(offered := other.qos_profile, wanted):
                remedy = _remedy(node, offered, wanted)
                what = f'nothing arrives from {_full_name(other)}, which offers'
                ours = f'{node.get_name()} asks for {describe_policies(wanted)}'
                yield topic, f'{topic}: {what} {describe_policies(offered)}; {ours}; {remedy}'
    for publisher in publishers:
        topic, offered = publisher.topic_name, publisher.qos_profile
        for other in node.get_subscriptions_info_by_topic(topic):
            if not _fits(offered, wanted := other.qos_profile):
                what = f'nothing reaches {_full_name(other)}, which asks for'
                ours = f'{node.get_name()} offers {describe_policies(offered)}'
                remedy = 'subscribe with what is offered'
                yield topic, f'{topic}: {what} {describe_policies(wanted)}; {ours}; {remedy}'


def _full_name(other: TopicEndpointInfo) -> str:
    return f'{other.node_namespace.rstrip("/")}/{other.node_name}'


def _fits(offered: QoSProfile, wanted: QoSProfile) -> bool:
    """Whether a subscription asks for no more than is offered. Of deadlines and the like nothing is
    asked here, and what discovery says of them cannot be compared.
    """
    lossy = offered.reliability == ReliabilityPolicy.BEST_EFFORT
    fleeting = offered.durability == DurabilityPolicy.VOLATILE
    return not (lossy and wanted.reliability == ReliabilityPolicy.RELIABLE) and not (
        fleeting and wanted.durability == DurabilityPolicy.TRANSIENT_LOCAL
    )


def _remedy(node: Node, offered: QoSProfile, wanted: QoSProfile) -> str:
    durable = DurabilityPolicy.TRANSIENT_LOCAL
    if wanted.durability == durable and offered.durability != durable:
        return 'let it publish transient local'
    if node.has_parameter('image_reliability'):
        return f'set {node.get_name()}.image_reliability to best_effort, or let it publish reliable'
    return 'let it publish reliable'


def in_words(names: Sequence[str]) -> str:
    """Return names as a list in words."""
    return ', '.join(names[:-1]) + ' and ' * (len(names) > 1) + names[-1] if names else 'nothing'


class Connections:
    """Counts the subscribers of a node's outputs and finds inputs that do not connect. publishers,
    subscriptions: the open ones by the topic's name as in the code.
    """

    def __init__(
        self,
        node: Node,
        reporter: Reporter,
        publishers: Mapping[str, Publisher],
        subscriptions: Mapping[str, Subscription],
    ) -> None:
        self._node = node
        self._reporter = reporter
        self._publishers = publishers
        self._subscriptions = subscriptions
        self._counts: dict[str, int] = {}
        self._reported: dict[str, int] = {}
        self._last_needed_s = time.monotonic()
        self._silent_since_s: dict[str, float] = {}

    def report(self, always: bool) -> None:
        """Publish the number of subscribers by topic, as counted last, when it has changed, or
        always.
        """
        counts = self._counts
        if always or counts != self._reported:
            self._reported = counts
            stamp_ns = self._node.get_clock().now().nanoseconds
            self._reporter.publish(CONNECTIONS, stamp_ns, Level.OK, 'subscribers by topic', counts)

    def are_needed(self, is_needed_otherwise: bool) -> bool:
        """Count who listens, to the status, too. Returns whether somebody does, or did a short time
        ago.
        """
        outputs = {**self._publishers, DIAGNOSTICS.name: self._reporter.publisher}
        self._counts = {name: one.get_subscription_count() for name, one in outputs.items()}
        now_s = time.monotonic()
        if is_needed_otherwise or any(self._counts.values()):
            self._last_needed_s = now_s
        return now_s - self._last_needed_s < LASTS_S

    def find_problems(self) -> None:
        """Report topics that do not connect, a node of the same name, and queues that grow."""
        sides = self._publishers.values(), self._subscriptions.values()
        for topic, text in incompatible_topics(self._node, *sides):
            self._reporter.diagnose(f'QoS of {topic}', text, Level.ERROR)
        self._find_silent()
        self._find_twin()
        topic, waited_s = self._reporter.health.longest_wait()
        if waited_s > LASTS_S:
            text = (
                f'{self._node.get_name()} falls behind: messages on {topic} wait {waited_s:.1f} s; '
                'lower the rate or the size of the images, or let stereo_slam make fewer keyframes'
            )
            self._reporter.diagnose('queues', text)

    def _find_silent(self) -> None:
        """Report inputs that nobody publishes, each with what is published that looks like it."""
        silent = [
            name
            for name, subscription in self._subscriptions.items()
            if not TOPICS[name].is_optional and not subscription.get_publisher_count()
        ]
        now_s = time.monotonic()
        self._silent_since_s = {name: self._silent_since_s.get(name, now_s) for name in silent}
        if not silent:
            self._reporter.over('publishers')
            return
        what = f'nobody publishes {in_words([self._shown(name) for name in silent])}'
        text = '; '.join([what, 'start the node that does, or remap', *map(self._hint, silent)])
        is_settled = now_s - min(self._silent_since_s.values()) >= PATIENCE_S
        line = f'{what}; /diagnostics says what to do' if is_settled else None
        self._reporter.diagnose('publishers', text, line=line)

    def _shown(self, name: str) -> str:
        """Return a topic as it is in the code, or the one that is taken in its place."""
        topic = self._node.resolve_topic_name(name)
        return name if topic == self._node.resolve_topic_name(name, only_expand=True) else topic

    def _hint(self, name: str) -> str:
        """Return what is published that looks like a topic, in words."""
        topic, kind = self._node.resolve_topic_name(name), TOPICS[name].type_name
        infos = self._node.get_publishers_info_by_topic(topic)
        if others := {info.topic_type for info in infos} - {kind}:
            return f'{topic} is published as {in_words(sorted(others))}, not as {kind}'
        if TOPICS[name].publisher in NODES[1:]:
            return f'{topic} is what {TOPICS[name].publisher} publishes'
        from segfloor_ros.nodes.watches.lookalikes import lookalikes  # of what others publish

        found = lookalikes(self._node, topic, kind)
        if not found:
            return f'{topic}: no other topic of the type {kind} is published'
        return f'{topic}: published with this type are {in_words(found)} (-r {name}:={found[0]})'

    def _find_twin(self) -> None:
        """Report another node of the same name: both would publish on the same topics."""
        own = self._node.get_name(), self._node.get_namespace()
        count = self._node.get_node_names_and_namespaces().count(own)
        if count > 1:
            text = (
                f'{count} nodes are called {self._node.get_fully_qualified_name()} and publish '
                'on the same topics; stop the other one, or give this one a namespace; one that '
                'was killed is seen for up to 20 s by Fast DDS'
            )
            self._reporter.diagnose('twin', text, Level.ERROR)
