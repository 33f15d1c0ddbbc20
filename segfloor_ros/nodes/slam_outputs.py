"""What the node `stereo_slam` gives: topics about frames and keyframes, and reports."""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.calibration import StereoCalibration
from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.camera.pixels import Region
from segfloor_ros.core.camera.shrinking import shrunk_image
from segfloor_ros.core.contracts import FrameResult, Keyframe, Mount, StereoFrame
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.slam.drift import DriftMeter
from segfloor_ros.core.slam.stereo_slam import StereoSlam
from segfloor_ros.nodes.messages import odometry, points, poses
from segfloor_ros.nodes.messages.camera_infos import camera_info_message, rectified_calibration
from segfloor_ros.nodes.messages.diagnostics import REMARKS_APART, Level
from segfloor_ros.nodes.messages.images import image_message
from segfloor_ros.nodes.messages.saved_maps import map_start_message
from segfloor_ros.nodes.messages.topics import (
    CORRECTED,
    FRAME_PARTS,
    FRESH_S,
    KEYFRAME_PARTS,
    MAP_START,
    MOVING_MASK,
    SIDES,
)
from segfloor_ros.nodes.settings.slam import StereoSlamNodeSettings
from segfloor_ros.nodes.shared.stage_node import AnyStageNode
from segfloor_ros.nodes.shared.transforms import Transforms
from segfloor_ros.nodes.slam_camera import Watch

MAPPING_SUBMAP = 'lost; maps a submap until it recognises a place of the map'

AT_A_TIME = 2
"""Results that are published together: more than a frame brings."""

FRAME_NS = 80_000_000
"""Between small images: every third of a camera with 30 Hz, each of one with 10."""


@dataclass(frozen=True)
class CameraFrames:
    """Names of the optical frames of both cameras."""

    left: str
    right: str


class SlamTopics:
    """The publishers of stereo SLAM, of the camera that it has begun with."""

    def __init__(self, node: AnyStageNode) -> None:
        self._own: StereoSlamNodeSettings = node.settings
        self._out = node.outputs
        self._frame_ns = -math.inf
        self.map_start_ns = 0
        """When the map was begun, by which the nodes behind know one map from another."""

    def reset(self, map_start_ns: int) -> None:
        """Publish about another map from now on; velocities are not known across a reset."""
        # The time of a recording that is played again may be the same twice.
        self.begin_map(map_start_ns + (map_start_ns == self.map_start_ns))
        self.newest_ns = -1
        """Stamp of the newest pose."""
        self.frames = CameraFrames('', '')

    def begin_map(self, map_start_ns: int) -> None:
        """Have the nodes behind map anew from now on."""
        self.map_start_ns = map_start_ns
        self._last: FrameResult | None = None
        self._announced_ns: int | None = None
        self._path_messages = poses.PathMessages(self._own.map_frame)

    def begin(self, calibration: StereoCalibration, frames: CameraFrames) -> None:
        """Publish about this camera from now on. calibration: of the rectified images."""
        self._calibration, self.frames = calibration, frames
        self._drift = DriftMeter(calibration.camera)

    def publish_mount(self, mount: Mount) -> None:
        """Publish where the left camera sits on the base; the stamp tells for which map."""
        base, left = self._own.base_frame, self.frames.left
        message = poses.transform_message(self.map_start_ns, base, left, mount.T_base_left)
        self._out.publish('camera_mount', message)
        self._drift.T_base_left = mount.T_base_left

    def publish(self, result: FrameResult) -> None:
        """Publish a frame's pose, none while there is none, and everything of a keyframe."""
        self._drift.see(result, result.keyframe)
        if result.tracked and result.stamp_ns != self._announced_ns:
            self._publish_pose(result)
        if result.moving is not None:
            at = result.stamp_ns, self._own.map_frame
            self._out.publish('moving_points', points.moving_points_message(*at, result.moving))
        if result.keyframe is not None:
            self._publish_keyframe(result, result.keyframe)
        self._last = result

    def announce(self, result: FrameResult, frame: StereoFrame, moving: Region | None) -> None:
        """Publish pose and images of a keyframe that the map has still to take in. moving: a mask
        (H, W).
        """
        self._drift.see(result, None)
        self._publish_pose(result)
        T_map_base = result.T_map_odom @ result.T_odom_base
        self._publish_view(result, frame.left, frame.right, moving, T_map_base)
        self._announced_ns = result.stamp_ns

    def _publish_pose(self, result: FrameResult) -> None:
        self._publish_odometry(result, '' if result.stamp_ns > self.newest_ns else CORRECTED)
        self.newest_ns = max(result.stamp_ns, self.newest_ns)

    def publish_frame(self, frame: StereoFrame, is_idle: bool) -> None:
        """Publish the rectified images of a tracked frame, shrunk, while someone listens: about ten
        times a second where tracking leaves time for that, else as often as a robot needs them.
        """
        since_ns = frame.stamp_ns - self._frame_ns
        is_due = since_ns >= (FRAME_NS if is_idle else 1e9 * FRESH_S) or since_ns < 0
        if not is_due or not any(self._out.listeners(name) for name in FRAME_PARTS[::2]):
            return
        self._frame_ns = frame.stamp_ns
        camera = self._calibration.camera
        factor = shrink_factor(camera)
        small = rectified_calibration(shrunk_camera(camera, factor))
        images = (shrunk_image(image, factor) for image in (frame.left, frame.right))
        self._publish_pair(FRAME_PARTS, frame.stamp_ns, images, small)

    def _publish_pair(
        self,
        topics: Sequence[str],
        stamp_ns: int,
        images: Iterable[NDArray[Any]],
        calibration: StereoCalibration,
    ) -> None:
        """Publish a left and a right image with their calibrations. topics: of the left ones, then
        of the right ones.
        """
        names, infos = topics[::2], topics[1::2]
        for side, name, info, image in zip(SIDES, names, infos, images, strict=True):
            at = stamp_ns, getattr(self.frames, side)
            self._out.publish(info, camera_info_message(*at, getattr(calibration, side)))
            self._out.publish(name, image_message(*at, image))

    def _publish_odometry(self, result: FrameResult, suffix: str) -> None:
        last, twist, of_twist = self._last, None, None
        if last is not None and last.tracked and result.stamp_ns > last.stamp_ns:
            duration_s = (result.stamp_ns - last.stamp_ns) * 1e-9
            twist = odometry.body_twist(last.T_odom_base, result.T_odom_base, duration_s)
            before, now = (odometry.never_certain(one.covariance) for one in (last, result))
            of_twist = odometry.twist_covariance(before, result.T_odom_base, now, duration_s)
        own = self._own
        if self._out.listeners('pose' + suffix):
            T_map_base = result.T_map_odom @ result.T_odom_base
            at = result.stamp_ns, own.map_frame
            in_map = odometry.never_certain(result.covariance_in_map)
            message = odometry.pose_with_covariance_message(*at, T_map_base, in_map)
            self._out.publish('pose' + suffix, message)
        at, T = (result.stamp_ns, own.odom_frame), result.T_odom_base
        in_odom = odometry.never_certain(self._drift.covariance(result))
        message = odometry.odometry_message(*at, own.base_frame, T, in_odom, twist, of_twist)
        self._out.publish('odometry' + suffix, message)

    def _publish_keyframe(self, result: FrameResult, keyframe: Keyframe) -> None:
        if keyframe.stamp_ns != self._announced_ns:
            T_map_base, moving = keyframe.T_map_base, keyframe.moving
            self._publish_view(result, keyframe.left, keyframe.right, moving, T_map_base)
        out, at = self._out, (keyframe.stamp_ns, self._own.map_frame)
        out.publish('keyframe/features', points.features_message(*at, keyframe.features))
        out.publish('keyframe/path', self._path_messages.next(keyframe.stamp_ns, keyframe.path))
        out.publish('map_points', points.sparse_cloud_message(*at, keyframe.cloud))

    def _publish_view(
        self,
        result: FrameResult,
        left: NDArray[np.uint8],
        right: NDArray[Any],
        moving: Region | None,
        T_map_base: Array,
    ) -> None:
        """Publish what the floor of a keyframe is found by: images (H, W) and a mask of them, the
        base's pose (4, 4), and which map it belongs to.
        """
        own, out, stamp_ns = self._own, self._out, result.stamp_ns
        at = stamp_ns, own.map_frame
        self._publish_pair(KEYFRAME_PARTS, stamp_ns, (left, right), self._calibration)
        moving = np.zeros_like(left) if moving is None else moving
        out.publish(MOVING_MASK, image_message(stamp_ns, self.frames.left, moving))
        covariance = odometry.never_certain(result.covariance_in_map)
        pose = odometry.odometry_message(*at, own.base_frame, T_map_base, covariance)
        out.publish('keyframe/odometry', pose)
        out.publish(MAP_START, map_start_message(*at, self.map_start_ns))


class SlamResults:
    """Publishes what SLAM has found out about frames, and reports how it went: few at a time, since
    others need time to take each, but more than come, so that none waits behind those held back.
    """

    def __init__(self, node: AnyStageNode, transforms: Transforms, watch: Watch) -> None:
        self.topics = SlamTopics(node)
        self._node = node
        self._transforms = transforms
        self._watch = watch
        self._unsent: deque[tuple[FrameResult, StereoSlam, float]] = deque()
        self._send_more = node.inputs.later(self._send_some)

    def reset(self, map_start_ns: int) -> None:
        """Publish about another map from now on, of a camera whose mount is not known."""
        self.topics.reset(map_start_ns)
        self._unsent.clear()
        self._lost_since_ns: int | None = None
        self._in_map_since_ns: int | None = None
        self.mount: Mount | None = None

    def add(self, results: Sequence[FrameResult], slam: StereoSlam, milliseconds: float) -> None:
        """Have results published, at once where there is one. Where the mount has changed all of
        them come once more, for a map that is begun anew. milliseconds: that all took.
        """
        if results and self.mount not in (None, slam.mount):
            self._unsent.clear()
            self.mount = None
            self.topics.begin_map(self.topics.map_start_ns + 1)
        self._unsent.extend((result, slam, milliseconds / len(results)) for result in results)
        self._send_some()

    def announce(self, result: FrameResult, frame: StereoFrame, moving: Region | None) -> None:
        """Publish pose and images of a keyframe at once, while the map takes it in; its floor is
        found meanwhile. moving: a mask (H, W).
        """
        if self.mount is not None and not self._unsent:
            self._transforms.broadcast(result)
            self.topics.announce(result, frame, moving)

    def report_held(self, stamp_ns: int, slam: StereoSlam) -> None:
        """Report why no result is ready. While the mount is being measured, and by a drive that was
        broken off, the newest pose is published: it comes corrected once, when keyframes come.
        """
        result, reporter = slam.session.provisional, self._node.reporter
        if result is not None:
            self._send(result)
        if slam.session.state.holds_results:
            lost = self._lost_time(stamp_ns, tracked=False)
            reporter.report(stamp_ns, Level.ERROR, MAPPING_SUBMAP, tracked=0, submap=1, **lost)
            return
        words = 'pose with a provisional mount: the floor is not seen well enough to measure it yet'
        reporter.health.waits(words)
        reporter.report(stamp_ns, Level.WARN, words, input_faults=_faults_json(slam))

    def _send_some(self) -> None:
        """Publish the oldest results that are not yet, and have the rest follow."""
        for _ in range(min(AT_A_TIME, len(self._unsent))):
            self._publish(*self._unsent.popleft())
        if self._unsent:
            self._send_more()

    def _publish(self, result: FrameResult, slam: StereoSlam, milliseconds: float) -> None:
        if self.mount is None and result.tracked and slam.mount is not None:
            self._announce_mount(result.stamp_ns, slam.mount)
        self._send(result)
        level = Level.WARN if result.blind else Level.OK if result.tracked else Level.ERROR
        self._node.reporter.report_processed(
            result.stamp_ns,
            level,
            result.state,
            milliseconds,
            tracked=int(result.tracked),
            loops=slam.back_end.loop_count,
            keyframe=int(result.keyframe is not None),
            matches=result.num_matches,
            reference_keyframe_ns=result.reference_keyframe_ns,
            **self._lost_time(result.stamp_ns, result.tracked),
            **self._place_in_map(result),
            moving=len(result.moving.xyz_map) if result.moving is not None else 0,
            blind=int(result.blind),
            submap=int(result.in_submap),
            repeated=int(result.repeated and result.tracked),
            input_faults=_faults_json(slam),
            remarks=REMARKS_APART.join(slam.sensors.remarks.values()),
        )

    def _send(self, result: FrameResult) -> None:
        # What a robot steers by comes first, the images of a keyframe later.
        if result.stamp_ns > self.topics.newest_ns:
            self._transforms.broadcast(result)
        self.topics.publish(result)

    def _lost_time(self, stamp_ns: int, tracked: bool) -> dict[str, str]:
        """Return values for the status of a frame: for how long tracking has been lost, or, where
        it was found again, after how long.
        """
        since_ns = self._lost_since_ns
        lost_s = 0.0 if since_ns is None else 1e-9 * (stamp_ns - since_ns)
        if not tracked:
            self._lost_since_ns = stamp_ns if since_ns is None else since_ns
            return {'lost_s': f'{lost_s:.2f}'}
        self._lost_since_ns = None
        if since_ns is None:
            return {}
        self._node.get_logger().info(f'tracking again, after {lost_s:.2f} s')
        return {'recovered_after_s': f'{lost_s:.2f}'}

    def _place_in_map(self, result: FrameResult) -> dict[str, str]:
        """Return values for the status of a frame: how well its place in the map is known, one
        sigma, and for how long it has been known.
        """
        if not result.tracked or result.outside:
            self._in_map_since_ns = None
            return {}
        # Frames before it was certain come later.
        since_ns = min(self._in_map_since_ns or result.stamp_ns, result.stamp_ns)
        self._in_map_since_ns = since_ns
        sigmas = np.sqrt(np.diag(odometry.never_certain(result.covariance_in_map)))
        return {
            'in_map_s': f'{1e-9 * (result.stamp_ns - since_ns):.2f}',
            'place_sigma_m': f'{sigmas[:3].max():.4f}',
            'place_sigma_rad': f'{sigmas[3:].max():.5f}',
        }

    def _announce_mount(self, stamp_ns: int, mount: Mount) -> None:
        self.mount = mount
        self._node.get_logger().info(
            f'camera {mount.height_m:.3f} m above the floor, pitch '
            f'{math.degrees(mount.pitch_rad):.2f} deg, roll {math.degrees(mount.roll_rad):.2f} deg'
        )
        left = self.topics.frames.left
        if not self._node.settings.gives_mount and self._transforms.mount(left) is None:
            self._watch.judge_measured(mount)
        self.topics.publish_mount(mount)
        self._transforms.announce_mount(stamp_ns, left, mount)


def _faults_json(slam: StereoSlam) -> str:
    return json.dumps(slam.rig_check.as_dicts())


def shrink_factor(camera: StereoCamera, width_px: int = 240) -> int:
    """Return by how much images of a camera are shrunk to about a width, at least 1."""
    return max(1, round(camera.width / width_px))


def shrunk_camera(camera: StereoCamera, factor: int) -> StereoCamera:
    """Return the camera of shrunk images. Pixel centres are at whole numbers, so the principal
    point moves by half a pixel less than the size.
    """
    return StereoCamera(
        camera.width // factor,
        camera.height // factor,
        camera.fx / factor,
        camera.fy / factor,
        (camera.cx + 0.5) / factor - 0.5,
        (camera.cy + 0.5) / factor - 0.5,
        camera.baseline_m,
    )
