"""Node `floor_segmentation`: keyframe images in, disparity, floor mask and floor scan out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from geometry_msgs.msg import TransformStamped

from segfloor_ros.camera.calibration import StereoCalibration
from segfloor_ros.camera.model import Mount, StereoCamera
from segfloor_ros.floor.mount_check import MountCheck
from segfloor_ros.floor.pictures import mask_overlay, v_disparity_picture
from segfloor_ros.floor.segmentation import FloorSegmentation
from segfloor_ros.floor.settings import FloorSegmentationSettings
from segfloor_ros.messages.camera_info import eye_calibration
from segfloor_ros.messages.floor import disparity_message, scan_message
from segfloor_ros.messages.headers import to_ns
from segfloor_ros.messages.images import grey8_image, image_message, right_image
from segfloor_ros.messages.poses import pose_array, transform_array
from segfloor_ros.messages.topics import MOVING_MASK
from segfloor_ros.node_settings import FloorSegmentationNodeSettings
from segfloor_ros.nodes.free_scan import FreeScan
from segfloor_ros.nodes.keyframe_join import KeyframeJoin
from segfloor_ros.nodes.running import run_node
from segfloor_ros.nodes.stage_node import StageNode

LEFT, RIGHT = 'keyframe/left/image_rect', 'keyframe/right/image_rect'
LEFT_INFO, RIGHT_INFO = 'keyframe/left/camera_info', 'keyframe/right/camera_info'
POSE = 'keyframe/odometry'


class FloorSegmentationNode(StageNode[FloorSegmentationSettings, FloorSegmentationNodeSettings]):
    """Segments the floor of every keyframe."""

    works_on_demand = True

    def __init__(self) -> None:
        super().__init__(FloorSegmentationSettings, FloorSegmentationNodeSettings)

    def set_up(self) -> None:
        """Make the topics."""
        self._mount: Mount | None = None
        self._mount_stamp_ns = 0
        self._base_frame = ''
        self._disparity = self.output('keyframe/disparity')
        self._overlay = self.output('keyframe/floor_overlay')
        self._v_disparity = self.output('keyframe/v_disparity')
        self._mask = self.output('keyframe/floor_mask')
        self._scan = self.output('keyframe/floor_scan')
        self._free_scan = FreeScan(self, self._known_mount)
        self.inputs.subscribe('camera_mount', self._take_mount)
        parts = (LEFT, RIGHT, LEFT_INFO, RIGHT_INFO, POSE)
        self._keyframes = KeyframeJoin(
            self, parts, self._segment, may_process=self._has_mount, optional=(MOVING_MASK,)
        )

    def reset_stage(self) -> None:
        """Begin without memory of the floor."""
        self._free_scan.reset()
        self._camera: StereoCamera | None = None
        self._stage: FloorSegmentation | None = None
        self._mount_check: MountCheck | None = None

    def on_settings_changed(self) -> None:
        """Segment the next keyframe with the new settings, and with what is remembered."""
        self._free_scan.reset()
        if self._stage is not None:
            self._stage.change_settings(self.parameters.stage)

    def _take_mount(self, message: TransformStamped) -> None:
        self._mount = Mount.from_transform(transform_array(message))
        self._mount_stamp_ns = to_ns(message.header.stamp)
        self._base_frame = message.header.frame_id
        self._keyframes.process_waiting()

    def _known_mount(self) -> tuple[str, Mount] | None:
        if self._mount is None or not self._has_mount():
            return None
        return self._base_frame, self._mount

    def _has_mount(self) -> bool:
        """Whether the mount is known, of the map that the keyframes belong to: it travels on a
        topic of its own and may come a moment later.
        """
        map_start_ns = self._keyframes.map_start_ns
        return self._mount is not None and map_start_ns in (None, self._mount_stamp_ns)

    def _segment(self, stamp_ns: int, parts: Mapping[str, Any]) -> dict[str, Any]:
        assert self._mount is not None
        stage, camera = self._stage_for(parts)
        frame_id = parts[LEFT].header.frame_id
        left, right = grey8_image(parts[LEFT], LEFT), right_image(parts[RIGHT], RIGHT)
        T_map_base = pose_array(parts[POSE].pose.pose)
        moving = grey8_image(parts[MOVING_MASK], MOVING_MASK) if MOVING_MASK in parts else None
        floor = stage.process(left, right, self._mount, T_map_base, moving)
        self._mask.publish(image_message(stamp_ns, frame_id, floor.mask))
        self._scan.publish(scan_message(stamp_ns, self._base_frame, floor.scan))
        if self._disparity.get_subscription_count():
            self._disparity.publish(disparity_message(stamp_ns, frame_id, camera, floor))
        if self._overlay.get_subscription_count():
            picture = mask_overlay(left, floor.mask)
            self._overlay.publish(image_message(stamp_ns, frame_id, picture, 'bgr8'))
        if self._v_disparity.get_subscription_count():
            picture = v_disparity_picture(floor)
            self._v_disparity.publish(image_message(stamp_ns, frame_id, picture, 'bgr8'))
        if self._mount_check is not None and not self._mount_check.is_done:
            self._compare_mounts(self._mount_check.add(left, right, T_map_base))
        return {}

    def _compare_mounts(self, words: str | None) -> None:
        if words is not None:
            self.reporter.diagnose(
                'mount',
                f'{words}; correct the tf from {self._base_frame} to the camera, or the parameters '
                'camera_height_m, camera_pitch_rad and camera_roll_rad of stereo_slam',
                lasts_s=float('inf'),
            )

    def find_problems(self) -> None:
        """Say what the keyframes wait for."""
        if self._keyframes.waiting_count:
            text = 'no message on camera_mount; is stereo_slam running?'
            self.reporter.diagnose('camera_mount', text)

    def _stage_for(self, parts: Mapping[str, Any]) -> tuple[FloorSegmentation, StereoCamera]:
        eyes = (eye_calibration(parts[topic], topic) for topic in (LEFT_INFO, RIGHT_INFO))
        camera = StereoCalibration(*eyes).camera
        if self._stage is None or camera != self._camera:
            self._camera = camera
            self._stage = FloorSegmentation(camera, self.parameters.stage)
            assert self._mount is not None
            self._mount_check = self._mount_check or MountCheck(camera, self._mount)
        return self._stage, camera


def main() -> None:
    """Run the node."""
    run_node(FloorSegmentationNode)


if __name__ == '__main__':
    main()
