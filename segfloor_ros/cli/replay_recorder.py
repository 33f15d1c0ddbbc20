"""The listener of a replay: collects what the nodes publish and knows when all is done."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import OccupancyGrid as OccupancyGridMessage
from nav_msgs.msg import Odometry, Path
from numpy.typing import NDArray
from rclpy.context import Context
from rclpy.node import Node
from sensor_msgs.msg import Image, PointCloud2

from segfloor_ros.camera.model import Mount
from segfloor_ros.cloud.labelled_cloud import LabelledPoints
from segfloor_ros.geometry import Array
from segfloor_ros.messages import diagnostics
from segfloor_ros.messages.images import grey8_image
from segfloor_ros.messages.maps import labelled_arrays
from segfloor_ros.messages.poses import path_arrays, pose_array, transform_array
from segfloor_ros.messages.topics import (
    CAMERA,
    CLOUD,
    DIAGNOSTICS,
    FLOOR,
    GRID,
    SLAM,
    TOPICS,
    to_ns,
)
from segfloor_ros.slam.results import KeyframePath
from segfloor_ros.timing import MemoryLog, StageTimes
from segfloor_ros.trajectory import TrackedPose

MaskListener = Callable[[str, NDArray[np.uint8]], None]
"""Gets the number of a frame, as in the names of masks, and its floor mask."""


class ReplayRecorder(Node):
    """Subscribes to the results of the chain; everything is filed under its stamp."""

    def __init__(
        self, context: Context, measure_mb: Callable[[], float], on_mask: MaskListener | None
    ) -> None:
        super().__init__('replay_recorder', context=context)
        self.times = StageTimes()
        self.memory = MemoryLog(measure_mb)
        self.connections: dict[str, dict[str, int]] = {}
        self.frame_index: dict[int, int] = {}
        self.answers: dict[int, diagnostics.Status] = {}
        self.finished: diagnostics.Status | None = None
        self.updated: set[int] = set()
        self.failed: dict[int, diagnostics.Status] = {}
        self.path: KeyframePath | None = None
        self.labelled: LabelledPoints | None = None
        self.mount: Mount | None = None
        self.last_sign_s = time.monotonic()
        self.grid: OccupancyGridMessage | None = None
        self._T_odom_base: dict[int, Array] = {}
        self._T_map_base: dict[int, Array] = {}
        self._on_mask = on_mask
        self._masks: dict[int, NDArray[np.uint8]] = {}
        self._subscribe()

    @property
    def tracked(self) -> list[TrackedPose]:
        """The tracked frames in order of their stamps."""
        return [
            TrackedPose(
                stamp_ns,
                self._T_odom_base[stamp_ns],
                int(self.answers[stamp_ns].values['reference_keyframe_ns']),
                self._T_map_base.get(stamp_ns),
            )
            for stamp_ns in sorted(self._T_odom_base.keys() & self._told)
        ]

    @property
    def _told(self) -> set[int]:
        """Stamps of the frames that SLAM says it has tracked."""
        return {stamp_ns for stamp_ns, s in self.answers.items() if s.values.get('tracked') == '1'}

    @property
    def keyframes(self) -> set[int]:
        """Stamps of the keyframes that SLAM has published."""
        return {stamp_ns for stamp_ns, s in self.answers.items() if s.values.get('keyframe') == '1'}

    @property
    def loops(self) -> int:
        """How many loops SLAM has closed."""
        return int(self._last_value('loops') or 0)

    @property
    def remarks(self) -> list[str]:
        """What seems wrong with sensors, in words."""
        text = self._last_value('remarks')
        return text.split(diagnostics.REMARKS_APART) if text else []

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
        return self.keyframes - self.updated - self.failed.keys()

    def is_drained(self) -> bool:
        """Whether the recording has ended and all that was sent has come to its end."""
        if self.finished is None or len(self.frame_index) < int(self.finished.values['frames']):
            return False
        return self.has_caught_up()

    def has_caught_up(self) -> bool:
        """Whether all that was sent so far has come to its end."""
        if self.unanswered() or self.unmapped() or self._masks:
            return False
        newest = max(self.keyframes, default=0)
        path_ns = int(self.path.stamp_ns[-1]) if self.path is not None else 0
        has_poses = self._told <= self._T_odom_base.keys() & self._T_map_base.keys()
        return has_poses and path_ns >= newest

    def _subscribe(self) -> None:
        self.recorded: dict[str, Callable[[Any], None]] = {
            'odometry': self._take_odometry,
            'pose': self._take_pose,
            'camera_mount': self._take_mount,
            'keyframe/path': self._take_path,
            'keyframe/floor_mask': self._take_mask,
            'labelled_points': self._take_labelled,
            'map': self._take_map,
        }
        for name, callback in self.recorded.items():
            self.create_subscription(TOPICS[name].type, name, callback, TOPICS[name].profile)
        self.create_subscription(
            DIAGNOSTICS.type, DIAGNOSTICS.name, self._take_statuses, DIAGNOSTICS.profile
        )

    def _take_odometry(self, message: Odometry) -> None:
        self._T_odom_base[to_ns(message.header.stamp)] = pose_array(message.pose.pose)

    def _take_pose(self, message: PoseWithCovarianceStamped) -> None:
        self._T_map_base[to_ns(message.header.stamp)] = pose_array(message.pose.pose)

    def _take_map(self, message: OccupancyGridMessage) -> None:
        self.grid = message

    def _take_mount(self, message: TransformStamped) -> None:
        self.mount = Mount.from_transform(transform_array(message))

    def _take_path(self, message: Path) -> None:
        self.path = path_arrays(message)

    def _take_labelled(self, message: PointCloud2) -> None:
        self.labelled = labelled_arrays(message, 'labelled_points')

    def _take_mask(self, message: Image) -> None:
        if self._on_mask is not None:
            mask = grey8_image(message, 'keyframe/floor_mask')
            self._masks[to_ns(message.header.stamp)] = mask
            self._hand_on_masks()

    def _hand_on_masks(self) -> None:
        """Masks are filed by frame number, which the camera's status tells."""
        for stamp_ns in sorted(self._masks.keys() & self.frame_index.keys()):
            assert self._on_mask is not None
            self._on_mask(f'{self.frame_index[stamp_ns]:06d}', self._masks.pop(stamp_ns))

    def _take_statuses(self, message: DiagnosticArray) -> None:
        for status in diagnostics.statuses(message):
            if status.kind == diagnostics.CONNECTIONS:
                counts = {topic: int(count) for topic, count in status.values.items()}
                self.connections[status.node] = counts
            elif status.kind == diagnostics.RECORDING:
                self.finished = status
            elif not status.kind:
                self._take_status(status)

    def _take_status(self, status: diagnostics.Status) -> None:
        self.last_sign_s = time.monotonic()
        if 'processing_ms' in status.values:
            self.times.add(status.node, 1e-3 * float(status.values['processing_ms']))
        if status.node == CAMERA:
            self.frame_index[status.stamp_ns] = int(status.values['frame_index'])
            self._hand_on_masks()
        elif status.node == SLAM:
            self.answers[status.stamp_ns] = status
        elif status.node == GRID and status.level is diagnostics.Level.OK:
            self.updated.add(status.stamp_ns)
            self.memory.sample()
        elif status.node in (FLOOR, CLOUD, GRID) and status.level is diagnostics.Level.ERROR:
            self.failed[status.stamp_ns] = status
