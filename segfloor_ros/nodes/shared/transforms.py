"""The robot's frames over tf (REP-105): map → odom → base_link → camera."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

import numpy as np
from geometry_msgs.msg import TransformStamped

from segfloor_ros.core.contracts import FrameResult, Mount
from segfloor_ros.core.geometry import Array, invert
from segfloor_ros.nodes.messages.poses import transform_message
from segfloor_ros.nodes.messages.topics import FRESH_S, IMAGES, PATIENCE_S
from segfloor_ros.nodes.settings.slam import StereoSlamNodeSettings
from segfloor_ros.nodes.shared.inputs import LOOK_S
from segfloor_ros.nodes.shared.stage_node import AnyStageNode
from segfloor_ros.nodes.shared.tf_link import TfLink

DISCOVERY_S = 1.0
"""Who publishes tf is known so long after the start; where nobody does, tf is not waited for."""


class Transforms:
    """What SLAM broadcasts, and where tf has the camera's mount.

    With `publish_odom_tf` off another node owns odom → base_link, e.g. one that fuses the wheels'
    odometry. map → odom is then what is between that node's base and SLAM's, at the same time; it
    holds on until the next frame of the camera, up to the latest time that odometry has reached,
    so that whoever looks up map → base_link finds it as fresh as the odometry.
    """

    def __init__(
        self, node: AnyStageNode, on_heard: Callable[[TransformStamped], None] | None = None
    ) -> None:
        own: StereoSlamNodeSettings = node.settings
        self._node = node
        self._own = own
        self._link = TfLink(node, on_heard)
        self._publishers = 0
        self._tf = self._link.frames
        self._opened_s = self._deadline_s = self._listens_until_s = 0.0
        self._mounted: tuple[str, Array] | None = None
        self._unsent_mount: tuple[int, str, Mount] | None = None
        self._is_announced = False
        self._uncorrected: deque[FrameResult] = deque(maxlen=IMAGES.depth)
        self._T_map_odom: Array | None = None
        self._corrected_ns = 0
        self._is_fused = own.publish_tf and not own.publish_odom_tf
        if not self._link.is_there:
            node.get_logger().info(
                'no tf: tf2_msgs is not installed; the mount of the camera comes from the '
                'parameters camera_height_m, camera_pitch_rad and camera_roll_rad or is measured'
            )
        node.inputs.repeat(self._advance)

    def listener_count(self) -> int:
        """Return how many other nodes listen to tf."""
        return self._link.listener_count() if self._own.publish_tf else 0

    def start_waiting(self) -> None:
        """From now on tf has some time to tell the mount."""
        self._opened_s = time.monotonic()
        self._deadline_s = self._opened_s + self._own.tf_wait_s

    def reset(self) -> None:
        """Drop what is known of the map's place in odom."""
        self._uncorrected.clear()
        self._T_map_odom = None
        self._corrected_ns = 0
        self._tf.clear_moving()

    def mount_is_settled(self, camera_frame: str) -> bool:
        """Whether tf tells the mount of the left optical frame, or had time enough to."""
        is_told = self._mounted is not None or self.mount(camera_frame) is not None
        if is_told or not self._link.is_there:
            return True
        base, wait_s = self._own.base_frame, self._own.tf_wait_s
        if not self._is_published():
            wait_s = min(wait_s, DISCOVERY_S)
        if time.monotonic() < self._opened_s + wait_s:
            self._node.reporter.health.waits(f'waiting for tf from {base} to {camera_frame}')
            return False
        self._node.get_logger().info(
            f'no tf from {base} to {camera_frame} within {wait_s:g} s; the mount of the camera is '
            'measured from the floor'
        )
        return True

    def _is_published(self) -> bool:
        """Whether another node publishes tf."""
        me = self._node.get_namespace(), self._node.get_name()
        return any(
            (info.node_namespace, info.node_name) != me
            for topic in ('/tf_static', '/tf')
            for info in self._node.get_publishers_info_by_topic(topic)
        )

    def mount(self, camera_frame: str) -> Mount | None:
        """Return where tf has the left optical frame on the base, or None."""
        if self._mounted is not None:
            return None
        T_base_camera = self._tf.lookup(self._own.base_frame, camera_frame)
        return None if T_base_camera is None else Mount.from_transform(T_base_camera)

    def fused_base(self, stamp_ns: int) -> Array | None:
        """Return where another node that owns odom → base_link has the base (4, 4) at a time."""
        if not self._is_fused:
            return None
        return self._tf.lookup(self._own.odom_frame, self._own.base_frame, stamp_ns)

    def fused_until_ns(self) -> int | None:
        """Return up to when that is known, None where no other node owns it."""
        return self._tf.latest_ns(self._own.base_frame) if self._is_fused else None

    def between(self, target: str, source: str) -> Array | None:
        """Return T_target_source (4, 4) as tf has it now, or None."""
        if source == target:
            return np.eye(4)
        return self._tf.lookup(target, source)

    def announce_mount(self, stamp_ns: int, camera_frame: str, mount: Mount) -> None:
        """Broadcast the mount in use where tf lacks it, once tf had its time to tell."""
        self._unsent_mount = stamp_ns, camera_frame, mount
        self._is_announced = True

    def _advance(self) -> float:
        """Follow what tf tells; returns in how many seconds to look again."""
        publishers = self._node.count_publishers('/tf') + self._node.count_publishers('/tf_static')
        if publishers > self._publishers and self._own.publish_tf:  # which may be rivals
            self._link.listen()
            self._listens_until_s = time.monotonic() + PATIENCE_S
        self._publishers = publishers
        if self._unsent_mount is not None and time.monotonic() >= self._deadline_s:
            if self._own.publish_tf:
                self._broadcast_mount(*self._unsent_mount)
            self._unsent_mount = None
        # A fused odometry is listened to on and on.
        has_mount = self._is_announced and self._unsent_mount is None
        is_heard = time.monotonic() >= max(self._deadline_s, self._listens_until_s)
        if has_mount and not self._is_fused and is_heard:
            self._link.stop_listening()
        if self._is_fused:
            self._correct()
        return FRESH_S if has_mount and not self._is_fused else LOOK_S

    def _broadcast_mount(self, stamp_ns: int, camera_frame: str, mount: Mount) -> None:
        """Where the camera's frame hangs on another one already, e.g. on the camera's body, that
        one is put on the base: a frame has one parent.
        """
        base = self._own.base_frame
        if self._mounted is None:
            root = self._tf.root_of(camera_frame)
            T_root_camera = self._tf.lookup(root, camera_frame)
            if T_root_camera is None or self._tf.lookup(base, camera_frame) is not None:
                return
            self._mounted = root, T_root_camera
        root, T_root_camera = self._mounted
        T_base_root = mount.T_base_left @ invert(T_root_camera)
        self._link.send_fixed(transform_message(stamp_ns, base, root, T_base_root))

    def broadcast(self, result: FrameResult) -> None:
        """Broadcast the frames at one frame of the camera; while lost no pose is, and outside of a
        loaded map none in it.
        """
        if not self._link.is_there or not self._own.publish_tf:
            return
        if self._is_fused:
            if result.tracked and not result.outside:
                self._uncorrected.append(result)
            self._correct()
        elif result.tracked:
            own, stamp_ns = self._own, result.stamp_ns
            pairs = [(own.odom_frame, own.base_frame, result.T_odom_base)]
            if not result.outside:
                pairs.insert(0, (own.map_frame, own.odom_frame, result.T_map_odom))
            self._link.send(*(transform_message(stamp_ns, *pair) for pair in pairs))

    def _correct(self) -> None:
        """Broadcast the correction for the latest frame whose time tf has reached, and for what
        the other node's odometry has reached since.
        """
        self._correct_at_frame()
        latest_ns = self.fused_until_ns() or 0
        if self._T_map_odom is not None and latest_ns > self._corrected_ns:
            self._send_correction(latest_ns, self._T_map_odom)

    def _correct_at_frame(self) -> None:
        odom, base = self._own.odom_frame, self._own.base_frame
        for result in reversed(self._uncorrected):
            T_odom_base = self._tf.lookup(odom, base, result.stamp_ns)
            if T_odom_base is not None:
                T_map_base = result.T_map_odom @ result.T_odom_base
                self._T_map_odom = T_map_base @ invert(T_odom_base)
                self._send_correction(result.stamp_ns, self._T_map_odom)
                while self._uncorrected and self._uncorrected[0].stamp_ns <= result.stamp_ns:
                    self._uncorrected.popleft()
                return
        if len(self._uncorrected) == IMAGES.depth:
            self._node.reporter.diagnose(
                'no tf',
                f'no tf from {odom} to {base} at the times of the images, so none from '
                f'{self._own.map_frame} to {odom} is broadcast; publish_odom_tf is off, which '
                'leaves it to another node',
            )

    def _send_correction(self, stamp_ns: int, T_map_odom: Array) -> None:
        own = self._own
        message = transform_message(stamp_ns, own.map_frame, own.odom_frame, T_map_odom)
        self._link.send(message)
        self._corrected_ns = max(stamp_ns, self._corrected_ns)
