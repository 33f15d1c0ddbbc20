"""What the five node processes cost and how long an image takes to the map, measured outside."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import OccupancyGrid, Odometry
from numpy.typing import NDArray
from rclpy.context import Context
from rich.table import Table
from std_srvs.srv import SetBool

from segfloor_ros.cli.replay_nodes import NodeGraph, running_nodes
from segfloor_ros.cli.replay_processes import NodeProcesses, ReplayError
from segfloor_ros.cli.replay_recorder import ReplayRecorder
from segfloor_ros.cli.terminal import value_table
from segfloor_ros.configuration import Configuration
from segfloor_ros.lockstep import ProgressListener
from segfloor_ros.messages.diagnostics import HEALTH, HEALTH_PERIOD_S, Level, Status, statuses
from segfloor_ros.messages.topics import CAMERA, GRID, NODES, SLAM, to_ns
from segfloor_ros.timing import rss_mb

MEMORY_PERIOD_S = 2.0
TICKS_PER_S = os.sysconf('SC_CLK_TCK')


@dataclass(frozen=True)
class NodeFigures:
    """latency_s: (K,) from a keyframe's images to the map that holds it, in the order of the
    keyframes; odometry_s: (N,) from a frame's images to its odometry. steps_s: (K,) the part of the
    former until a node had done its work, since the node before had, by node. cpu_share: seconds of
    CPU per second, by node. memory_mb: (T, 1 + nodes), the number of frames so far and the resident
    memory of every node, over time.
    """

    frames_sent: int
    frames_processed: int
    frames_skipped: int
    keyframes: int
    mapped: int
    wall_s: float
    latency_s: NDArray[np.float64]
    odometry_s: NDArray[np.float64]
    steps_s: dict[str, NDArray[np.float64]]
    cpu_share: dict[str, float]
    memory_mb: NDArray[np.float64]
    shutdown_s: float


class FigureRecorder(ReplayRecorder):
    """Notes when an image was sent, when its map came, and the memory of the nodes."""

    def __init__(self, context: Context, processes: NodeProcesses) -> None:
        super().__init__(context, lambda: 0.0, None)
        self._processes = processes
        self._health: dict[str, Status] = {}
        self._done_s: dict[str, dict[int, float]] = {node: {} for node in NODES}
        self._arrived_s: dict[int, float] = {}
        self._located_s: dict[int, float] = {}
        self.memory_rows: list[list[float]] = []
        self.create_timer(MEMORY_PERIOD_S, self._note_memory)

    def latency_s(self) -> NDArray[np.float64]:
        """Return the latency of every keyframe whose map came, in order."""
        return self._since_sent_s(self._arrived_s)

    def odometry_s(self) -> NDArray[np.float64]:
        """Return the latency of the odometry of every frame that has one, in order."""
        return self._since_sent_s(self._located_s)

    def _since_sent_s(self, arrived_s: dict[int, float]) -> NDArray[np.float64]:
        sent_s = self._done_s[CAMERA]
        both = sorted(sent_s.keys() & arrived_s.keys())
        return np.array([arrived_s[stamp] - sent_s[stamp] for stamp in both])

    def steps_s(self) -> dict[str, NDArray[np.float64]]:
        """Return how long each node took since the one before had done, for every keyframe whose
        map came, in order.
        """
        mapped = sorted(set(self._arrived_s).intersection(*self._done_s.values()))
        done_s = np.array([[self._done_s[node][stamp] for stamp in mapped] for node in NODES])
        return dict(zip(NODES[1:], np.diff(done_s, axis=0), strict=True))

    def count(self, node: str, what: str) -> int:
        """Return how much a node says to have `processed` or `skipped`: it knows best, also where
        this process was too slow to hear it all.
        """
        return int(self._health[node].values[what]) if node in self._health else 0

    def _take_statuses(self, message: DiagnosticArray) -> None:
        self._health.update({s.node: s for s in statuses(message) if s.kind == HEALTH})
        super()._take_statuses(message)

    def _take_status(self, status: Status) -> None:
        if status.node in self._done_s and status.level is Level.OK:
            self._done_s[status.node].setdefault(status.stamp_ns, time.monotonic())
        super()._take_status(status)

    def _take_odometry(self, message: Odometry) -> None:
        self._located_s.setdefault(to_ns(message.header.stamp), time.monotonic())
        super()._take_odometry(message)

    def _take_map(self, message: OccupancyGrid) -> None:
        self._arrived_s.setdefault(to_ns(message.header.stamp), time.monotonic())

    def _note_memory(self) -> None:
        memory = [rss_mb(process_id) for process_id in self._processes.process_ids.values()]
        self.memory_rows.append([len(self.answers), *memory])


FigureGraph = NodeGraph[FigureRecorder]


def measure_nodes(
    configuration: Configuration, rate: float, lossless: bool, on_progress: ProgressListener
) -> NodeFigures:
    """Play the recording of the configuration through the nodes. Raises ReplayError."""
    with connected_nodes(configuration, rate, lossless) as graph:
        return _follow(graph, on_progress)


@contextlib.contextmanager
def connected_nodes(
    configuration: Configuration, rate: float, lossless: bool
) -> Iterator[FigureGraph]:
    """The five nodes in a graph of their own, connected, with the camera paused. Raises
    ReplayError.
    """
    parameters = configuration.as_ros_parameters()
    parameters[CAMERA]['ros__parameters'].update(rate=rate, lossless=lossless, start_paused=True)
    # Else it is this period that is measured.
    parameters[GRID]['ros__parameters'].update(publish_period_s=0.0)
    with running_nodes(lambda _folder: parameters, FigureRecorder) as graph:
        # A camera that keeps to the clock does not listen to the nodes.
        graph.connect(is_paced=lossless)
        yield graph


def _follow(graph: FigureGraph, on_progress: ProgressListener) -> NodeFigures:
    recorder = graph.recorder
    start_s, before_s = time.monotonic(), cpu_s(graph.processes)
    graph.call(SetBool, f'{CAMERA}/pause', SetBool.Request(data=False))
    try:
        graph.play(on_progress, threading.Event())
    except ReplayError:
        # Frames that were lost never come; that is a figure, unless a node has died.
        graph.processes.check()
    wall_s = time.monotonic() - start_s
    spent_s = {node: s - before_s[node] for node, s in cpu_s(graph.processes).items()}
    graph.spin(2 * HEALTH_PERIOD_S)
    stop_s = time.monotonic()
    graph.processes.stop()
    finished, path = recorder.finished, recorder.path
    return NodeFigures(
        frames_sent=int(finished.values['frames']) if finished is not None else 0,
        frames_processed=recorder.count(SLAM, 'processed'),
        frames_skipped=recorder.count(SLAM, 'skipped'),
        keyframes=len(path.stamp_ns) if path is not None else 0,
        mapped=recorder.count(GRID, 'processed'),
        wall_s=wall_s,
        latency_s=recorder.latency_s(),
        odometry_s=recorder.odometry_s(),
        steps_s=recorder.steps_s(),
        cpu_share={node: seconds / wall_s for node, seconds in spent_s.items()},
        memory_mb=np.array(recorder.memory_rows),
        shutdown_s=time.monotonic() - stop_s,
    )


def cpu_s(processes: NodeProcesses) -> dict[str, float]:
    """Return the CPU time every node has used, all threads, user and system (proc(5))."""
    used = {}
    for node, process_id in processes.process_ids.items():
        fields = Path(f'/proc/{process_id}/stat').read_text().rpartition(')')[2].split()
        used[node] = (int(fields[11]) + int(fields[12])) / TICKS_PER_S
    return used


def figures_table(figures: NodeFigures) -> Table:
    """Return the figures as a table; of a course, its second and its last quarter."""
    return value_table('figure', figure_rows(figures))


def figure_rows(figures: NodeFigures) -> list[tuple[str, str]]:
    """Return names and values of the figures, with units."""
    rows = [
        ('frames sent, processed', f'{figures.frames_sent}, {figures.frames_processed}'),
        ('frames skipped to stay up to date', f'{figures.frames_skipped}'),
        ('keyframes, in the map', f'{figures.keyframes}, {figures.mapped}'),
        ('frames per second', f'{figures.frames_processed / figures.wall_s:.1f}'),
        ('interrupt to all ended', f'{figures.shutdown_s:.2f} s'),
    ]
    spreads = {'image to odometry': figures.odometry_s, 'image to map': figures.latency_s}
    spreads |= {f'until {node} had done': steps_s for node, steps_s in figures.steps_s.items()}
    for name, duration_s in spreads.items():
        if len(duration_s):
            middle, high = 1e3 * np.percentile(duration_s, (50, 95))
            rows.append((f'{name}, median and p95', f'{middle:.0f} ms, {high:.0f} ms'))
    if len(figures.latency_s):
        early, late = (
            1e3 * np.median(part) for part in _second_and_last_quarter(figures.latency_s)
        )
        rows.append(('image to map, 2nd and last quarter', f'{early:.0f} ms, {late:.0f} ms'))
    for column, (node, share) in enumerate(figures.cpu_share.items(), 1):
        rows.append((f'{node}: CPU', f'{100 * share:.0f} % of a core'))
        if len(figures.memory_mb):
            parts = _second_and_last_quarter(figures.memory_mb[:, column])
            early, late = (np.median(part) for part in parts)
            rows.append((f'{node}: memory, 2nd and last quarter', f'{early:.1f} MB, {late:.1f} MB'))
    return rows


def _second_and_last_quarter(course: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return two parts of a course (N,) to compare; in the first quarter caches fill."""
    quarter = max(len(course) // 4, 1)
    return course[quarter : 2 * quarter] if len(course) > 1 else course, course[-quarter:]
