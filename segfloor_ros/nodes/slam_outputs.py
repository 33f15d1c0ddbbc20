"""What the node `stereo_slam` publishes about a frame and about a keyframe, and for how long
tracking has been lost.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.calibration.parameters import StereoCalibration
from segfloor_ros.camera.depth import shrink_factor, shrunk_camera, shrunk_image
from segfloor_ros.camera.model import Mount
from segfloor_ros.configuration import StereoSlamNodeSettings
from segfloor_ros.messages import maps as clouds
from segfloor_ros.messages import poses
from segfloor_ros.messages.images import camera_info_message, image_message, rectified_calibration
from segfloor_ros.messages.maps import map_start_message
from segfloor_ros.messages.topics import MAP_START, MOVING_MASK
from segfloor_ros.nodes.shared.stage_node import AnyStageNode
from segfloor_ros.slam.results import FrameResult, Keyframe

SIDES = ('left', 'right')

LEAST_VARIANCE = 1e-6
"""Of a millimetre and a milliradian, in m² and rad²: the first pose is the origin by definition."""

Pair = tuple[NDArray[np.uint8], NDArray[Any]]


class LostTime:
    """Measures by the stamps of the frames."""

    def __init__(self, node: AnyStageNode) -> None:
        self._node = node
        self._since_ns: int | None = None

    def lost_s(self, stamp_ns: int) -> float:
        """Return for how long tracking has been lost, in s."""
        return 0.0 if self._since_ns is None else 1e-9 * (stamp_ns - self._since_ns)

    def note(self, stamp_ns: int, tracked: bool) -> dict[str, str]:
        """Note a frame; returns values for its status: for how long tracking has been lost, or,
        where it was found again, after how long.
        """
        if not tracked:
            self._since_ns = stamp_ns if self._since_ns is None else self._since_ns
            return {'lost_s': f'{self.lost_s(stamp_ns):.2f}'}
        lost_s, was_lost = self.lost_s(stamp_ns), self._since_ns is not None
        self._since_ns = None
        if not was_lost:
            return {}
        self._node.get_logger().info(f'tracking again, after {lost_s:.2f} s')
        return {'recovered_after_s': f'{lost_s:.2f}'}


@dataclass(frozen=True)
class CameraFrames:
    """Names of the optical frames of both cameras."""

    left: str
    right: str


class SlamOutputs:
    """The publishers of stereo SLAM."""

    def __init__(self, node: AnyStageNode, own: StereoSlamNodeSettings) -> None:
        self._own = own
        self._odometry = node.output('odometry')
        self._map_pose = node.output('pose')
        self._mount = node.output('camera_mount')
        self._pose = node.output('keyframe/odometry')
        self._images = {s: node.output(f'keyframe/{s}/image_rect') for s in SIDES}
        self._infos = {s: node.output(f'keyframe/{s}/camera_info') for s in SIDES}
        self._frame_images = {s: node.output(f'frame/{s}/image_rect') for s in SIDES}
        self._frame_infos = {s: node.output(f'frame/{s}/camera_info') for s in SIDES}
        self._features = node.output('keyframe/features')
        self._path = node.output('keyframe/path')
        self._map_points = node.output('map_points')
        self._moving_points = node.output('moving_points')
        self._moving_mask = node.output(MOVING_MASK)
        self._map_start = node.output(MAP_START)
        self.map_start_ns = 0
        """When the map was begun, by which the nodes behind know one map from another."""
        self._is_loaded = False

    def reset(self, map_start_ns: int, is_loaded: bool = False) -> None:
        """Publish about another map from now on; velocities are not known across a reset."""
        # The time of a recording that is played again may be the same twice.
        self.map_start_ns = map_start_ns + (map_start_ns == self.map_start_ns)
        self._is_loaded = is_loaded
        self._last: FrameResult | None = None
        self._path_messages = poses.PathMessages(self._own.map_frame)

    def publish_mount(self, frames: CameraFrames, mount: Mount) -> None:
        """Publish where the left camera sits on the base; the stamp tells for which map."""
        base, T_base_left = self._own.base_frame, mount.T_base_left
        self._mount.publish(
            poses.transform_message(self.map_start_ns, base, frames.left, T_base_left)
        )

    def publish(
        self, result: FrameResult, calibration: StereoCalibration, frames: CameraFrames
    ) -> None:
        """Publish a frame's pose and, of a keyframe, everything; a frame without pose is silence.

        calibration: of the rectified images.
        """
        if result.tracked:
            self._publish_odometry(result)
        if result.moving is not None:
            frame_id = self._own.map_frame
            message = clouds.moving_points_message(result.stamp_ns, frame_id, result.moving)
            self._moving_points.publish(message)
        if result.keyframe is not None:
            self._publish_keyframe(result, result.keyframe, calibration, frames)
        self._last = result

    def publish_frame(
        self, stamp_ns: int, pair: Pair, calibration: StereoCalibration, frames: CameraFrames
    ) -> None:
        """Publish the rectified images (H, W) of a tracked frame, shrunk, while someone listens."""
        if not any(output.get_subscription_count() for output in self._frame_images.values()):
            return
        factor = shrink_factor(calibration.camera)
        small = rectified_calibration(shrunk_camera(calibration.camera, factor))
        for side, image, eye in zip(SIDES, pair, (small.left, small.right), strict=True):
            frame_id = getattr(frames, side)
            self._frame_infos[side].publish(camera_info_message(stamp_ns, frame_id, eye))
            message = image_message(stamp_ns, frame_id, shrunk_image(image, factor))
            self._frame_images[side].publish(message)

    def _publish_odometry(self, result: FrameResult) -> None:
        last, twist, of_twist = self._last, None, None
        covariance = poses.at_least(result.covariance, LEAST_VARIANCE)
        if last is not None and last.tracked and result.stamp_ns > last.stamp_ns:
            duration_s = (result.stamp_ns - last.stamp_ns) * 1e-9
            twist = poses.body_twist(last.T_odom_base, result.T_odom_base, duration_s)
            before = poses.at_least(last.covariance, LEAST_VARIANCE)
            of_twist = poses.twist_covariance(before, result.T_odom_base, covariance, duration_s)
        own = self._own
        if self._map_pose.get_subscription_count():
            T_map_base = result.T_map_odom @ result.T_odom_base
            self._map_pose.publish(
                poses.pose_with_covariance_message(
                    result.stamp_ns, own.map_frame, T_map_base, covariance
                )
            )
        self._odometry.publish(
            poses.odometry_message(
                result.stamp_ns,
                own.odom_frame,
                own.base_frame,
                result.T_odom_base,
                covariance,
                twist,
                of_twist,
            )
        )

    def _publish_keyframe(
        self,
        result: FrameResult,
        keyframe: Keyframe,
        calibration: StereoCalibration,
        frames: CameraFrames,
    ) -> None:
        stamp_ns, own = keyframe.stamp_ns, self._own
        eyes = {
            'left': (frames.left, keyframe.left, calibration.left),
            'right': (frames.right, keyframe.right, calibration.right),
        }
        for side, (frame_id, image, eye) in eyes.items():
            self._infos[side].publish(camera_info_message(stamp_ns, frame_id, eye))
            self._images[side].publish(image_message(stamp_ns, frame_id, image))
        self._moving_mask.publish(image_message(stamp_ns, frames.left, _mask(keyframe)))
        self._pose.publish(
            poses.odometry_message(
                stamp_ns,
                own.map_frame,
                own.base_frame,
                keyframe.T_map_base,
                poses.at_least(result.covariance, LEAST_VARIANCE),
            )
        )
        features = clouds.features_message(stamp_ns, own.map_frame, keyframe.features)
        self._features.publish(features)
        self._path.publish(self._path_messages.next(stamp_ns, keyframe.path))
        self._map_start.publish(
            map_start_message(stamp_ns, own.map_frame, self.map_start_ns, self._is_loaded)
        )
        self._map_points.publish(
            clouds.sparse_cloud_message(stamp_ns, own.map_frame, keyframe.cloud)
        )


def _mask(keyframe: Keyframe) -> NDArray[np.uint8]:
    """Return what moves in a keyframe, (H, W), also where it is nothing."""
    return np.zeros_like(keyframe.left) if keyframe.moving is None else keyframe.moving
