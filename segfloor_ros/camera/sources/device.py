"""Cameras that this machine has: one whose frames show the left image beside the right one, or two.

Video4Linux by OpenCV. Two cameras without a common trigger are asked for their images one right
after the other; where the robot turns fast, that is not at the same time.
"""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.errors import InputError
from segfloor_ros.files.images import silent_libraries

logger = logging.getLogger(__name__)

ColourPair = tuple[NDArray[np.uint8], NDArray[np.uint8]]

DEVICE = r'(?:/dev/video)?([0-9]{1,3})'
V4L2_MANUAL, V4L2_AUTOMATIC = 1, 3
"""Values of V4L2_CID_EXPOSURE_AUTO."""

V4L2_EXPOSURE_S = 1e-4
"""Unit of V4L2_CID_EXPOSURE_ABSOLUTE."""

RETRY_S = 0.5
PATIENCE_S = 10.0
"""A camera that is unplugged is opened again if it is back within this time."""


def is_device(name: str) -> bool:
    """Whether `name` is a camera, its number or /dev/video with its number, or two with a comma."""
    return re.fullmatch(f'{DEVICE}(,{DEVICE})?', name) is not None


class StereoDevice:
    """A camera, or the left and the right one. size: of one image (width, height). rate_hz and
    exposure_s are asked of the driver; 0 leaves them to it.
    """

    def __init__(
        self, name: str, size: tuple[int, int], rate_hz: float = 0.0, exposure_s: float = 0.0
    ) -> None:
        self._name = name
        self._numbers = [int(number) for number in re.findall(DEVICE, name)]
        beside = 3 - len(self._numbers)
        self._asked = {
            cv2.CAP_PROP_FRAME_WIDTH: float(beside * size[0]),
            cv2.CAP_PROP_FRAME_HEIGHT: float(size[1]),
            cv2.CAP_PROP_AUTO_EXPOSURE: float(V4L2_MANUAL if exposure_s else V4L2_AUTOMATIC),
        }
        if exposure_s:
            self._asked[cv2.CAP_PROP_EXPOSURE] = exposure_s / V4L2_EXPOSURE_S
        if rate_hz:
            self._asked[cv2.CAP_PROP_FPS] = rate_hz

    def pairs(self) -> Iterator[tuple[int, ColourPair]]:
        """Yield arrival (ns) and images until the camera is gone for good. Raises InputError where
        there is none.
        """
        cameras = self._open()
        if cameras is None:
            raise InputError(f'{self._name}: cannot open the device; is it there and readable?')
        try:
            while cameras is not None:
                pair = self._grab(cameras)
                if pair is not None:
                    yield pair
                    continue
                _release(cameras)
                cameras = self._open_again()
        finally:
            _release(cameras or [])

    def _open(self) -> list[cv2.VideoCapture] | None:
        with silent_libraries():
            cameras = [cv2.VideoCapture(number) for number in self._numbers]
        if not all(camera.isOpened() for camera in cameras):
            _release(cameras)
            return None
        for camera in cameras:
            for what, value in self._asked.items():
                camera.set(what, value)
        return cameras

    def _grab(self, cameras: list[cv2.VideoCapture]) -> tuple[int, ColourPair] | None:
        """Return the next pair; None where a camera sends nothing."""
        with silent_libraries():
            if not all(camera.grab() for camera in cameras):
                return None
            stamp_ns = time.time_ns()
            read = [camera.retrieve() for camera in cameras]
        if not all(ok for ok, _ in read):
            return None
        images = [image for _, image in read]
        return stamp_ns, (images[0], images[1]) if len(images) == 2 else halves(images[0])

    def _open_again(self) -> list[cv2.VideoCapture] | None:
        """Return the cameras once they are back; None after a while."""
        logger.warning('%s: sends no images any more; is it plugged in?', self._name)
        gone_s = time.monotonic()
        while time.monotonic() - gone_s < PATIENCE_S:
            time.sleep(RETRY_S)
            cameras = self._open()
            if cameras is not None:
                logger.warning('%s: is back after %.1f s', self._name, time.monotonic() - gone_s)
                return cameras
        logger.warning('%s: did not come back within %g s', self._name, PATIENCE_S)
        return None


def halves(image: NDArray[np.uint8]) -> ColourPair:
    """Return the left and the right half of an image (H, 2 W) or (H, 2 W, 3)."""
    half = image.shape[1] // 2
    return image[:, :half].copy(), image[:, half:].copy()


def _release(cameras: list[cv2.VideoCapture]) -> None:
    for camera in cameras:
        camera.release()
