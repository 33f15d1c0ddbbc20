"""A network beside a drive: each image is looked at once, on a thread of its own."""

from __future__ import annotations

import dataclasses
import logging
import threading
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import StereoFrame
from segfloor_ros.floor.observation import MOVING, NO_EVIDENCE
from segfloor_ros.semantics.network import Network
from segfloor_ros.slam.moving.scene_flow import MAX_MOVING_SHARE
from segfloor_ros.slam.tracking.images import union
from segfloor_ros.timing import StageTimes

logger = logging.getLogger(__name__)

KEPT = 32
"""Images whose labels are kept: as many frames as lie between an image and its keyframe's turn."""


class ImageLabeller:
    """Labels the images of a drive; may be asked by several threads.

    remarks: what is wrong with what the network sees, in words.
    """

    def __init__(self, network: Network, times: StageTimes | None = None) -> None:
        self.network = network
        self.remarks: list[str] = []
        self._times = times or StageTimes()
        self._lock = threading.Lock()
        self._known: dict[int, NDArray[np.uint8]] = {}

    @property
    def classes(self) -> list[str]:
        """The names of the classes."""
        return self.network.settings.classes

    @property
    def is_late(self) -> bool:
        """Whether the network looks at keyframes alone, once they are keyframes."""
        return self.network.settings.every == 0

    def labels(self, stamp_ns: int, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the labels (H, W) of the image of a stamp. Raises InputError."""
        with self._lock:
            if stamp_ns not in self._known:
                with self._times.measure('network'):
                    self._known[stamp_ns] = self.network.infer(image).labels
                if len(self._known) > KEPT:
                    del self._known[next(iter(self._known))]
            return self._known[stamp_ns]

    def says(self, stamp_ns: int, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return what the network says of the floor in an image (H, W), as `Network.says`. Where
        nearly all of the image moves, it is wrong, or nothing can be seen beside it: nothing does.
        """
        said = self.network.says(self.labels(stamp_ns, image))
        share = float((said == MOVING).mean())
        if share > MAX_MOVING_SHARE:
            self._remark(
                f'{self.network.name}: {100 * share:.0f} % of an image are of classes that move; '
                f'masks of more than {100 * MAX_MOVING_SHARE:.0f} % are not used'
            )
            said = np.where(said == MOVING, np.uint8(NO_EVIDENCE), said)
        return said

    def moving(self, stamp_ns: int, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the mask (H, W) of what may move in an image, 255."""
        return np.where(self.says(stamp_ns, image) == MOVING, np.uint8(255), np.uint8(0))

    def with_masks(self, frames: Iterator[StereoFrame]) -> Iterator[StereoFrame]:
        """Yield the frames with masks: that of the last one that the network has looked at."""
        every = self.network.settings.every
        mask: NDArray[np.uint8] | None = None
        for number, frame in enumerate(frames):
            if every and number % every == 0:
                mask = self.moving(frame.stamp_ns, frame.left)
            yield dataclasses.replace(frame, excluded=union(frame.excluded, mask))

    def _remark(self, words: str) -> None:
        if not self.remarks:
            self.remarks.append(words)
            logger.warning('%s', words)
