"""A video file or a camera device whose frames show the left image beside the right one."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from itertools import count
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.calibration.files import find_calibration
from segfloor_ros.camera.calibration.parameters import StereoCalibration
from segfloor_ros.camera.images import to_grey
from segfloor_ros.camera.settings import StereoCameraSettings
from segfloor_ros.camera.sources.source import DEFAULT_RATE_HZ, PairEntry, StereoSource
from segfloor_ros.errors import InputError
from segfloor_ros.files.images import Grey, silent_libraries
from segfloor_ros.files.whole import check_file

VIDEO_SUFFIXES = {'.mp4', '.avi', '.mkv', '.mov', '.webm', '.m4v', '.mpg', '.mpeg', '.mjpeg'}


def is_video(path: Path) -> bool:
    """Whether `path` is named like a video file."""
    return path.suffix.lower() in VIDEO_SUFFIXES


def is_device(name: str) -> bool:
    """Whether `name` is a camera device: its number, or /dev/video with its number."""
    return re.fullmatch('(/dev/video)?[0-9]{1,3}', name) is not None


def open_video(path: Path, settings: StereoCameraSettings) -> StereoSource:
    """Open a side-by-side video with the calibration beside it or in the settings.

    Raises InputError or CalibrationError.
    """
    check_file(path)
    calibration = find_calibration(str(path), (path.parent,), settings)
    return _video_source(str(path), calibration, settings, is_live=False)


def open_device(name: str, settings: StereoCameraSettings) -> StereoSource:
    """Open a side-by-side camera device. Raises InputError or CalibrationError."""
    calibration = find_calibration(f'device {name}', (Path.cwd(),), settings)
    return _video_source(name, calibration, settings, is_live=True)


def _video_source(
    name: str, calibration: StereoCalibration, settings: StereoCameraSettings, is_live: bool
) -> StereoSource:
    """Return the frames of a video, stamped by their number and the frame rate, or of a device,
    stamped on arrival.
    """
    size = (2 * calibration.left.width, calibration.left.height)

    def entries(source: StereoSource) -> Iterator[PairEntry]:
        with _opened(name, size, is_live) as video:
            for index in count():
                with silent_libraries():
                    ok, image = video.read()
                if not ok:
                    return
                stamp_ns = time.time_ns() if is_live else round(index * 1e9 / source.rate_hz)
                yield PairEntry(index, stamp_ns, partial(_halves, image))

    with _opened(name, size, is_live) as video:
        frames = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
        rate_hz = settings.rate_hz or video.get(cv2.CAP_PROP_FPS) or DEFAULT_RATE_HZ
    frame_count = None if is_live or frames <= 0 else frames
    return StereoSource(name, calibration, entries, frame_count=frame_count, rate_hz=rate_hz)


@contextmanager
def _opened(name: str, size: tuple[int, int], is_live: bool) -> Iterator[cv2.VideoCapture]:
    with silent_libraries():
        video = cv2.VideoCapture(int(name.removeprefix('/dev/video')) if is_live else name)
    try:
        if not video.isOpened():
            what = 'the device' if is_live else 'the video'
            raise InputError(f'{name}: cannot open {what}; is it there and readable?')
        if is_live:
            video.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
            video.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
        yield video
    finally:
        video.release()


def _halves(image: NDArray[np.uint8]) -> tuple[Grey, Grey]:
    grey = to_grey(image)
    half = grey.shape[1] // 2
    return grey[:, :half].copy(), grey[:, half:].copy()
