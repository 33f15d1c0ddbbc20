"""Nodes as processes of their own, fed frame by frame by the test, which plays the camera."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from ros_graph import Graph
from stereo_room import CAMERA, MOUNT

from segfloor_ros.apps.programs import program_of
from segfloor_ros.core.contracts import StereoFrame
from segfloor_ros.nodes.messages.camera_infos import camera_info_message, rectified_calibration
from segfloor_ros.nodes.messages.diagnostics import CONNECTIONS, Status
from segfloor_ros.nodes.messages.images import image_message
from segfloor_ros.nodes.messages.topics import CLOUD, FLOOR, GRID, SLAM, published_by

CHAIN = (SLAM, FLOOR, CLOUD, GRID)
SIDES = ('left', 'right')
INPUTS = tuple(f'{side}/{what}' for side in SIDES for what in ('camera_info', 'image_raw'))
PARAMETERS = {
    'camera_height_m': MOUNT.height_m,
    'camera_pitch_rad': MOUNT.pitch_rad,
    'camera_roll_rad': 0.0,
    'num_features': 700,
    'keyframe_max_frames': 1,
    'background': 'false',
    'publish_period_s': 0.0,
    'max_waiting_frames': 100,
}
STOP_S = 20.0
ANSWER_S, WAKE_S = 2.0, 60.0
CALIBRATION = rectified_calibration(CAMERA)


def seen_again(frame: StereoFrame, index: int, stamp_ns: int) -> StereoFrame:
    """Return a frame of the same place at another time; no camera sends the same image twice."""
    left = frame.left.copy()
    left[0, index % left.shape[1]] ^= 1
    return replace(frame, index=index, stamp_ns=stamp_ns, left=left)


class NodeChain:
    """The four nodes behind the camera, each a process; the tester's publishers are the camera."""

    def __init__(self, graph: Graph, folder: Path, command: Sequence[str] = ()) -> None:
        self.graph = graph
        self.inputs = {name: graph.publisher(name) for name in INPUTS}
        self._folder = folder
        self._command = list(command)
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, *nodes: str, **parameters: Any) -> None:
        """Start nodes and wait until all that run are connected with each other."""
        begun = len(self.graph.statuses)
        for node in nodes:
            words = [f'{name}:={value}' for name, value in {**PARAMETERS, **parameters}.items()]
            options = [word for pair in words for word in ('-p', pair)]
            with (self._folder / f'{node}.log').open('ab') as log:
                self._processes[node] = subprocess.Popen(
                    [sys.executable, '-m', program_of(node), '--ros-args', *options],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                )
        self.graph.until(lambda: not self._unconnected(begun), f'{nodes} to be connected')

    def kill(self, node: str) -> None:
        """End a node as a crash does: without a chance to say goodbye."""
        self._processes[node].kill()
        self._processes[node].wait()

    def pid(self, node: str) -> int:
        """Return the process of a node."""
        return self._processes[node].pid

    def lives(self, node: str) -> bool:
        """Whether a node's process runs."""
        return self._processes[node].poll() is None

    def log(self, node: str) -> str:
        """Return what a node has logged, over all its lives."""
        return (self._folder / f'{node}.log').read_text()

    def send(self, frame: StereoFrame, sides: Iterable[str] = SIDES, **changes: Any) -> None:
        """Publish a frame, or one side of it; changes are set on the image messages."""
        for side in sides:
            info = camera_info_message(frame.stamp_ns, f'{side}_eye', getattr(CALIBRATION, side))
            image = image_message(frame.stamp_ns, f'{side}_eye', getattr(frame, side))
            for name, value in changes.items():
                setattr(image, name, value)
            self.inputs[f'{side}/camera_info'].publish(info)
            self.inputs[f'{side}/image_raw'].publish(image)

    def drive(self, frames: Iterable[StereoFrame]) -> list[Status]:
        """Send frames, each when the one before is answered; return SLAM's answers."""
        answers = []
        for frame in frames:
            begun = len(self.graph.statuses)
            self.send(frame)
            answers += self.answers([frame.stamp_ns], begun)
        return answers

    def wake(self, make_frame: Callable[[], StereoFrame]) -> Status:
        """Send frames until SLAM answers one; the first ones after its start may be lost, since one
        that was killed stays visible for a while and cannot be told from its successor.
        """
        end_s = time.monotonic() + WAKE_S
        while time.monotonic() < end_s:
            frame = make_frame()
            self.send(frame)
            if self.graph.comes(partial(self._about, SLAM, frame.stamp_ns, 0), ANSWER_S):
                return self._about(SLAM, frame.stamp_ns, 0)[0]
        raise AssertionError('stereo_slam answers no frame')

    def answers(self, stamps_ns: Iterable[int], since: int = 0) -> list[Status]:
        """Return SLAM's first answers to stamps, waiting for them."""
        answers = []
        for stamp_ns in stamps_ns:
            about = partial(self._about, SLAM, stamp_ns, since)
            self.graph.until(about, f'an answer to {stamp_ns}')
            answers.append(about()[0])
        return answers

    def mapped(self, stamp_ns: int) -> None:
        """Wait until the keyframe of a stamp is in the map."""
        self.graph.until(lambda: self._about(GRID, stamp_ns, 0), f'keyframe {stamp_ns} in the map')

    def stop(self) -> None:
        """End all processes in order, so that they leave nothing behind; one whose middleware
        hangs as it goes, as happens on busy machines, is killed.
        """
        for process in self._processes.values():
            process.send_signal(signal.SIGINT)
        for process in self._processes.values():
            _end(process)

    def _about(self, node: str, stamp_ns: int, since: int) -> list[Status]:
        return [
            s
            for s in self.graph.statuses[since:]
            if s.node == node and s.stamp_ns == stamp_ns and not s.kind
        ]

    def _unconnected(self, since: int) -> list[str]:
        """Return the topics that the latest signs of life say to lack listeners."""
        running = [node for node in self._processes if self.lives(node)]
        latest = {s.node: s for s in self.graph.statuses[since:] if s.kind == CONNECTIONS}
        lacking = [node for node in running if node not in latest]
        for node in set(running) - set(lacking):
            for topic in published_by(node):
                wanted = len(set(topic.subscribers) & set(running))
                if int(latest[node].values[topic.name]) < wanted:
                    lacking.append(topic.name)
        wanted = SLAM in running
        lacking += [n for n, p in self.inputs.items() if wanted and not p.get_subscription_count()]
        return lacking


def _end(process: subprocess.Popen[bytes]) -> None:
    try:
        process.wait(timeout=STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
