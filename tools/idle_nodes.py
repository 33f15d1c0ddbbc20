"""What the five node processes cost while there is little or nothing to do."""

from __future__ import annotations

import time

from segfloor_ros.apps.cli.replay_nodes import NodeGraph
from segfloor_ros.apps.cli.replay_session import connected_nodes, cpu_s
from segfloor_ros.core.configuration import Configuration
from segfloor_ros.nodes.messages.diagnostics import LASTS_S
from segfloor_ros.nodes.messages.topics import CAMERA, GRID

SETTLE_S = 3.0
ALL_IDLE_S = 3 * LASTS_S + SETTLE_S
"""One node after the other finds that nobody needs it."""

PHASES = ('no images', 'camera stands', 'grid paused, nobody listens')


def measure_idle(configuration: Configuration, duration_s: float) -> dict[str, dict[str, float]]:
    """Return seconds of CPU per second by phase (`PHASES`) and node. Raises ReplayError.

    configuration: its recording is that of a camera that stands, and longer than twice the
    duration.
    """
    shares = {}
    with connected_nodes(configuration, 1.0, lossless=False) as graph:
        graph.spin(SETTLE_S)
        shares[PHASES[0]] = _shares(graph, duration_s, spin=True)
        graph.pause(CAMERA, False)
        graph.spin(2 * SETTLE_S)
        shares[PHASES[1]] = _shares(graph, duration_s, spin=True)
        # The grid maps whether anybody listens or not.
        graph.pause(GRID, True)
        graph.recorder.destroy_node()
        time.sleep(ALL_IDLE_S)
        shares[PHASES[2]] = _shares(graph, duration_s, spin=False)
    return shares


def longest_s(duration_s: float) -> float:
    """Return how long the recording has to be."""
    return 2 * duration_s + ALL_IDLE_S + 5 * SETTLE_S


def _shares(graph: NodeGraph, duration_s: float, spin: bool) -> dict[str, float]:
    start_s, before_s = time.monotonic(), cpu_s(graph.processes)
    if spin:
        graph.spin(duration_s)
    else:
        time.sleep(duration_s)
    elapsed_s = time.monotonic() - start_s
    return {n: (s - before_s[n]) / elapsed_s for n, s in cpu_s(graph.processes).items()}
