"""Who listens to a node and who it listens to: reported, and judged once a second."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

from rclpy.node import Node
from rclpy.publisher import Publisher

from segfloor_ros.messages.diagnostics import CONNECTIONS, NEED_LASTS_S, Level
from segfloor_ros.messages.topics import DIAGNOSTICS, TOPICS
from segfloor_ros.nodes.inputs import Inputs
from segfloor_ros.nodes.qos_check import incompatible_topics
from segfloor_ros.nodes.reporter import PROBLEM_LASTS_S, Reporter

FALLS_BEHIND_S = 2.0


class Connections:
    """Counts the subscribers of a node's outputs and finds inputs that do not connect."""

    def __init__(self, node: Node, reporter: Reporter, inputs: Inputs) -> None:
        self._node = node
        self._reporter = reporter
        self._inputs = inputs
        self._reported: dict[str, str] = {}
        self._last_needed_s = time.monotonic()
        self.outputs: dict[str, Publisher] = {}
        """The publishers by the topic's name as in the code."""

    def count_listeners(self) -> dict[str, str]:
        """Return the number of subscribers by topic, with that of the status."""
        counts = {name: str(out.get_subscription_count()) for name, out in self.outputs.items()}
        counts[DIAGNOSTICS.name] = str(self._reporter.publisher.get_subscription_count())
        return counts

    def report(self, counts: Mapping[str, str], always: bool) -> None:
        """Publish the counts when they have changed, or always."""
        if always or counts != self._reported:
            self._reported = dict(counts)
            stamp_ns = self._node.get_clock().now().nanoseconds
            self._reporter.publish(CONNECTIONS, stamp_ns, Level.OK, 'subscribers by topic', counts)

    def are_needed(self, counts: Mapping[str, str], is_needed_otherwise: bool) -> bool:
        """Whether somebody listens, or did a short time ago."""
        now_s = time.monotonic()
        if is_needed_otherwise or any(int(count) for count in counts.values()):
            self._last_needed_s = now_s
        return now_s - self._last_needed_s < NEED_LASTS_S

    def find_problems(self) -> None:
        """Report topics that do not connect, and queues that grow."""
        self._find_incompatible()
        self._find_silent()
        topic, waited_s = self._reporter.health.longest_wait()
        if waited_s > FALLS_BEHIND_S:
            text = (
                f'{self._node.get_name()} falls behind: messages on {topic} wait {waited_s:.1f} s; '
                'lower the rate or the size of the images, or let stereo_slam make fewer keyframes'
            )
            self._reporter.diagnose('queues', text)

    def _find_incompatible(self) -> None:
        subscriptions = self._inputs.subscriptions.values()
        found = incompatible_topics(self._node, self.outputs.values(), subscriptions)
        for topic, text in found:
            self._reporter.diagnose(f'QoS of {topic}', text, Level.ERROR)

    def _find_silent(self) -> None:
        count: Callable[[str], int] = self._inputs.publisher_count
        silent = [
            name
            for name in self._inputs.subscriptions
            if not TOPICS[name].is_optional and not count(name)
        ]
        if silent:
            text = f'nobody publishes {", ".join(silent)}; start the node that does, or remap'
            self._reporter.health.found('publishers', Level.WARN, text, PROBLEM_LASTS_S)
        else:
            self._reporter.health.over('publishers')
