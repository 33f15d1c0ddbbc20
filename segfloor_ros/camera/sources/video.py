"""A video file or a camera device whose frames show the left image beside the right one."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.calibration import StereoCalibration
from segfloor_ros.camera.images import Grey, to_grey
from segfloor_ros.camera.settings import StereoCameraSettings
from segfloor_ros.camera.sources.found_calibration import find_calibration
from segfloor_ros.camera.sources.source import DEFAULT_RATE_HZ, PairEntry, StereoSource
from segfloor_ros.errors import InputError

VIDEO_SUFFIXES = {'.mp4', '.avi', '.mkv', '.mov', '.webm', '.m4v', '.mpg', '.mpeg', '.mjpeg'}


def is_video(path: Path) -> bool:
    """Whether `path` is named like a video file."""
    return path.suffix.lower() in VIDEO_SUFFIXES


def is_device(name: str) -> bool:
    """Whether `name` is a camera device: its number, or /dev/video with its number."""
    return name.removeprefix('/dev/video').isdigit()


def open_video(path: Path, settings: StereoCameraSettings) -> VideoSource:
    """Open a side-by-side video with the calibration beside it or in the settings.

    Raises InputError or CalibrationError.
    """
    calibration = find_calibration(str(path), (path.parent,), settings)
    return VideoSource(str(path), calibration, settings, is_live=False)


def open_device(name: str, settings: StereoCameraSettings) -> VideoSource:
    """Open a side-by-side camera device. Raises InputError or CalibrationError."""
    calibration = find_calibration(f'device {name}', (Path.cwd(),), settings)
    return VideoSource(name, calibration, settings, is_live=True)


class VideoSource(StereoSource):
    """The frames of a video, stamped by their number and the frame rate, or of a device, stamped
    on arrival.
    """

    def __init__(
        self,
        name: str,
        calibration: StereoCalibration,
        settings: StereoCameraSettings,
        is_live: bool,
    ) -> None:
        self._path = name
        self._is_live = is_live
        self._size = (2 * calibration.left.width, calibration.left.height)
        with self._opened() as video:
            count = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
            rate_hz = settings.rate_hz or video.get(cv2.CAP_PROP_FPS) or DEFAULT_RATE_HZ
        super().__init__(
            name,
            calibration,
            frame_count=None if is_live or count <= 0 else count,
            rate_hz=rate_hz,
        )

    def _entries(self) -> Iterator[PairEntry]:
        with self._opened() as video:
            index = 0
            while True:
                ok, image = video.read()
                if not ok:
                    return
                stamp_ns = time.time_ns() if self._is_live else round(index * 1e9 / self.rate_hz)
                yield PairEntry(index, stamp_ns, partial(_halves, image))
                index += 1

    @contextmanager
    def _opened(self) -> Iterator[cv2.VideoCapture]:
        name = self._path.removeprefix('/dev/video')
        video = cv2.VideoCapture(int(name) if self._is_live else self._path)
        try:
            if not video.isOpened():
                what = 'the device' if self._is_live else 'the video'
                raise InputError(f'{self._path}: cannot open {what}; is it there and readable?')
            if self._is_live:
                video.set(cv2.CAP_PROP_FRAME_WIDTH, self._size[0])
                video.set(cv2.CAP_PROP_FRAME_HEIGHT, self._size[1])
            yield video
        finally:
            video.release()


def _halves(image: NDArray[np.uint8]) -> tuple[Grey, Grey]:
    grey = to_grey(image)
    half = grey.shape[1] // 2
    return grey[:, :half].copy(), grey[:, half:].copy()
