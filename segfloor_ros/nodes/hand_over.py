"""Messages between nodes of one process: handed over as they are, without serialisation.

rclpy has no intra-process communication of its own. Here a publisher gives its messages to the
subscriptions in the same process directly, and to DDS only while somebody outside listens. The
receiver's callback runs later, in the executor, as it does for a message from DDS.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from rclpy.executors import Executor
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.serialization import serialize_message

TopicCallback = Callable[[Any, Mapping[str, Any]], None]
"""Takes a message and what the middleware tells of it, as rclpy hands them on."""


class HandOver:
    """Knows the publishers and subscriptions of one process by their full topic names."""

    def __init__(self, executor: Executor) -> None:
        self._executor = executor
        self._publishers: dict[str, LocalPublisher] = {}
        self._subscriptions: dict[str, list[LocalSubscription]] = {}

    def publisher(self, publisher: Publisher, profile: QoSProfile) -> LocalPublisher:
        """Return a publisher that also serves this process."""
        latched = profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
        made = LocalPublisher(publisher, self.subscriptions(publisher.topic_name), latched)
        self._publishers[publisher.topic_name] = made
        return made

    def subscribe(
        self, topic: str, callback: TopicCallback, profile: QoSProfile, raw: bool
    ) -> LocalSubscription | None:
        """Subscribe to a topic of this process; None where no node of it publishes the topic."""
        publisher = self._publishers.get(topic)
        if publisher is None:
            return None
        made = LocalSubscription(self._executor, callback, profile.depth, raw)
        self.subscriptions(topic).append(made)
        if publisher.latched is not None:
            made.take(publisher.latched)
        return made

    def unsubscribe(self, subscription: LocalSubscription) -> None:
        """Take a subscription back; what waits for it is dropped."""
        subscription.close()
        for subscriptions in self._subscriptions.values():
            if subscription in subscriptions:
                subscriptions.remove(subscription)

    def subscriptions(self, topic: str) -> list[LocalSubscription]:
        """Return the subscriptions of a topic, a list that follows changes."""
        return self._subscriptions.setdefault(topic, [])


class LocalPublisher:
    """A publisher whose messages reach subscriptions in this process directly."""

    def __init__(
        self, publisher: Publisher, subscriptions: list[LocalSubscription], is_latched: bool
    ) -> None:
        self.outside = publisher
        self.latched: Message | None = None
        self._subscriptions = subscriptions
        self._is_latched = is_latched
        self._count = 0

    @property
    def topic_name(self) -> str:
        """The full name of the topic."""
        return self.outside.topic_name

    def get_subscription_count(self) -> int:
        """Return the number of subscriptions in this process and outside."""
        return len(self._subscriptions) + self.outside.get_subscription_count()

    def publish(self, content: Any) -> None:
        """Hand a message over. It must not be changed any more."""
        self._count += 1
        message = Message(content, self._count)
        if self._is_latched:
            self.latched = message
        for subscription in self._subscriptions:
            subscription.take(message)
        # DDS keeps the latched ones itself for whoever comes later.
        if self._is_latched or self.outside.get_subscription_count():
            self.outside.publish(content)


class LocalSubscription:
    """Keeps the last messages until the executor gets to them, as the depth of a topic says."""

    def __init__(self, executor: Executor, callback: TopicCallback, depth: int, raw: bool) -> None:
        self._executor = executor
        self._callback = callback
        self._raw = raw
        self._waiting: deque[tuple[Message, int]] = deque(maxlen=depth)

    def get_publisher_count(self) -> int:
        """Return how many publish the topic: the one in this process."""
        return 1

    def take(self, message: Message) -> None:
        """Have the callback called with a message."""
        self._waiting.append((message, time.time_ns()))
        self._executor.create_task(self._process)

    def close(self) -> None:
        """Drop what waits."""
        self._waiting.clear()

    def _process(self) -> None:
        if self._waiting:
            message, taken_ns = self._waiting.popleft()
            info = {'publication_sequence_number': message.number, 'received_timestamp': taken_ns}
            self._callback(message.serialized() if self._raw else message.content, info)


class Message:
    """A message under way, serialised at most once; it may be published in that form."""

    def __init__(self, content: Any, number: int) -> None:
        self.content = content
        self.number = number
        self._serialized: bytes | None = content if isinstance(content, bytes) else None

    def serialized(self) -> bytes:
        """Return the message as it would travel."""
        if self._serialized is None:
            self._serialized = serialize_message(self.content)
        return self._serialized
