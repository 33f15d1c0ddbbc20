"""How far the floor is free at every frame: for the node `floor_segmentation`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from segfloor_ros.camera.calibration import StereoCalibration
from segfloor_ros.camera.model import Mount, StereoCamera
from segfloor_ros.floor.segmentation import FloorSegmentation
from segfloor_ros.messages.camera_info import eye_calibration
from segfloor_ros.messages.floor import free_scan_message
from segfloor_ros.messages.images import grey8_image, right_image
from segfloor_ros.messages.topics import FRAME_PARTS
from segfloor_ros.nodes.stage_node import AnyStageNode
from segfloor_ros.nodes.when_idle import WhenIdle

LEFT, LEFT_INFO, RIGHT, RIGHT_INFO = FRAME_PARTS
LOOK_FOR_LISTENERS_S = 0.5
CAPACITY = 10


class FreeScan:
    """Publishes `scan` while someone listens: of the newest frame that has come, from small images
    and without memory, so that it keeps up with the camera.

    mount: returns that of the camera and None while it is not known.
    """

    def __init__(self, node: AnyStageNode, mount: Callable[[], tuple[str, Mount] | None]) -> None:
        self._node = node
        self._mount = mount
        self._output = node.output('scan')
        self._work = WhenIdle(node, self._process)
        self.reset()
        node.inputs.join(FRAME_PARTS, self._take, is_wanted=self._is_wanted, capacity=CAPACITY)
        node.inputs.every(LOOK_FOR_LISTENERS_S, node.inputs.update)

    def reset(self) -> None:
        """Begin without a camera."""
        self._stage: FloorSegmentation | None = None
        self._camera: StereoCamera | None = None
        self._newest: tuple[int, dict[str, Any]] | None = None

    def _is_wanted(self) -> bool:
        return self._output.get_subscription_count() > 0

    def _take(self, stamp_ns: int, parts: dict[str, Any]) -> None:
        self._newest = stamp_ns, parts
        self._work.request()

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
        eyes = (eye_calibration(parts[topic], topic) for topic in (LEFT_INFO, RIGHT_INFO))
        camera = StereoCalibration(*eyes).camera
        if self._stage is None or camera != self._camera:
            self._camera = camera
            self._stage = FloorSegmentation(camera, self._node.parameters.stage)
        left, right = grey8_image(parts[LEFT], LEFT), right_image(parts[RIGHT], RIGHT)
        floor = self._stage.process(left, right, mount)
        self._output.publish(free_scan_message(stamp_ns, base_frame, floor.scan))
