"""What the node `stereo_slam` takes of a camera: stereo pairs and their calibration, from whatever
its driver publishes, and what is wrong with either, in words.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.topic_endpoint_info import TopicEndpointInfo
from sensor_msgs.msg import CameraInfo

from segfloor_ros.core.camera.calibration import StereoCalibration
from segfloor_ros.core.camera.camera_info import eye_calibration
from segfloor_ros.core.camera.depth import depth_calibration, disparity_of_depth
from segfloor_ros.core.camera.images import EightBitScale, depth_image, grey_image
from segfloor_ros.core.camera.rectification import StereoRectifier
from segfloor_ros.core.contracts import InputFault, Mount
from segfloor_ros.core.errors import InputError
from segfloor_ros.nodes.messages.camera_infos import same_calibration
from segfloor_ros.nodes.messages.topics import IMAGES, KEYFRAMES, LATCHED, PATIENCE_S, best_effort
from segfloor_ros.nodes.settings.slam import StereoSlamNodeSettings
from segfloor_ros.nodes.shared.inputs import DISCOVERY_S
from segfloor_ros.nodes.shared.stage_node import AnyStageNode

CATCH_UP = 0.2
"""Of so many of the pairs kept one is skipped per pair processed, where there is no other way."""

INFOS = ('left/camera_info', 'right/camera_info')

DEPTH = 'depth/image_raw'


Pair = dict[str, Any]
"""A left and a right message of the same time, by topic."""

StampedPair = tuple[int, Pair]


class Watch(Protocol):
    """Finds over time what is wrong with a camera, and says it (`watches.camera`)."""

    def expect(self, left: str, right: str) -> None:
        """Watch these two topics from now on."""

    def saw_image(self, topic: str, stamp_ns: int) -> None:
        """Note an image."""

    def note_taken(self) -> None:
        """Note that a pair is tracked."""

    def report_skipped(self, stamp_ns: int, is_ready: bool) -> None:
        """Report a pair that newer ones had overtaken. is_ready: tracking has begun."""

    def find_problems(self, missing_infos: list[str]) -> None:
        """Diagnose what shows over time. missing_infos: calibrations that images wait for."""

    def report_faults(self, faults: Iterable[InputFault]) -> None:
        """Diagnose what was found in the images."""

    def judge_measured(self, mount: Mount) -> None:
        """Say so where the mount that was measured from the floor is hard to believe."""


class PairQueue(deque[StampedPair]):
    """Keeps the newest pairs: a late pose is of no use to a robot. What came before processing
    could begin, or while a keyframe was mapped, is caught up on, not thrown away at once.
    """

    def __init__(self) -> None:
        super().__init__()
        self._allowed: float = KEYFRAMES.depth

    def skip_overdue(self, is_ready: bool, least: int) -> list[StampedPair]:
        """Take out the oldest pairs that are too many and return them. is_ready: processing has
        begun; then no more than `least` wait for long, or twice as many soon after none waited.
        """
        if is_ready:
            burst = 2 * least
            allowed = burst if len(self) <= 1 else self._allowed - CATCH_UP
            self._allowed = max(min(allowed, max(len(self), burst)), least)
        skipped = []
        while len(self) > self._allowed:
            skipped.append(self.popleft())
        return skipped

    def reset(self) -> None:
        """Keep many pairs again, as at the start."""
        self._allowed = KEYFRAMES.depth


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
    """Receives images and calibrations, pairs them by stamp, keeps the pairs until they are
    processed, and rectifies them. on_news: called when a pair or a calibration has come.
    """

    def __init__(self, node: AnyStageNode, on_news: Callable[[], None], watch: Watch) -> None:
        own: StereoSlamNodeSettings = node.settings
        self._node = node
        self._own = own
        self._on_news = on_news
        self.pairs = PairQueue()
        self._infos: dict[str, CameraInfo] = {}
        self._latched: set[str] = set()
        self._takes_best_effort = own.image_reliability == 'best_effort'
        self._kinds = [
            kind
            for kind in _kinds(own.use_depth)
            if own.image_kind in ('auto', kind.image)
            and own.image_transport in ('auto', kind.transport)
        ]
        self.watch = watch
        self.reset()
        self._choose(self._kinds[0])
        for info in INFOS:
            take, is_wanted = partial(self._take_info, info), partial(self._needs, info)
            choose = partial(self._choose_profile, info)
            node.inputs.subscribe(info, take, choose, is_wanted, takes_all=True)
        # What waits for a partner, and a whole queue that is taken at once, find room.
        for kind in self._kinds:
            node.inputs.join(
                (kind.left, kind.right),
                self._take_pair,
                on_message=self.watch.saw_image,
                choose_profile=self._choose_profile,
                is_wanted=partial(self._is_chosen, kind),
                takes_all=True,
                capacity=2 * IMAGES.depth,
                tolerance_ns=round(own.sync_tolerance_s * 1e9),
            )

    def _is_chosen(self, kind: Kind) -> bool:
        return self._kind == kind

    def _needs(self, info: str) -> bool:
        return info in self._infos_needed

    def _take_pair(self, stamp_ns: int, pair: Pair) -> None:
        self._is_settled = True
        self.pairs.append((stamp_ns, pair))
        self._on_news()

    def _choose(self, kind: Kind) -> None:
        self._kind = kind
        self.left, self.right = kind.left, kind.right
        self._is_rectified = kind.image == 'rect'
        self.watch.expect(self.left, self.right)

    def reset(self) -> None:
        """Take over the latest calibration with the next pair, and whatever images come."""
        self.pairs.reset()
        self._is_settled = False
        self._depth_seen_s = 0.0
        self._rectifier: StereoRectifier | None = None
        self._eight_bit = EightBitScale()

    @property
    def missing_calibrations(self) -> list[str]:
        """The topics on which no calibration has come."""
        return [topic for topic in self._infos_needed if topic not in self._infos]

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
            self._rectifier = StereoRectifier(self._raw_calibration())
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

    def adapt_to_offers(self) -> None:
        """Take the images best effort where a driver offers no more, if the choice is left to the
        node, and a calibration that was published once, before.
        """
        node, reopens = self._node, False
        if not self._takes_best_effort and self._own.image_reliability == 'auto':
            topics = (*self._infos_needed, self.left, self.right)
            lossy = offered(node, topics, reliability=ReliabilityPolicy.BEST_EFFORT)
            if lossy:
                self._takes_best_effort = reopens = True
                node.get_logger().info(
                    f'receives best effort, as offered: {", ".join(lossy)}; images may get lost'
                )
        missing = {*self.missing_calibrations} - self._latched
        if latched := offered(node, missing, durability=DurabilityPolicy.TRANSIENT_LOCAL):
            self._latched.update(latched)
            reopens = True
        if reopens:
            node.inputs.reopen()

    def _choose_profile(self, topic: str = '') -> QoSProfile:
        if topic in self._latched:
            return LATCHED
        return best_effort(IMAGES) if self._takes_best_effort else IMAGES

    def _raw_calibration(self) -> StereoCalibration:
        """Return the calibration of the images as they come. Raises CalibrationError."""
        eyes = [eye_calibration(self._infos[t], t, self._is_rectified) for t in self._infos_needed]
        return depth_calibration(eyes[0]) if self._kind.is_depth else StereoCalibration(*eyes)

    def _take_info(self, topic: str, message: CameraInfo) -> None:
        if topic in self._infos and same_calibration(message, self._infos[topic]):
            return
        self._infos[topic] = message
        is_rectified = self._is_rectified or not self._is_published(self._kind)
        eye_calibration(message, topic, is_rectified)
        if self._rectifier is not None:
            text = f'{topic}: the calibration is not the one in use; ~/reset takes it over'
            self._node.reporter.diagnose(f'calibration on {topic}', text, lasts_s=PATIENCE_S)
        self._on_news()


def offered(node: Node, topics: Iterable[str], **policies: object) -> list[str]:
    """Return the topics that somebody publishes with some policies, e.g. best effort, which reaches
    no reliable listener.
    """

    def offers(info: TopicEndpointInfo) -> bool:
        return all(getattr(info.qos_profile, name) == one for name, one in policies.items())

    return [t for t in topics if any(map(offers, node.get_publishers_info_by_topic(t)))]
