"""Images that cannot be tracked: black, white, only half delivered, or the same as before."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.geometry import Array, transform_points

MIN_CONTRAST = 3.0
MIN_LIVE_ROWS = 0.7
MIN_EXPECTED_SHIFT = 0.004
"""Motion of the picture, in widths per frame, that cannot stop from one frame to the next."""


def image_fault(left: NDArray[np.uint8], right: NDArray[np.uint8]) -> str:
    """Return what is wrong with a stereo pair of grey images (H, W), in words, or '' when it
    can be tracked.
    """
    for side, image in (('left', left), ('right', right)):
        sampled = image[::4, ::4]
        if float(sampled.std()) < MIN_CONTRAST:
            return f'{side} image without contrast (mean grey level {sampled.mean():.0f})'
        live = np.ptp(sampled, axis=1) > 0
        if live.mean() < MIN_LIVE_ROWS:
            return f'{side} image incomplete: {1 - live.mean():.0%} of its rows are empty'
    return ''


def expected_shift(camera: StereoCamera, points: Array, T_then: Array, T_now: Array) -> float:
    """Return how far the picture of points (N, 3) should have moved between two poses
    (T_camera_world, (4, 4)), in image widths; 0 without points.
    """
    if len(points) == 0:
        return 0.0
    then, now = (camera.project(transform_points(T, points))[:, :2] for T in (T_then, T_now))
    return float(np.median(np.linalg.norm(now - then, axis=1))) / camera.width


class FrozenCheck:
    """Tells a camera that delivers its last image again and again from a robot that stands still:
    the robot would have had to stop at once, and noise differs from image to image.
    """

    def __init__(self) -> None:
        self._last: NDArray[np.uint8] | None = None
        self._frozen = False

    def frozen(self, left: NDArray[np.uint8], expected_shift: Callable[[], float]) -> bool:
        """Return whether the image (H, W) is the one before although it was to move by
        expected_shift(), a share of its width, which is asked for only then.
        """
        same = self._last is not None and np.array_equal(left, self._last)
        self._last = left
        self._frozen = same and (self._frozen or expected_shift() > MIN_EXPECTED_SHIFT)
        return self._frozen
