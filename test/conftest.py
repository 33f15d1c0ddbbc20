"""Fixtures shared by all tests."""

import contextlib
import importlib.util
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from segfloor_ros.core.threads import limit_threads

# Message fields of a wrong type must fail instead of being sent as garbage; read on import.
os.environ['ROS_PYTHON_CHECK_FIELDS'] = '1'
os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
limit_threads()
if 'PYTEST_XDIST_WORKER' in os.environ:
    import cv2  # not before the line above: it imports NumPy

    # Threads of parallel test processes only wait for each other.
    cv2.setNumThreads(1)

REPOSITORY = Path(__file__).resolve().parents[1]
SHARED_DATA = REPOSITORY.parent / 'shared' / 'data'
HAS_ROS = importlib.util.find_spec('rclpy') is not None
collect_ignore_glob = [] if HAS_ROS else ['messages/*', 'nodes/*']


def pytest_report_header() -> str:
    """Say at the top what is left out."""
    return (
        '' if HAS_ROS else 'rclpy is not installed: test/nodes/messages and test/nodes are left out'
    )


@pytest.fixture
def shared_data() -> Path:
    """Folder of real recordings beside the repository; where it is absent the test is skipped."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f'needs the recordings in {SHARED_DATA}, which are not part of the repository')
    return SHARED_DATA


@pytest.fixture
def make_graph() -> Iterator[Callable[..., Any]]:
    """Make a graph whose nodes get the given ROS arguments, in a domain that nobody else uses."""
    from ros_graph import Graph, fresh_graph

    with contextlib.ExitStack() as stack:

        def make(*arguments: str) -> Graph:
            return stack.enter_context(fresh_graph(*arguments))

        yield make
