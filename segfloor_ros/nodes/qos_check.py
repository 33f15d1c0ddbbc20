"""Says which topics do not connect because the two sides ask for different qualities of service."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from segfloor_ros.messages.qos import describe_policies


def offered_best_effort(node: Node, topics: Iterable[str]) -> list[str]:
    """Return the topics that somebody publishes best effort, which reaches no reliable listener."""
    lossy = ReliabilityPolicy.BEST_EFFORT
    return [
        topic
        for topic in topics
        if any(
            info.qos_profile.reliability == lossy
            for info in node.get_publishers_info_by_topic(topic)
        )
    ]


def incompatible_topics(
    node: Node, publishers: Iterable[Publisher], subscriptions: Iterable[Subscription]
) -> Iterator[tuple[str, str]]:
    """Yield the topics whose other side cannot connect, each with what to do about it."""
    for subscription in subscriptions:
        topic, wanted = subscription.topic_name, subscription.qos_profile
        for other in node.get_publishers_info_by_topic(topic):
            if not _fits(other.qos_profile, wanted):
                name = f'{other.node_namespace.rstrip("/")}/{other.node_name}'
                yield (
                    topic,
                    f'{topic}: nothing arrives from {name}, which offers '
                    f'{describe_policies(other.qos_profile)}; {node.get_name()} asks for '
                    f'{describe_policies(wanted)}; {_remedy(node, other.qos_profile, wanted)}',
                )
    for publisher in publishers:
        topic, offered = publisher.topic_name, publisher.qos_profile
        for other in node.get_subscriptions_info_by_topic(topic):
            if not _fits(offered, other.qos_profile):
                name = f'{other.node_namespace.rstrip("/")}/{other.node_name}'
                yield (
                    topic,
                    f'{topic}: nothing reaches {name}, which asks for '
                    f'{describe_policies(other.qos_profile)}; {node.get_name()} offers '
                    f'{describe_policies(offered)}; subscribe with what is offered',
                )


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
