"""What the node `stereo_slam` publishes about a frame and about a keyframe."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from segfloor_ros.camera.calibration import StereoCalibration
from segfloor_ros.camera.model import Mount
from segfloor_ros.messages.camera_info import camera_info_message
from segfloor_ros.messages.clouds import features_message, sparse_cloud_message
from segfloor_ros.messages.images import image_message
from segfloor_ros.messages.path_bytes import path_bytes
from segfloor_ros.messages.poses import (
    at_least,
    body_twist,
    odometry_message,
    transform_message,
    twist_covariance,
)
from segfloor_ros.node_settings import StereoSlamNodeSettings
from segfloor_ros.nodes.stage_node import StageNode
from segfloor_ros.slam.results import FrameResult, Keyframe

LEAST_VARIANCE = 1e-6
"""Of a millimetre and a milliradian, in m² and rad²: the first pose is the origin by definition."""


@dataclass(frozen=True)
class CameraFrames:
    """Names of the optical frames of both cameras."""

    left: str
    right: str


class SlamOutputs:
    """The publishers of stereo SLAM."""

    def __init__(self, node: StageNode[Any, Any], own: StereoSlamNodeSettings) -> None:
        self._own = own
        self._odometry = node.output('odometry')
        self._mount = node.output('camera_mount')
        self._pose = node.output('keyframe/odometry')
        self._images = {s: node.output(f'keyframe/{s}/image_rect') for s in ('left', 'right')}
        self._infos = {s: node.output(f'keyframe/{s}/camera_info') for s in ('left', 'right')}
        self._features = node.output('keyframe/features')
        self._path = node.output('keyframe/path')
        self._map_points = node.output('map_points')
        self._last: FrameResult | None = None

    def start_anew(self) -> None:
        """Forget the frame before; velocities are not known across a reset."""
        self._last = None

    def publish_mount(self, stamp_ns: int, frames: CameraFrames, mount: Mount) -> None:
        """Publish where the left camera sits on the base."""
        base = self._own.base_frame
        self._mount.publish(transform_message(stamp_ns, base, frames.left, mount.T_base_left))

    def publish(
        self, result: FrameResult, calibration: StereoCalibration, frames: CameraFrames
    ) -> None:
        """Publish a frame's pose and, of a keyframe, everything; a frame without pose is silence.

        calibration: of the rectified images.
        """
        if result.tracked:
            self._publish_odometry(result)
        if result.keyframe is not None:
            self._publish_keyframe(result, result.keyframe, calibration, frames)
        self._last = result

    def _publish_odometry(self, result: FrameResult) -> None:
        last, twist, of_twist = self._last, None, None
        covariance = at_least(result.covariance, LEAST_VARIANCE)
        if last is not None and last.tracked and result.stamp_ns > last.stamp_ns:
            duration_s = (result.stamp_ns - last.stamp_ns) * 1e-9
            twist = body_twist(last.T_odom_base, result.T_odom_base, duration_s)
            before = at_least(last.covariance, LEAST_VARIANCE)
            of_twist = twist_covariance(before, result.T_odom_base, covariance, duration_s)
        own = self._own
        self._odometry.publish(
            odometry_message(
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
        self._pose.publish(
            odometry_message(
                stamp_ns,
                own.map_frame,
                own.base_frame,
                keyframe.T_map_base,
                at_least(result.covariance, LEAST_VARIANCE),
            )
        )
        features = features_message(stamp_ns, own.map_frame, keyframe.features)
        self._features.publish(features)
        self._path.publish(path_bytes(stamp_ns, own.map_frame, keyframe.path))
        self._map_points.publish(sparse_cloud_message(stamp_ns, own.map_frame, keyframe.cloud))
