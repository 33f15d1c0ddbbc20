"""A ROS domain of its own for the tests of the nodes; they are skipped where ROS is absent."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator

import pytest

rclpy = pytest.importorskip('rclpy', reason='needs ROS 2: pip install .[ros]')

from ros_graph import Graph  # noqa: E402

from segfloor_ros.cli.replay_graph import free_domain  # noqa: E402


@pytest.fixture
def make_graph() -> Iterator[Callable[..., Graph]]:
    """Make a graph whose nodes get the given ROS arguments, in a domain that nobody else uses."""
    graphs: list[Graph] = []

    def make(*arguments: str) -> Graph:
        os.environ['ROS_DOMAIN_ID'] = str(free_domain())
        rclpy.init(args=['--ros-args', '--disable-external-lib-logs', *arguments])
        graphs.append(Graph())
        return graphs[-1]

    yield make
    for graph in graphs:
        graph.close()
    os.environ.pop('ROS_DOMAIN_ID', None)
