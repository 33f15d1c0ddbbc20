"""Who listens to a node and who it listens to: reported, and judged once a second."""

from __future__ import annotations

import time
from collections.abc import Mapping

from rclpy.node import Node
from rclpy.publisher import Publisher

from segfloor_ros.messages.diagnostics import CONNECTIONS, NEED_LASTS_S, Level
from segfloor_ros.messages.topics import DIAGNOSTICS, TOPICS
from segfloor_ros.nodes.inputs import Inputs
from segfloor_ros.nodes.lookalikes import in_words, lookalikes, published_kinds
from segfloor_ros.nodes.qos_check import incompatible_topics
from segfloor_ros.nodes.reporter import PROBLEM_LASTS_S, Reporter

FALLS_BEHIND_S = 2.0
KILLED_SEEN_S = 20.0
"""How long Fast DDS shows a process that was killed."""

REPEAT_SILENT_S = 30.0
SILENT_S = 3.0
"""A topic that nobody publishes for so long is logged."""


class Connections:
    """Counts the subscribers of a node's outputs and finds inputs that do not connect."""

    def __init__(self, node: Node, reporter: Reporter, inputs: Inputs) -> None:
        self._node = node
        self._reporter = reporter
        self._inputs = inputs
        self._reported: dict[str, str] = {}
        self._last_needed_s = time.monotonic()
        self._silent_since_s: dict[str, float] = {}
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
        """Report topics that do not connect, a node of the same name, and queues that grow."""
        self._find_incompatible()
        self._find_silent()
        self._find_twin()
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
        """Report inputs that nobody publishes, each with what is published that looks like it."""
        inputs = self._inputs
        silent = [
            name
            for name in inputs.subscriptions
            if not TOPICS[name].is_optional and not inputs.publisher_count(name)
        ]
        now_s = time.monotonic()
        self._silent_since_s = {name: self._silent_since_s.get(name, now_s) for name in silent}
        if not silent:
            self._reporter.health.over('publishers')
            return
        text = f'nobody publishes {", ".join(silent)}; start the node that does, or remap'
        if now_s - min(self._silent_since_s.values()) < SILENT_S:
            self._reporter.health.found('publishers', Level.WARN, text, PROBLEM_LASTS_S)
            return
        hints = [hint for name in silent if (hint := self._hint(name))]
        text = '; '.join([text, *hints])
        self._reporter.diagnose('publishers', text, repeat_s=REPEAT_SILENT_S)

    def _hint(self, name: str) -> str:
        """Return what is published that looks like a topic, in words; '' where nothing does."""
        topic, kind = self._node.resolve_topic_name(name), TOPICS[name].type_name
        others = [k for k in published_kinds(self._node, topic) if k != kind]
        if others:
            return f'{topic} is published as {in_words(others)}, not as {kind}'
        found = lookalikes(self._node, topic, kind)
        if not found:
            return f'{topic}: no other topic of the type {kind} is published'
        return f'{topic}: published with this type are {in_words(found)} (-r {name}:={found[0]})'

    def _find_twin(self) -> None:
        """Report another node of the same name: both would publish on the same topics."""
        name, namespace = self._node.get_name(), self._node.get_namespace()
        same = [
            one for one in self._node.get_node_names_and_namespaces() if one == (name, namespace)
        ]
        if len(same) > 1:
            text = (
                f'{len(same)} nodes are called {self._node.get_fully_qualified_name()} and publish '
                'on the same topics; stop the other one, or give this one a namespace; one that '
                f'was killed is seen for up to {KILLED_SEEN_S:g} s'
            )
            self._reporter.diagnose('twin', text, Level.ERROR, repeat_s=REPEAT_SILENT_S)
