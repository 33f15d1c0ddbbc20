"""Which images cannot be tracked: black, white, only half delivered, or the same as before."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.model import is_disparity
from segfloor_ros.core.contracts import StereoFrame
from segfloor_ros.core.slam.optional import SoundImages
from segfloor_ros.core.slam.tracking.patch_alignment import GREY_NOISE
from segfloor_ros.core.timing import timed

LIVE_ROWS = 0.6
"""Share of the rows of an image that must show something: others were not delivered."""

MIN_EXPECTED_SHIFT = 0.004
"""Motion of the picture, in widths per frame, that cannot stop from one frame to the next."""


def image_fault(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> str:
    """Return what is wrong with a stereo pair of grey images (H, W), in words, or '' when it
    can be tracked.
    """
    for side, image in (('left', left), ('right', right)):
        sampled = np.ascontiguousarray(image[::4, ::4])
        mean, spread = (float(value[0, 0]) for value in cv2.meanStdDev(sampled))
        if spread < GREY_NOISE:
            return f'{side} image without contrast (mean grey level {mean:.0f})'
        live = (sampled != sampled[:, :1]).any(axis=1)
        if live.mean() < LIVE_ROWS:
            return f'{side} image incomplete: {1 - live.mean():.0%} of its rows are empty'
    return ''


class ImageCheck(SoundImages):
    """Distinguishes an image that a camera delivers twice, as a Kinect does, from a camera that is
    frozen: it delivers the same one again and again. A robot that stands still shows the same view,
    too, but then no motion was to be expected.
    """

    def __init__(self) -> None:
        self._last: NDArray[np.uint8] | None = None
        self.is_repeated = self.is_carried = self._is_frozen = False

    @timed
    def fault(self, frame: StereoFrame, expected_shift: Callable[[], float]) -> str:
        """Return why a pair of images cannot be tracked, or ''."""
        frozen = self.is_frozen(frame.left, expected_shift)
        fault = image_fault(frame.left, frame.left if is_disparity(frame.right) else frame.right)
        if frozen and not fault:
            return 'the image is again the one before although the camera was moving'
        return fault

    def is_frozen(self, left: NDArray[np.uint8], expected_shift: Callable[[], float]) -> bool:
        """Return whether the image (H, W) is the one before for a second time although it was to
        move by expected_shift(), a share of its width, which is asked for only then.
        """
        was_carried = self.is_carried
        self.is_repeated = self._last is not None and np.array_equal(left, self._last)
        self._last = left
        self._is_frozen &= self.is_repeated
        should_move = self.is_repeated and expected_shift() > MIN_EXPECTED_SHIFT
        self._is_frozen |= should_move and was_carried
        self.is_carried = should_move and not self._is_frozen
        return self._is_frozen
