"""Masks of what moves, from a segmentation network."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import Image

from segfloor_ros.camera.rectification import StereoRectifier
from segfloor_ros.messages.headers import to_ns
from segfloor_ros.messages.images import grey8_image
from segfloor_ros.nodes.stage_node import AnyStageNode

TOPIC = 'dynamic_mask'
KEPT = 30
"""Masks that are kept for frames that have not been processed yet."""


class MaskInput:
    """Receives masks and gives each frame the one of its stamp, or the latest that is not too old:
    a network is slower than the camera, and no frame waits for it.
    """

    def __init__(self, node: AnyStageNode, timeout_s: float) -> None:
        self._timeout_ns = round(timeout_s * 1e9)
        self.reset()
        node.inputs.subscribe(TOPIC, self.take)

    def reset(self) -> None:
        """Forget the masks."""
        self._masks: dict[int, Image] = {}

    def take(self, message: Image) -> None:
        """Keep a mask."""
        self._masks[to_ns(message.header.stamp)] = message
        while len(self._masks) > KEPT:
            del self._masks[min(self._masks)]

    def mask_for(self, stamp_ns: int, rectifier: StereoRectifier) -> NDArray[np.uint8] | None:
        """Return the mask (H, W) uint8 on the rectified left image of a frame, None where there is
        none. Raises MessageError for one that is no grey image, CalibrationError for a wrong size.
        """
        fitting = [at for at in self._masks if stamp_ns - self._timeout_ns <= at <= stamp_ns]
        if not fitting:
            return None
        mask = grey8_image(self._masks[max(fitting)], TOPIC)
        return rectifier.rectify_mask(mask)
