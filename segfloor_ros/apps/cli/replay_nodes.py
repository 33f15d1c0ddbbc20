"""The node processes of a replay in a graph of their own: started, watched and stopped together,
also when interrupted.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import rclpy
import yaml
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import SetBool

from segfloor_ros.apps.cli.replay_recorder import SEMANTIC, SPIN_S, MaskListener, ReplayRecorder
from segfloor_ros.apps.lockstep import ProgressListener
from segfloor_ros.apps.programs import program_of
from segfloor_ros.core.errors import MapError, SegfloorError
from segfloor_ros.core.files.writing import scratch_folder
from segfloor_ros.core.grid.occupancy import OccupancyGrid
from segfloor_ros.core.memory import rss_mb
from segfloor_ros.core.processes import end_with_parent, how_it_ended, interrupts_deferred
from segfloor_ros.nodes.messages.grids import grid_of
from segfloor_ros.nodes.messages.topics import (
    DIAGNOSTICS,
    GRID,
    NODES,
    PACED_BY,
    PATIENCE_S,
    TOPICS,
    to_ns,
)

# DDSI-RTPS 2.3, 9.6.1.1: discovery ports start at 7400, 250 per domain. Above domain 101 they run
# into the ports that Linux hands out to clients.
FIRST_PORT, PORTS_PER_DOMAIN, DOMAINS, PARTICIPANT_OFFSET = 7400, 250, 101, 10
PARTICIPANTS_TRIED = 8

_reservation: socket.socket | None = None
"""Holds the last port of the domain that this process was told."""

STALL_S = 60.0
"""So long nodes may take to connect, to go on, or to save a map."""

STOP_S = 1.2
"""So long processes have to end at a signal before the next, harder one."""

NOTICES = ('[WARN]', '[ERROR]', '[FATAL]', 'segfloor: ')


class ReplayError(MapError):
    """The replay broke off: a node died or the nodes do not find each other."""


class NodeProcesses:
    """One process per node. As a context manager it leaves none of them behind."""

    def __init__(
        self,
        nodes: Iterable[str],
        arguments: Sequence[str],
        environment: Mapping[str, str],
        log_folder: Path,
    ) -> None:
        self._environment = dict(environment)
        self._logs = {node: log_folder / f'{node}.log' for node in nodes}
        self._arguments = list(arguments)
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self.restarts_killed = False
        """Whether a node that was killed is started again."""

    def __enter__(self) -> NodeProcesses:
        try:
            with interrupts_deferred():
                for node in self._logs:
                    self._start(node)
        except BaseException:
            # `__exit__` is not called for what happens in here.
            self.stop()
            raise
        return self

    def _start(self, node: str) -> None:
        command = [sys.executable, '-m', program_of(node), *self._arguments]
        with self._logs[node].open('ab') as output:
            self._processes[node] = subprocess.Popen(
                command,
                env=self._environment,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                # An interrupt from the terminal ends the replay, which then stops its nodes.
                start_new_session=True,
                preexec_fn=partial(end_with_parent, os.getpid()),
            )

    def __exit__(self, *error: object) -> None:
        self.stop()

    def check(self) -> None:
        """Raise ReplayError naming the node whose process has ended."""
        for node, process in self._processes.items():
            status = process.poll()
            if status is not None and status < 0 and self.restarts_killed:
                self._start(node)
            elif status is not None:
                raise ReplayError(
                    f'node {node} died ({how_it_ended(status)}){self._last_words(node)}'
                )

    @property
    def process_ids(self) -> dict[str, int]:
        """The process of every node."""
        return {node: process.pid for node, process in self._processes.items()}

    def rss_mb(self) -> float:
        """Return the resident memory of all processes together in MB."""
        return sum(rss_mb(process.pid) for process in self._processes.values())

    def stop(self) -> float:
        """Interrupt all processes; terminate, then kill those that stay. Returns the seconds it
        took.
        """
        start_s = time.monotonic()
        for stop_signal in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            running = [p for p in self._processes.values() if p.poll() is None]
            for process in running:
                process.send_signal(stop_signal)
            deadline_s = time.monotonic() + STOP_S
            for process in running:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(max(deadline_s - time.monotonic(), 0.0))
        return time.monotonic() - start_s

    def notices(self) -> list[str]:
        """Return the warnings and errors the nodes have logged, each line once."""
        lines = (
            f'{node}: {_without_clock(line)}'
            for node in self._logs
            for line in self._lines(node)
            if any(mark in line for mark in NOTICES)
        )
        return list(dict.fromkeys(lines))

    def _lines(self, node: str) -> list[str]:
        text = self._logs[node].read_text(errors='replace') if self._logs[node].exists() else ''
        return [line.strip() for line in text.splitlines() if line.strip()]

    def _last_words(self, node: str) -> str:
        lines = self._lines(node)
        return f': {_without_clock(lines[-1])}' if lines else ''


def _without_clock(line: str) -> str:
    """Strip `[WARN] [1700000000.123456789] [node]: ` from a line of the ROS log."""
    for mark in NOTICES:
        if line.startswith(mark):
            return line.partition(']: ')[2] or line.removeprefix(mark)
    return line


def isolated_environment() -> dict[str, str]:
    """Return the environment of a graph that no other node on the network sees or disturbs.

    A domain or a discovery range that the user has set is kept.
    """
    environment = dict(os.environ)
    environment.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    if not environment.get('ROS_DOMAIN_ID'):
        environment['ROS_DOMAIN_ID'] = str(free_domain())
    return environment


def free_domain() -> int:
    """Return a ROS domain id without participants on this machine.

    It is reserved for this process until the next call: no other process is told the same one.
    """
    global _reservation
    for attempt in range(DOMAINS):
        domain = 1 + (os.getpid() + attempt) % DOMAINS
        first = FIRST_PORT + PORTS_PER_DOMAIN * domain
        reservation = _bind(first + PORTS_PER_DOMAIN - 1, socket.SOCK_STREAM)
        if reservation is None:
            continue
        if all(_is_free(first + PARTICIPANT_OFFSET + 2 * i) for i in range(PARTICIPANTS_TRIED)):
            _reservation = reservation
            return domain
    raise SegfloorError('every ROS domain id is in use on this machine; set ROS_DOMAIN_ID')


def unconnected(
    counts: Mapping[str, Mapping[str, int]],
    recorded: Collection[str] = (),
    is_paced: bool = True,
    nodes: Collection[str] = NODES,
) -> list[str]:
    """Return what is missing before the first frame can be sent without loss, in words.

    counts: subscribers by node and topic, as each publisher sees them. recorded: topics that the
    replay itself listens to. is_paced: the camera listens to how far the frames are. nodes: those
    that run.
    """
    missing = []
    for node in nodes:
        if node not in counts:
            missing.append(f'{node} (no sign of life)')
            continue
        needed = {topic: _listeners_of(topic, recorded, is_paced, nodes) for topic in counts[node]}
        missing += [
            f'{topic} ({counts[node][topic]} of {number} subscribers)'
            for topic, number in needed.items()
            if counts[node][topic] < number
        ]
    return missing


def _listeners_of(
    topic: str, recorded: Collection[str], is_paced: bool, nodes: Collection[str]
) -> int:
    if topic == DIAGNOSTICS.name:
        return 1  # the replay itself
    listeners = len(set(TOPICS[topic].subscribers) & set(nodes)) + (topic in recorded)
    return listeners + (is_paced and topic in PACED_BY)


def _is_free(port: int) -> bool:
    probe = _bind(port, socket.SOCK_DGRAM)
    if probe is not None:
        probe.close()
    return probe is not None


def _bind(port: int, kind: socket.SocketKind) -> socket.socket | None:
    bound = socket.socket(socket.AF_INET, kind)
    try:
        bound.bind(('', port))
    except OSError:
        bound.close()
        return None
    return bound


@contextlib.contextmanager
def running_nodes(
    make_parameters: Callable[[Path], dict[str, Any]],
    params_file: Path | None = None,
    on_mask: MaskListener | None = None,
    nodes: Sequence[str] = NODES,
) -> Iterator[NodeGraph]:
    """Run nodes, not connected yet, until the block ends. make_parameters: gets a folder for files
    of this graph alone; its values win over those of params_file.
    """
    environment = isolated_environment()
    # This process takes part in the same graph.
    os.environ.update(environment)
    context = rclpy.Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    try:
        with scratch_folder(Path(tempfile.gettempdir()), 'segfloor-nodes-') as folder:
            resolved = folder / 'parameters.yaml'
            resolved.write_text(yaml.safe_dump(make_parameters(folder)))
            files = [str(file) for file in (params_file, resolved) if file is not None]
            options = [word for file in files for word in ('--params-file', file)]
            arguments = ['--ros-args', '--disable-external-lib-logs', *options]
            with NodeProcesses(nodes, arguments, environment, folder) as processes:
                path_only = GRID not in nodes
                recorder = ReplayRecorder(context, processes.rss_mb, on_mask, path_only)
                yield NodeGraph(recorder, processes, folder)
    finally:
        rclpy.try_shutdown(context=context)


class NodeGraph:
    """The running nodes and the one that listens to them. folder: for files of the graph alone."""

    def __init__(self, recorder: ReplayRecorder, processes: NodeProcesses, folder: Path) -> None:
        self.recorder = recorder
        self.processes = processes
        self.folder = folder
        self._executor = SingleThreadedExecutor(context=recorder.context)
        self._executor.add_node(recorder)

    def add(self, node: Node) -> None:
        """Have a node of this process handle what arrives, too."""
        self._executor.add_node(node)

    def connect(self, is_paced: bool = True, interrupted: threading.Event | None = None) -> float:
        """Wait until every topic has its subscribers; returns the seconds it took."""
        start_s, recorder = time.monotonic(), self.recorder
        counts, nodes = recorder.notes.connections, self.processes.process_ids
        while missing := unconnected(counts, recorder.recorded, is_paced, nodes):
            if time.monotonic() - start_s > STALL_S:
                raise ReplayError(
                    f'after {STALL_S:g} s these are not connected: {", ".join(missing)}; is '
                    'the loopback interface up, and does a firewall block UDP?'
                )
            if interrupted is not None and interrupted.is_set():
                raise ReplayError('interrupted')
            self.spin()
        return time.monotonic() - start_s

    def wait_for_map(self) -> None:
        """Wait until there is a map: one that is loaded takes its time."""
        deadline_s = time.monotonic() + PATIENCE_S
        while 'map' not in self.recorder.latest and time.monotonic() < deadline_s:
            self.spin()

    def wait_for_labels(self) -> OccupancyGrid | None:
        """Wait for the numbers of the classes of the last map; None where they do not come."""
        deadline_s, path = time.monotonic() + PATIENCE_S, self.recorder.path
        while path is not None and time.monotonic() < deadline_s:
            labels = self.recorder.latest.get(SEMANTIC)
            if labels is not None and to_ns(labels.header.stamp) >= path.stamp_ns[-1]:
                return grid_of(labels)
            self.spin()
        return None

    def call(self, kind: Any, name: str, request: Any, patience_s: float = PATIENCE_S) -> None:
        """Call a service. Raises ReplayError with its answer when it fails."""
        response = self.ask(kind, name, request, patience_s)
        if not response.success:
            raise ReplayError(f'{name}: {response.message}')

    def pause(self, node: str, is_paused: bool) -> None:
        """Pause a node, or have it go on. Raises ReplayError."""
        self.call(SetBool, f'{node}/pause', SetBool.Request(data=is_paused))

    def ask(self, kind: Any, name: str, request: Any, patience_s: float = PATIENCE_S) -> Any:
        """Return the answer of a service. Raises ReplayError where there is none."""
        client = self.recorder.create_client(kind, name)
        deadline_s = time.monotonic() + patience_s
        while not client.service_is_ready() and time.monotonic() < deadline_s:
            self.spin()
        future = client.call_async(request)
        while not future.done() and time.monotonic() < deadline_s:
            self.spin()
        if not future.done():
            raise ReplayError(f'the service {name} does not answer')
        return future.result()

    def play(self, on_progress: ProgressListener, interrupted: threading.Event) -> bool:
        """Follow the nodes until the recording has ended and everything sent has arrived; False
        when an interrupt came before.
        """
        notes = self.recorder.notes
        notes.last_sign_s = time.monotonic()
        while not self.recorder.is_drained():
            if interrupted.is_set():
                return False
            self.spin()
            last = notes.answers.get(max(notes.answers, default=0))
            on_progress(len(notes.answers), last.message if last else '')
            quiet_s = time.monotonic() - notes.last_sign_s
            if quiet_s > (PATIENCE_S if notes.finished is not None else STALL_S):
                raise ReplayError(
                    f'nothing has happened for {quiet_s:.0f} s; {len(notes.unanswered())} '
                    f'frames are not tracked and {len(notes.unmapped())} keyframes not mapped'
                )
        return True

    def catch_up(self) -> None:
        """Wait until what was sent has arrived, or nothing more comes."""
        notes = self.recorder.notes
        notes.last_sign_s = time.monotonic()
        while not self.recorder.has_caught_up():
            self.spin()
            if time.monotonic() - notes.last_sign_s > PATIENCE_S:
                return

    def spin(self, duration_s: float = SPIN_S) -> None:
        """Handle what arrives within a moment, then see that all nodes live."""
        end_s = time.monotonic() + duration_s
        while (left_s := end_s - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left_s)
        self.processes.check()
