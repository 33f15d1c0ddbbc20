"""Runs nodes until they are interrupted."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Sequence

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

from segfloor_ros.errors import SegfloorError
from segfloor_ros.nodes.middleware import prepare_middleware

INTERRUPT_HEARD_S = 0.2


def run_node(make_node: Callable[[], Node]) -> None:
    """Run a node until it is interrupted (status 0); bad parameters or input end it with one
    line and status 2.
    """
    run_nodes(lambda: [make_node()])


def run_nodes(make_nodes: Callable[[], Sequence[Node]]) -> None:
    """Run nodes in one executor, like `run_node`."""
    logging.basicConfig(format='segfloor: %(message)s', level=logging.WARNING)
    status = 0
    nodes: Sequence[Node] = ()
    try:
        prepare_middleware()
        rclpy.init()
        executor = SingleThreadedExecutor()
        nodes = make_nodes()
        for node in nodes:
            executor.add_node(node)
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except SegfloorError as error:
        print(f'segfloor: {error}', file=sys.stderr)
        status = 2
    except Exception:
        # An interrupt takes the middleware away under whatever is being done at that moment, and
        # may be heard of a little later than what it broke.
        time.sleep(INTERRUPT_HEARD_S)
        if rclpy.ok():
            raise
    finally:
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()
    sys.exit(status)
