"""Stereo pairs and their calibration as messages, from whatever a camera's driver publishes."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo

from segfloor_ros.camera.calibration.parameters import EyeCalibration, StereoCalibration
from segfloor_ros.camera.calibration.rectification import StereoRectifier
from segfloor_ros.camera.depth import depth_calibration, disparity_of_depth
from segfloor_ros.camera.images import EightBitScale, depth_image, grey_image
from segfloor_ros.camera.ros_messages import eye_calibration
from segfloor_ros.errors import InputError
from segfloor_ros.messages import qos
from segfloor_ros.messages.images import same_calibration
from segfloor_ros.node_settings import StereoSlamNodeSettings
from segfloor_ros.nodes.shared.connections import offered_best_effort
from segfloor_ros.nodes.shared.stage_node import AnyStageNode
from segfloor_ros.nodes.slam.camera_watch import CameraWatch

MAX_KEPT = 100
"""Pairs that are kept while calibration or mount are not known."""

CATCH_UP = 0.2
"""Of so many of the pairs kept one is skipped per pair processed, where there is no other way."""

INFOS = ('left/camera_info', 'right/camera_info')

MAX_UNPAIRED = 30

DEPTH = 'depth/image_raw'

DISCOVERY_S = 4.0
"""Publishers of one driver are seen one after the other, the last ones after so long."""


Pair = dict[str, Any]
"""A left and a right message of the same time, by topic."""

StampedPair = tuple[int, Pair]


class PairQueue(deque[StampedPair]):
    """Keeps the newest pairs: a late pose is of no use to a robot. What came before processing
    could begin is caught up on, not thrown away at once.
    """

    def __init__(self) -> None:
        super().__init__()
        self._allowed: float = MAX_KEPT

    def skip_overdue(self, is_ready: bool, least: int) -> list[StampedPair]:
        """Take out the oldest pairs that are too many and return them. is_ready: processing has
        begun; then no more than `least` wait for long.
        """
        if is_ready:
            self._allowed = max(min(self._allowed - CATCH_UP, len(self)), least)
        skipped = []
        while len(self) > self._allowed:
            skipped.append(self.popleft())
        return skipped

    def reset(self) -> None:
        """Keep many pairs again, as at the start."""
        self._allowed = MAX_KEPT


@dataclass(frozen=True)
class Kind:
    """The image topics of both sides, and what `image_kind` and `image_transport` say of them."""

    left: str
    right: str
    image: str
    transport: str

    @property
    def is_depth(self) -> bool:
        """Whether depth images stand in for the right ones."""
        return self.right == DEPTH


def _kinds(use_depth: bool) -> list[Kind]:
    """Return the kinds of images in order of preference, depth images last or alone."""
    names = [
        (image if transport == 'raw' else f'{image}/{transport}', image[6:], transport)
        for transport in ('raw', 'compressed')
        for image in ('image_raw', 'image_rect')
    ]
    pairs = [Kind(f'left/{name}', f'right/{name}', *of) for name, *of in names]
    depth = [Kind(f'left/{name}', DEPTH, *of) for name, *of in names]
    return depth if use_depth else [*pairs, *depth]


class StereoInput:
    """Receives images and calibrations, pairs them by stamp and rectifies them.

    on_pair: gets every pair. on_calibration: called when a calibration has come.
    """

    def __init__(
        self,
        node: AnyStageNode,
        own: StereoSlamNodeSettings,
        on_pair: Callable[[int, Pair], None],
        on_calibration: Callable[[], None],
    ) -> None:
        self._node = node
        self._own = own
        self._on_calibration = on_calibration
        self._infos: dict[str, CameraInfo] = {}
        self._eyes: dict[str, EyeCalibration] = {}
        self._takes_best_effort = own.image_reliability == 'best_effort'
        self._kinds = [
            kind
            for kind in _kinds(own.use_depth)
            if own.image_kind in ('auto', kind.image)
            and own.image_transport in ('auto', kind.transport)
        ]
        self.watch = CameraWatch(node, own)
        self.reset()
        self._choose(self._kinds[0])
        for info in INFOS:
            node.inputs.subscribe(info, partial(self._take_info, info), self._choose_profile)
        for kind in self._kinds:
            self._join_images(kind, on_pair)

    def _join_images(self, kind: Kind, on_pair: Callable[[int, Pair], None]) -> None:
        def take(stamp_ns: int, pair: Pair) -> None:
            self._is_settled = True
            on_pair(stamp_ns, pair)

        self._node.inputs.join(
            (kind.left, kind.right),
            take,
            on_message=self.watch.saw_image,
            choose_profile=self._choose_profile,
            is_wanted=lambda: self._kind == kind,
            capacity=MAX_UNPAIRED,
            tolerance_ns=round(self._own.sync_tolerance_s * 1e9),
        )

    def _choose(self, kind: Kind) -> None:
        self._kind = kind
        self.left, self.right = kind.left, kind.right
        self._is_rectified = kind.image == 'rect'
        self.watch.expect(self.left, self.right)

    def reset(self) -> None:
        """Take over the latest calibration with the next pair, and whatever images come."""
        self._is_settled = False
        self._depth_seen_s = 0.0
        self._rectifier: StereoRectifier | None = None
        self._eight_bit = EightBitScale(self._own.bit_depth)

    @property
    def missing_calibrations(self) -> list[str]:
        """The topics on which no calibration has come."""
        return [topic for topic in self._infos_needed if topic not in self._eyes]

    @property
    def _infos_needed(self) -> tuple[str, ...]:
        return INFOS[:1] if self._kind.is_depth else INFOS

    @property
    def calibration(self) -> StereoCalibration:
        """The calibration of the rectified images, of which both eyes are known."""
        return self._raw_calibration().rectified()

    @property
    def rectifier(self) -> StereoRectifier:
        """What rectifies, made for the calibration at the first pair."""
        if self._rectifier is None:
            taken = self.calibration if self._is_rectified else self._raw_calibration()
            self._rectifier = StereoRectifier(taken)
        return self._rectifier

    def images(self, pair: Pair) -> tuple[NDArray[np.uint8], NDArray[Any]]:
        """Return the rectified grey images (H, W) of a pair, or the left one and a disparity.

        Raises InputError.
        """
        if self._kind.is_depth:
            return self._depth_images(pair)
        images = (grey_image(pair[topic], topic) for topic in (self.left, self.right))
        left, right = self.rectifier.rectify(*self._eight_bit(*images))
        return left, right

    def _depth_images(self, pair: Pair) -> tuple[NDArray[np.uint8], NDArray[Any]]:
        grey, depth = grey_image(pair[self.left], self.left), depth_image(pair[DEPTH], DEPTH)
        if grey.shape != depth.shape:
            (rows, columns), (grey_rows, grey_columns) = depth.shape, grey.shape
            raise InputError(
                f'{DEPTH}: {columns}x{rows}, but {self.left} is {grey_columns}x{grey_rows}; take '
                'the depth images that are aligned with them'
            )
        left, _ = self._eight_bit(grey, grey)
        disparity = disparity_of_depth(depth, self.rectifier.camera)
        return self.rectifier.rectify(left, disparity)

    def frame_ids(self, pair: Pair) -> tuple[str, str]:
        """Return the names of both optical frames."""
        return pair[self.left].header.frame_id, pair[self.right].header.frame_id

    def find_images(self) -> None:
        """Before the first pair, take the kind of images that is published, if the choice is left
        to the node; depth images only where the right ones stay away: they may be seen later.
        """
        if self._is_settled or not self._node.inputs.is_open:
            return
        published = [kind for kind in self._kinds if self._is_published(kind)]
        if published and published[0].is_depth and not self._own.use_depth:
            now_s = time.monotonic()
            self._depth_seen_s = self._depth_seen_s or now_s
            if now_s < self._depth_seen_s + DISCOVERY_S:
                return
        is_better = self._kind.is_depth and published and not published[0].is_depth
        if published and (self._kind not in published or is_better):
            self._choose(published[0])
            self._node.get_logger().info(
                f'receives {self.left} and {self.right}, which are published; set image_kind and '
                'image_transport to choose others'
            )
            self._node.inputs.update()

    def _is_published(self, kind: Kind) -> bool:
        topics = (kind.left, kind.right)
        return all(self._node.get_publishers_info_by_topic(topic) for topic in topics)

    def adapt_reliability(self) -> None:
        """Take the images best effort where a driver offers no more, if the choice is left to the
        node.
        """
        if self._takes_best_effort or self._own.image_reliability != 'auto':
            return
        lossy = offered_best_effort(self._node, (*self._infos_needed, self.left, self.right))
        if lossy:
            self._takes_best_effort = True
            names = ', '.join(lossy)
            self._node.get_logger().info(
                f'receives best effort, as offered: {names}; images may get lost'
            )
            self._node.inputs.reopen()

    def _choose_profile(self) -> QoSProfile:
        return qos.IMAGES_BEST_EFFORT if self._takes_best_effort else qos.IMAGES

    def _raw_calibration(self) -> StereoCalibration:
        if self._kind.is_depth:
            eye = self._eyes[INFOS[0]]
            if self._is_rectified:
                eye = EyeCalibration.of_rectified(eye.width, eye.height, eye.P, eye.origin)
            return depth_calibration(eye)
        return StereoCalibration(*(self._eyes[topic] for topic in INFOS))

    def _take_info(self, topic: str, message: CameraInfo) -> None:
        if topic in self._infos and same_calibration(message, self._infos[topic]):
            return
        self._eyes[topic] = eye_calibration(message, topic)
        self._infos[topic] = message
        if self._rectifier is not None:
            self._node.reporter.warn(
                f'{topic}: the calibration is not the one in use; ~/reset takes it over'
            )
        self._on_calibration()
