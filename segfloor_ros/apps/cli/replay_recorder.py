"""The listener of a replay: collects what the nodes publish and knows when all is done."""

from __future__ import annotations

import contextlib
import json
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import CameraInfo

from segfloor_ros.apps.cli.view import View
from segfloor_ros.apps.profiling import MemoryLog
from segfloor_ros.apps.results_folder import DriveFrame
from segfloor_ros.apps.trajectory import TrackedPose
from segfloor_ros.core.contracts import KeyframePath, Mount
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.timing import StageTimes
from segfloor_ros.nodes.messages import diagnostics
from segfloor_ros.nodes.messages.colours import bgr_image
from segfloor_ros.nodes.messages.diagnostics import Level, Status
from segfloor_ros.nodes.messages.grids import grid_of
from segfloor_ros.nodes.messages.images import grey8_image
from segfloor_ros.nodes.messages.points import labelled_arrays, moving_points_arrays
from segfloor_ros.nodes.messages.poses import path_arrays, pose_array, transform_array
from segfloor_ros.nodes.messages.topics import (
    CAMERA,
    CLOUD,
    CORRECTED,
    DIAGNOSTICS,
    FLOOR,
    GRID,
    KEYFRAME_DONE,
    NODES,
    SLAM,
    TOPICS,
    to_ns,
)

MaskListener = Callable[[str, NDArray[np.uint8]], None]
"""Gets the number of a frame, as in the names of masks, and its floor mask."""

SPIN_S = 0.1
"""So long what arrives is waited for at a time."""

POSES = ('odometry', 'pose')
MASK, POINTS, KEYFRAME = 'keyframe/floor_mask', 'map_points', 'keyframe/odometry'
MOUNT, LABELLED = 'camera_mount', 'labelled_points'
OF_PATH = (*POSES, *(name + CORRECTED for name in POSES), MOUNT, 'keyframe/path')
SEMANTIC = 'semantic_map'
OF_MAP = (*OF_PATH, MASK, LABELLED, 'map', SEMANTIC)
"""What a replay records: of a path alone, and of a map."""


FRAME, FRAME_INFO = 'frame/left/image_rect', 'frame/left/camera_info'
OVERLAY, MOVING = 'keyframe/floor_overlay', 'moving_points'


class DriveNotes:
    """What the statuses of the nodes say about a drive; everything is filed under its stamp."""

    def __init__(self, measure_mb: Callable[[], float]) -> None:
        self.times = StageTimes()
        self.memory = MemoryLog(measure_mb)
        self.connections: dict[str, dict[str, int]] = {}
        self.frame_index: dict[int, int] = {}
        self.answers: dict[int, Status] = {}
        self.finished: Status | None = None
        self.updated: set[int] = set()
        self.failed: dict[int, Status] = {}
        self.health: dict[str, Status] = {}
        self._remarks: dict[str, list[str]] = {}
        self.done_s: dict[str, dict[int, float]] = {node: {} for node in NODES}
        """When a node said first that it was done with a stamp."""
        self.last_sign_s = time.monotonic()

    def take(self, message: DiagnosticArray) -> None:
        """Take in what a node says."""
        for status in diagnostics.statuses(message):
            if status.kind == diagnostics.CONNECTIONS:
                counts = {topic: int(count) for topic, count in status.values.items()}
                self.connections[status.node] = counts
            elif status.kind == diagnostics.RECORDING:
                self.finished = status
            elif status.kind == diagnostics.HEALTH:
                self.health[status.node] = status
            elif not status.kind:
                self._take_status(status)

    def _take_status(self, status: Status) -> None:
        self.last_sign_s = time.monotonic()
        if 'processing_ms' in status.values:
            self.times.add(status.node, 1e-3 * float(status.values['processing_ms']))
        if status.level is Level.OK and status.node in NODES:
            self.done_s[status.node].setdefault(status.stamp_ns, self.last_sign_s)
        if 'remarks' in status.values:
            said = status.values['remarks']
            self._remarks[status.node] = said.split(diagnostics.REMARKS_APART) if said else []
        if status.node == CAMERA:
            self.frame_index[status.stamp_ns] = int(status.values['frame_index'])
        elif status.node == SLAM:
            self.answers[status.stamp_ns] = status
        elif status.node == GRID and status.level is Level.OK:
            self.updated.add(status.stamp_ns)
            self.memory.sample()
        elif status.node in (FLOOR, CLOUD, GRID) and status.level is Level.ERROR:
            self.failed[status.stamp_ns] = status

    def frames(self) -> list[DriveFrame]:
        """Return what became of the frames that were sent, in order."""
        frames = []
        for stamp_ns, index in sorted(self.frame_index.items()):
            values = self.answers[stamp_ns].values if stamp_ns in self.answers else {}
            tracked, submap, repeated, blind = (
                values.get(name) == '1' for name in ('tracked', 'submap', 'repeated', 'blind')
            )
            shows_motion = int(values.get('moving', 0)) > 0
            frames.append(
                DriveFrame(stamp_ns, index, tracked, submap, repeated, blind, shows_motion)
            )
        return frames

    def count(self, node: str, what: str) -> int:
        """Return how much a node says to have `processed` or `skipped`: it knows best, also where
        this process was too slow to hear it all.
        """
        return int(self.health[node].values[what]) if node in self.health else 0

    @property
    def failed_frames(self) -> int:
        """At how many frames SLAM failed, which is more than not to track them."""
        errors = (s for s in self.answers.values() if s.level is Level.ERROR)
        return sum('tracked' not in status.values for status in errors)

    def flagged(self, name: str) -> set[int]:
        """Return the stamps of the frames of which SLAM says that they are `tracked`, or of a
        `keyframe`.
        """
        return {stamp_ns for stamp_ns, s in self.answers.items() if s.values.get(name) == '1'}

    @property
    def loop_times_s(self) -> list[float]:
        """When SLAM has closed loops, in seconds."""
        times: list[float] = []
        for stamp_ns, status in sorted(self.answers.items()):
            new = int(status.values.get('loops', 0)) - len(times)
            times += [round(1e-9 * stamp_ns, 6)] * new
        return times

    @property
    def remarks(self) -> list[str]:
        """What seems wrong with sensors and mount, in words."""
        return [words for node in NODES for words in self._remarks.get(node, [])]

    @property
    def input_faults(self) -> list[dict[str, Any]]:
        """What is wrong with the images, as in summary.json."""
        return list(json.loads(self._last_value('input_faults') or '[]'))

    def _last_value(self, name: str) -> str:
        """Return what SLAM's latest answer says, '' before the first one."""
        return self.answers[max(self.answers)].values.get(name, '') if self.answers else ''

    def unanswered(self) -> set[int]:
        """Return the stamps of frames that SLAM has not answered."""
        return self.frame_index.keys() - self.answers.keys()

    def unmapped(self) -> set[int]:
        """Return the stamps of keyframes that have not reached the map, nor failed on the way."""
        return self.flagged('keyframe') - self.updated - self.failed.keys()


class ReplayRecorder(Node):
    """Subscribes to the results of the chain.

    path_only: no node makes a map, and this one answers the keyframes in their place.
    """

    def __init__(
        self,
        context: Context,
        measure_mb: Callable[[], float] = lambda: 0.0,
        on_mask: MaskListener | None = None,
        path_only: bool = False,
    ) -> None:
        super().__init__('replay_recorder', context=context)
        self.notes = DriveNotes(measure_mb)
        self.recorded: Sequence[str] = (*OF_PATH, POINTS, KEYFRAME) if path_only else OF_MAP
        self.latest: dict[str, Any] = {}
        self.arrived_s: dict[str, dict[int, float]] = defaultdict(dict)
        """When the first message of a topic and stamp came."""
        self._path_only = path_only
        self._poses: dict[str, dict[int, Array]] = {name: {} for name in POSES}
        self._on_mask = on_mask
        self._masks: dict[int, NDArray[np.uint8]] = {}
        for name in self.recorded:
            topic = TOPICS[name]
            self.create_subscription(topic.type, name, partial(self._take, name), topic.profile)
        done = TOPICS[KEYFRAME_DONE]
        self._done = self.create_publisher(done.type, done.name, done.profile)
        self.create_subscription(
            DIAGNOSTICS.type, DIAGNOSTICS.name, self._take_statuses, DIAGNOSTICS.profile
        )

    @property
    def tracked(self) -> list[TrackedPose]:
        """The tracked frames in order of their stamps."""
        T_odom_base, T_map_base = (self._poses[name] for name in POSES)
        return [
            TrackedPose(
                stamp_ns,
                T_odom_base[stamp_ns],
                int(self.notes.answers[stamp_ns].values['reference_keyframe_ns']),
                T_map_base.get(stamp_ns),
            )
            for stamp_ns in sorted(T_odom_base.keys() & self.notes.flagged('tracked'))
        ]

    @property
    def path(self) -> KeyframePath | None:
        """The keyframes as they are now, None before the first one."""
        message = self.latest.get('keyframe/path')
        return None if message is None else path_arrays(message)

    @property
    def mount(self) -> Mount | None:
        """Where the camera sits on the base, None while it is not known."""
        message = self.latest.get(MOUNT)
        return None if message is None else Mount.from_transform(transform_array(message))

    def is_drained(self) -> bool:
        """Whether the recording has ended and all that was sent has come to its end."""
        notes = self.notes
        if notes.finished is None or len(notes.frame_index) < int(notes.finished.values['frames']):
            return False
        return self.has_caught_up()

    def has_caught_up(self) -> bool:
        """Whether all that was sent so far has come to its end."""
        notes = self.notes
        if notes.unanswered() or self._masks or (notes.unmapped() and not self._path_only):
            return False
        path = self.latest.get('keyframe/path')
        path_ns = to_ns(path.poses[-1].header.stamp) if path is not None else 0
        has_poses = all(notes.flagged('tracked') <= self._poses[name].keys() for name in POSES)
        return has_poses and path_ns >= max(notes.flagged('keyframe'), default=0)

    def _take(self, name: str, message: Any) -> None:
        stamp_ns = to_ns(message.header.stamp)
        self.latest[name] = message
        self.arrived_s[name].setdefault(stamp_ns, time.monotonic())
        if name in POSES:
            self._poses[name].setdefault(stamp_ns, pose_array(message.pose.pose))
        elif name.endswith(CORRECTED):
            pose = pose_array(message.pose.pose)
            self._poses[name.removesuffix(CORRECTED)][stamp_ns] = pose
        elif name == MASK and self._on_mask is not None:
            self._masks[stamp_ns] = grey8_image(message, MASK)
            self._hand_on_masks()
        elif name == KEYFRAME:
            self._done.publish(message.header)

    def _take_statuses(self, message: DiagnosticArray) -> None:
        self.notes.take(message)
        self._hand_on_masks()

    def _hand_on_masks(self) -> None:
        """Masks are filed by frame number, which the camera's status tells."""
        for stamp_ns in sorted(self._masks.keys() & self.notes.frame_index.keys()):
            assert self._on_mask is not None
            self._on_mask(f'{self.notes.frame_index[stamp_ns]:06d}', self._masks.pop(stamp_ns))


class ViewNode(Node):
    """Shows what the nodes of a namespace publish."""

    def __init__(self, context: Context, view: View, namespace: str = '') -> None:
        super().__init__('segfloor_view', context=context, namespace=namespace)
        self._view = view
        self._K: Array | None = None
        self._T_base_left: Array | None = None
        shown: dict[str, Callable[[int, Any], None]] = {
            FRAME: lambda at, message: view.image(at, grey8_image(message, FRAME)),
            FRAME_INFO: self._take_info,
            MOUNT: self._take_mount,
            'pose': lambda at, message: view.pose(at, pose_array(message.pose.pose)),
            OVERLAY: lambda at, message: view.overlay(at, bgr_image(message, OVERLAY)),
            'keyframe/path': lambda at, message: view.path(at, path_arrays(message)),
            MOVING: lambda at, message: view.moving_points(
                at, moving_points_arrays(message, MOVING)
            ),
            LABELLED: lambda at, message: view.cloud(at, labelled_arrays(message, LABELLED)),
            'map': lambda at, message: view.grid(at, grid_of(message)),
        }
        for name, show in shown.items():
            topic, take = TOPICS[name], partial(self._take, name, show)
            self.create_subscription(topic.type, name, take, topic.profile)
        self.create_subscription(
            DIAGNOSTICS.type, DIAGNOSTICS.name, self._take_statuses, DIAGNOSTICS.profile
        )

    def _take(self, name: str, show: Callable[[int, Any], None], message: Any) -> None:
        self._view.paced(name, lambda: show(to_ns(message.header.stamp), message))

    def _take_info(self, stamp_ns: int, message: CameraInfo) -> None:
        is_new = self._K is None
        self._K = np.reshape(message.p, (3, 4))[:, :3]
        self._size = message.width, message.height
        if is_new:
            self._show_camera()

    def _take_mount(self, stamp_ns: int, message: TransformStamped) -> None:
        self._T_base_left = transform_array(message)
        self._show_camera()

    def _show_camera(self) -> None:
        if self._K is not None and self._T_base_left is not None:
            self._view.camera(self._K, self._size, self._T_base_left)

    def _take_statuses(self, message: DiagnosticArray) -> None:
        for status in diagnostics.statuses(message):
            if status.kind or not status.stamp_ns:
                continue
            if 'processing_ms' in status.values:
                duration_s = 1e-3 * float(status.values['processing_ms'])
                self._view.duration(status.stamp_ns, status.node, duration_s)
            if status.node == SLAM:
                self._view.state(status.stamp_ns, status.message)
                self._view.loops(status.stamp_ns, int(status.values.get('loops', 0)))


def watch(view: View, namespace: str) -> None:
    """Show the live graph until an interrupt."""
    context = Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(ViewNode(context, view, namespace))
    try:
        with contextlib.suppress(KeyboardInterrupt):
            while True:
                executor.spin_once(timeout_sec=SPIN_S)
    finally:
        rclpy.try_shutdown(context=context)
