"""Node `floor_segmentation`: keyframe images in, disparity, floor mask and floor scan out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import Mount
from segfloor_ros.core.errors import about
from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.nodes.messages.diagnostics import REMARKS_APART
from segfloor_ros.nodes.messages.images import (
    disparity_message,
    grey8_image,
    image_message,
    right_image,
)
from segfloor_ros.nodes.messages.poses import pose_array, transform_array
from segfloor_ros.nodes.messages.scans import free_scan_message, obstacle_scan_message, scan_message
from segfloor_ros.nodes.messages.topics import (
    FRAME_PARTS,
    KEYFRAME_PARTS,
    MOVING_MASK,
    SEMANTIC_MASK,
    to_ns,
)
from segfloor_ros.nodes.settings.floor import FloorSegmentationNodeSettings
from segfloor_ros.nodes.shared.keyframes import KeyframeJoin
from segfloor_ros.nodes.shared.map_parts import MapPart
from segfloor_ros.nodes.shared.running import run_node
from segfloor_ros.nodes.shared.stage_node import AnyStageNode, StageNode

POSE = 'keyframe/odometry'
PICTURES = ('keyframe/floor_overlay', 'keyframe/v_disparity')
FRAME_SCANS = {'scan': free_scan_message, 'obstacle_scan': obstacle_scan_message}


class FrameScan:
    """Publishes `scan` and `obstacle_scan` while someone listens: of the newest frame that came,
    from small images, so that they keep up with the camera.

    mount: returns that of the camera and None while it is not known.
    """

    def __init__(self, node: AnyStageNode, mount: Callable[[], tuple[str, Mount] | None]) -> None:
        self._node = node
        self._mount = mount
        self._work = node.inputs.later(self._process)
        self.reset()
        node.inputs.join(FRAME_PARTS, self._take, is_wanted=self._is_wanted, takes_all=True)

    def reset(self) -> None:
        """Begin without a camera."""
        self._stage: FloorSegmentation | None = None
        self._camera: StereoCamera | None = None
        self._newest: tuple[int, dict[str, Any]] | None = None

    def _is_wanted(self) -> bool:
        return any(self._node.outputs.listeners(name) for name in FRAME_SCANS)

    def _take(self, stamp_ns: int, parts: dict[str, Any]) -> None:
        self._newest = stamp_ns, parts
        self._work()

    def _process(self) -> None:
        newest, self._newest = self._newest, None
        mount = self._mount()
        if newest is None or mount is None:
            return
        try:
            self._publish(*newest, *mount)
        except Exception as error:
            self._node.reporter.log_fault('scan', error)

    def _publish(self, stamp_ns: int, parts: dict[str, Any], base_frame: str, mount: Mount) -> None:
        camera, left, right = _stereo(parts, FRAME_PARTS)
        if self._stage is None or camera != self._camera:
            self._camera = camera
            self._stage = FloorSegmentation(camera, self._node.settings)
        floor = self._stage.process(left, right, mount)
        for name, message_of in FRAME_SCANS.items():
            self._node.outputs.publish(name, message_of(stamp_ns, base_frame, floor.scan))


class FloorSegmentationNode(StageNode[FloorSegmentationNodeSettings]):
    """Segments the floor of every keyframe."""

    settings_type = FloorSegmentationNodeSettings

    works_on_demand = True

    def set_up(self) -> None:
        """Make the topics."""
        self.mount: Mount | None = None
        self._mount_stamp_ns = 0
        self._base_frame = ''
        self._frame_scan = FrameScan(self, self._known_mount)
        self.inputs.subscribe('camera_mount', self._take_mount)
        parts = (*KEYFRAME_PARTS, POSE)
        self._keyframes = KeyframeJoin(
            self,
            parts,
            self._segment,
            may_process=self._has_mount,
            optional=(MOVING_MASK, SEMANTIC_MASK),
        )
        self._part = MapPart(self, self._keyframes, 'floor')

    def reset_stage(self) -> None:
        """Begin anew."""
        self._part.reset()
        self._frame_scan.reset()
        self._camera: StereoCamera | None = None
        self._stage: FloorSegmentation | None = None

    def on_settings_changed(self) -> None:
        """Segment the next keyframe with the new settings, and with what is remembered."""
        self._frame_scan.reset()
        if self._stage is not None:
            self._stage.change_settings(self.settings)

    def _take_mount(self, message: TransformStamped) -> None:
        self.mount = Mount.from_transform(transform_array(message))
        self._mount_stamp_ns = to_ns(message.header.stamp)
        self._base_frame = message.header.frame_id
        self._keyframes.process_waiting()

    def _known_mount(self) -> tuple[str, Mount] | None:
        if self.mount is None or not self._has_mount():
            return None
        return self._base_frame, self.mount

    def _has_mount(self) -> bool:
        """Whether the mount is known, of the map that the keyframes belong to: it travels on a
        topic of its own and may come a moment later.
        """
        map_start_ns = self._keyframes.map_start_ns
        return self.mount is not None and map_start_ns in (None, self._mount_stamp_ns)

    def _segment(self, stamp_ns: int, parts: Mapping[str, Any]) -> dict[str, Any]:
        assert self.mount is not None
        camera, left, right = _stereo(parts, KEYFRAME_PARTS)
        stage = self._stage_for(camera)
        frame_id = parts[KEYFRAME_PARTS[0]].header.frame_id
        T_map_base = pose_array(parts[POSE].pose.pose)
        moving = grey8_image(parts[MOVING_MASK], MOVING_MASK) if MOVING_MASK in parts else None
        said = grey8_image(parts[SEMANTIC_MASK], SEMANTIC_MASK) if SEMANTIC_MASK in parts else None
        floor = stage.process(left, right, self.mount, T_map_base, moving, said)
        remarks = stage.remarks
        for what, words in remarks.items():
            self.reporter.diagnose(what, words, lasts_s=float('inf'))
        out, at = self.outputs, (stamp_ns, frame_id)
        out.publish('keyframe/floor_mask', image_message(*at, floor.mask))
        out.publish('keyframe/floor_scan', scan_message(stamp_ns, self._base_frame, floor.scan))
        if out.listeners('keyframe/disparity'):
            out.publish('keyframe/disparity', disparity_message(*at, camera, floor))
        for name in filter(out.listeners, PICTURES):
            from segfloor_ros.core.floor.pictures import mask_overlay, v_disparity_picture

            is_mask = name == PICTURES[0]
            picture = mask_overlay(left, floor.mask) if is_mask else v_disparity_picture(floor)
            out.publish(name, image_message(*at, picture, 'bgr8'))
        self._part.note(stamp_ns, parts[POSE].header.frame_id)
        return {'remarks': REMARKS_APART.join(remarks.values())}

    def find_problems(self) -> None:
        """Say what the keyframes wait for."""
        if self._keyframes.waiting_count:
            text = 'no message on camera_mount; is stereo_slam running?'
            self.reporter.diagnose('camera_mount', text)

    def _stage_for(self, camera: StereoCamera) -> FloorSegmentation:
        if self._stage is None or camera != self._camera:
            self._camera = camera
            self._stage = FloorSegmentation(camera, self.settings)
        return self._stage


def _stereo(
    parts: Mapping[str, Any], topics: Sequence[str]
) -> tuple[StereoCamera, NDArray[np.uint8], NDArray[Any]]:
    """Return camera and rectified images. topics: left image and calibration, then the right."""
    left, left_info, right, right_info = topics
    P, right_P = parts[left_info].p, parts[right_info].p
    size = parts[left_info].width, parts[left_info].height
    baseline_m = -right_P[3] / right_P[0] if right_P[0] else 0.0
    with about(f'{left_info}, {right_info}'):
        camera = StereoCamera(*size, P[0], P[5], P[2], P[6], baseline_m)
    return camera, grey8_image(parts[left], left), right_image(parts[right], right)


def main() -> None:
    """Run the node."""
    run_node(FloorSegmentationNode)


if __name__ == '__main__':
    main()
