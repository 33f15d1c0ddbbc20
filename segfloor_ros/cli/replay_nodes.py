"""The five node processes in a graph of their own, and what listens to them."""

from __future__ import annotations

import contextlib
import os
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, Generic, TypeVar

import rclpy
import yaml
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions

from segfloor_ros.cli.replay_processes import NodeProcesses, ReplayError
from segfloor_ros.cli.replay_recorder import ReplayRecorder
from segfloor_ros.errors import SegfloorError
from segfloor_ros.files.results import scratch_folder
from segfloor_ros.lockstep import ProgressListener
from segfloor_ros.messages.topics import DIAGNOSTICS, NODES, PACED_BY, TOPICS

# DDSI-RTPS 2.3, 9.6.1.1: discovery ports start at 7400, 250 per domain. Above domain 101 they run
# into the ports that Linux hands out to clients.
FIRST_PORT, PORTS_PER_DOMAIN, DOMAINS = 7400, 250, 101
PARTICIPANT_OFFSET = 10
PARTICIPANTS_TRIED = 8

_reservation: socket.socket | None = None
"""Holds the last port of the domain that this process was told."""

DISCOVERY_S = 30.0

STALL_S = 60.0

DRAIN_S = 10.0

SERVICE_S = 10.0

SPIN_S = 0.1

Recorder = TypeVar('Recorder', bound=ReplayRecorder)


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
) -> list[str]:
    """Return what is missing before the first frame can be sent without loss, in words.

    counts: subscribers by node and topic, as each publisher sees them. recorded: topics that the
    replay itself listens to. is_paced: the camera listens
    to how far the frames are.
    """
    missing = []
    for node in NODES:
        if node not in counts:
            missing.append(f'{node} (no sign of life)')
            continue
        needed = {topic: _listeners_of(topic, recorded, is_paced) for topic in counts[node]}
        missing += [
            f'{topic} ({counts[node][topic]} of {number} subscribers)'
            for topic, number in needed.items()
            if counts[node][topic] < number
        ]
    return missing


def _listeners_of(topic: str, recorded: Collection[str], is_paced: bool) -> int:
    if topic == DIAGNOSTICS.name:
        return 1  # the replay itself
    listeners = len(TOPICS[topic].subscribers) + (topic in recorded)
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
    make_recorder: Callable[[Context, NodeProcesses], Recorder],
    params_file: Path | None = None,
) -> Iterator[NodeGraph[Recorder]]:
    """Run the five nodes, not connected yet, until the block ends. make_parameters: gets a folder
    for files of this graph alone; its values win over those of params_file.
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
            with NodeProcesses(NODES, arguments, environment, folder) as processes:
                yield NodeGraph(make_recorder(context, processes), processes, folder)
    finally:
        rclpy.try_shutdown(context=context)


class NodeGraph(Generic[Recorder]):
    """The running nodes and the one that listens to them. folder: for files of the graph alone."""

    def __init__(self, recorder: Recorder, processes: NodeProcesses, folder: Path) -> None:
        self.recorder = recorder
        self.processes = processes
        self.folder = folder
        self._executor = SingleThreadedExecutor(context=recorder.context)
        self._executor.add_node(recorder)

    def connect(self, is_paced: bool = True, interrupted: threading.Event | None = None) -> float:
        """Wait until every topic has its subscribers; returns the seconds it took."""
        start_s, recorder = time.monotonic(), self.recorder
        while missing := unconnected(recorder.connections, recorder.recorded, is_paced):
            if time.monotonic() - start_s > DISCOVERY_S:
                raise ReplayError(
                    f'after {DISCOVERY_S:g} s these are not connected: {", ".join(missing)}; is '
                    'the loopback interface up, and does a firewall block UDP?'
                )
            if interrupted is not None and interrupted.is_set():
                raise ReplayError('interrupted')
            self.spin()
        return time.monotonic() - start_s

    def wait_for_map(self) -> None:
        """Wait until there is a map: one that is loaded takes its time."""
        deadline_s = time.monotonic() + DRAIN_S
        while self.recorder.grid is None and time.monotonic() < deadline_s:
            self.spin()

    def call(self, kind: Any, name: str, request: Any, patience_s: float = SERVICE_S) -> None:
        """Call a service. Raises ReplayError with its answer when it fails."""
        response = self.ask(kind, name, request, patience_s)
        if not response.success:
            raise ReplayError(f'{name}: {response.message}')

    def ask(self, kind: Any, name: str, request: Any, patience_s: float = SERVICE_S) -> Any:
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
        recorder = self.recorder
        recorder.last_sign_s = time.monotonic()
        while not recorder.is_drained():
            if interrupted.is_set():
                return False
            self.spin()
            last = recorder.answers.get(max(recorder.answers, default=0))
            on_progress(len(recorder.answers), last.message if last else '')
            quiet_s = time.monotonic() - recorder.last_sign_s
            if quiet_s > (DRAIN_S if recorder.finished is not None else STALL_S):
                raise ReplayError(
                    f'nothing has happened for {quiet_s:.0f} s; {len(recorder.unanswered())} '
                    f'frames are not tracked and {len(recorder.unmapped())} keyframes not mapped'
                )
        return True

    def catch_up(self) -> None:
        """Wait until what was sent has arrived, or nothing more comes."""
        recorder = self.recorder
        recorder.last_sign_s = time.monotonic()
        while not recorder.has_caught_up():
            self.spin()
            if time.monotonic() - recorder.last_sign_s > DRAIN_S:
                return

    def spin(self, duration_s: float = SPIN_S) -> None:
        """Handle what arrives within a moment, then see that all nodes live."""
        end_s = time.monotonic() + duration_s
        while (left_s := end_s - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left_s)
        self.processes.check()
