"""A ROS graph inside the test process: nodes under test and a tester that talks to them."""

import contextlib
import gc
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from segfloor_ros.apps.cli.replay_nodes import free_domain
from segfloor_ros.nodes.messages.diagnostics import Status, statuses
from segfloor_ros.nodes.messages.topics import DIAGNOSTICS, TOPICS

PATIENCE_S = 60.0


class Graph:
    """Nodes in one executor. Messages between them go through DDS like between processes."""

    def __init__(self) -> None:
        self.tester = Node('tester')
        self.statuses: list[Status] = []
        self.nodes: list[Node] = [self.tester]
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.tester)
        self.tester.create_subscription(
            DIAGNOSTICS.type,
            DIAGNOSTICS.name,
            lambda message: self.statuses.extend(statuses(message)),
            DIAGNOSTICS.profile,
        )

    def add(self, node: Node) -> Any:
        """Run a node in this graph."""
        self.nodes.append(node)
        self._executor.add_node(node)
        return node

    def remove(self, node: Node) -> None:
        """End a node."""
        self.nodes.remove(node)
        self._executor.remove_node(node)
        node.destroy_node()

    def be_deaf(self) -> None:
        """Listen to no statuses any more."""
        for subscription in list(self.tester.subscriptions):
            self.tester.destroy_subscription(subscription)

    def collect(self, name: str) -> list[Any]:
        """Subscribe to a topic; the list grows with its messages."""
        return self.collect_at(name, name)

    def collect_at(self, full_name: str, name: str) -> list[Any]:
        """Subscribe to a topic of `TOPICS` under another name; the list grows with its messages."""
        topic, received = TOPICS[name], []
        self.tester.create_subscription(topic.type, full_name, received.append, topic.profile)
        return received

    def publisher(self, name: str) -> Any:
        """Return a publisher of a topic."""
        return self.tester.create_publisher(TOPICS[name].type, name, TOPICS[name].offered)

    def connected(self, publishers: list[Any]) -> None:
        """Wait until every publisher has a subscriber."""
        self.until(lambda: all(p.get_subscription_count() for p in publishers), 'subscribers')

    def until(self, condition: Callable[[], Any], what: str) -> None:
        """Handle messages until the condition holds; fails naming what did not come."""
        end_s = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < end_s, f'waited in vain for {what}'
            self._executor.spin_once(timeout_sec=0.05)

    def comes(self, condition: Callable[[], Any], patience_s: float) -> bool:
        """Handle messages for a while; returns whether the condition came to hold."""
        end_s = time.monotonic() + patience_s
        while not condition() and time.monotonic() < end_s:
            self._executor.spin_once(timeout_sec=0.05)
        return bool(condition())

    def reports(self, node: str) -> list[Status]:
        """Return the statuses of a node about frames and keyframes."""
        return [s for s in self.statuses if s.node == node and not s.kind]

    def reports_any(self, node: str) -> bool:
        """Whether a node has given any sign of life."""
        return any(status.node == node for status in self.statuses)

    def call(self, kind: Any, name: str, request: Any) -> Any:
        """Call a service and return its response."""
        client = self.tester.create_client(kind, name)
        self.until(client.service_is_ready, f'service {name}')
        future = client.call_async(request)
        self.until(future.done, f'the answer of {name}')
        return future.result()

    def close(self) -> None:
        """Take the graph down."""
        self._executor.shutdown()
        for node in self.nodes:
            node.destroy_node()
        rclpy.try_shutdown()


@contextlib.contextmanager
def fresh_graph(*arguments: str) -> Iterator[Graph]:
    """A graph whose nodes get the given ROS arguments, in surroundings of its own."""
    with surroundings():
        # The middleware of an earlier graph ends with the last reference to it, and is seen until
        # then.
        gc.collect()
        rclpy.init(args=['--ros-args', '--disable-external-lib-logs', *arguments])
        graph = Graph()
        try:
            yield graph
        finally:
            graph.close()


@contextlib.contextmanager
def surroundings() -> Iterator[None]:
    """A domain that nobody else uses, and a folder for what outlives the nodes."""
    with tempfile.TemporaryDirectory(prefix='graph-') as folder:
        changed = {'ROS_DOMAIN_ID': str(free_domain()), 'XDG_RUNTIME_DIR': folder}
        with mock.patch.dict(os.environ, changed):
            yield


@contextlib.contextmanager
def another_participant() -> Iterator[Node]:
    """A node as in another process."""
    context = rclpy.Context()
    rclpy.init(context=context)
    node = Node('driver', context=context)
    try:
        yield node
    finally:
        node.destroy_node()
        rclpy.try_shutdown(context=context)
