"""What kind of recording an input is; videos, whose frames show the left image beside the right
one, and cameras that this machine has: one that does likewise, or two.

Video4Linux by OpenCV. Two cameras without a common trigger are asked for their images one right
after the other; where the robot turns fast, that is not at the same time.
"""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from itertools import count
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.calibration.files import find_calibration
from segfloor_ros.camera.images import to_grey
from segfloor_ros.camera.model import StereoCameraSettings
from segfloor_ros.camera.sources.bag import open_bag
from segfloor_ros.camera.sources.bag_file import is_bag
from segfloor_ros.camera.sources.image_folders import (
    has_image_sides,
    is_euroc,
    is_kitti,
    is_tum_rgbd,
    open_euroc,
    open_image_folders,
    open_kitti,
    open_tum_rgbd,
)
from segfloor_ros.camera.sources.source import DEFAULT_RATE_HZ, MaskFolder, PairEntry, StereoSource
from segfloor_ros.errors import InputError
from segfloor_ros.files.images import Grey, silent_libraries
from segfloor_ros.files.whole import check_file

KINDS = (
    'a KITTI odometry folder, an EuRoC folder, image folders left and right with left.yaml and '
    'right.yaml, a TUM RGB-D folder, a ROS bag (.mcap, .db3, .bag), or a video or device with a '
    'calibration'
)

logger = logging.getLogger(__name__)

ColourPair = tuple[NDArray[np.uint8], NDArray[np.uint8]]

DEVICE = r'(?:/dev/video)?([0-9]{1,3})'
V4L2_MANUAL, V4L2_AUTOMATIC = 1, 3
"""Values of V4L2_CID_EXPOSURE_AUTO."""

V4L2_EXPOSURE_S = 1e-4
"""Unit of V4L2_CID_EXPOSURE_ABSOLUTE."""

RETRY_S, PATIENCE_S = 0.5, 10.0
"""A camera that is unplugged is looked for so often, and opened again if it is back within the
other."""


def open_source(settings: StereoCameraSettings) -> StereoSource:
    """Open the recording or device `settings.input`, whatever its kind.

    Raises InputError when there is nothing to read or its parts do not fit together,
    CalibrationError when the calibration is missing, impossible or for other images.
    """
    if not settings.input:
        raise InputError(f'no input is given; set stereo_camera.input to {KINDS}')
    try:
        source = _open(settings)
        if settings.depth and not source.takes_depth:
            raise InputError(
                f'{source.name}: no depth images can be read from it; leave out --depth'
            )
        source.cut(settings.start, settings.frames, settings.every)
        if settings.masks:
            source.masks = MaskFolder(Path(settings.masks).expanduser(), source.camera)
        return source
    except OSError as error:
        raise InputError(
            f'{error.filename or settings.input}: cannot be read ({error.strerror})'
        ) from None


def _open(settings: StereoCameraSettings) -> StereoSource:
    path = Path(settings.input).expanduser()
    if is_device(settings.input) and not path.is_dir():
        return open_device(settings.input, settings)
    if not path.exists():
        raise InputError(f'{path}: no such file or folder; give {KINDS}')
    for kind in FOLDERS if path.is_dir() else FILES:
        if kind.recognises(path):
            return kind.open(path, settings)
    raise InputError(f'{path}: not a known kind of recording; give {KINDS}')


def is_video(path: Path) -> bool:
    """Whether `path` is named like a video file."""
    return path.suffix.lower() in VIDEO_SUFFIXES


def open_device(name: str, settings: StereoCameraSettings) -> StereoSource:
    """Open a camera, or two, with the calibration of the settings or of the current folder. Raises
    InputError or CalibrationError.
    """
    calibration = find_calibration(f'device {name}', (Path.cwd(),), settings)
    left = calibration.left
    device = StereoDevice(name, (left.width, left.height), settings.rate_hz, settings.exposure_s)

    def entries(source: StereoSource) -> Iterator[PairEntry]:
        for index, (stamp_ns, images) in enumerate(device.pairs()):
            yield PairEntry(index, stamp_ns, partial(_grey_pair, images))

    rate_hz = settings.rate_hz or DEFAULT_RATE_HZ
    return StereoSource(name, calibration, entries, frame_count=None, rate_hz=rate_hz)


def open_video(path: Path, settings: StereoCameraSettings) -> StereoSource:
    """Open a side-by-side video with the calibration beside it or in the settings, stamped by its
    frame rate.

    Raises InputError or CalibrationError.
    """
    check_file(path)
    calibration = find_calibration(str(path), (path.parent,), settings)

    def entries(source: StereoSource) -> Iterator[PairEntry]:
        with _opened_video(path) as video:
            for index in count():
                with silent_libraries():
                    ok, image = video.read()
                if not ok:
                    return
                stamp_ns = round(index * 1e9 / source.rate_hz)
                yield PairEntry(index, stamp_ns, partial(_grey_pair, halves(image)))

    with _opened_video(path) as video:
        frames = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
        rate_hz = settings.rate_hz or video.get(cv2.CAP_PROP_FPS) or DEFAULT_RATE_HZ
    frame_count = frames if frames > 0 else None
    return StereoSource(str(path), calibration, entries, frame_count=frame_count, rate_hz=rate_hz)


@contextmanager
def _opened_video(path: Path) -> Iterator[cv2.VideoCapture]:
    with silent_libraries():
        video = cv2.VideoCapture(str(path))
    try:
        if not video.isOpened():
            raise InputError(f'{path}: cannot open the video; is it there and readable?')
        yield video
    finally:
        video.release()


def _grey_pair(images: ColourPair) -> tuple[Grey, Grey]:
    return to_grey(images[0]), to_grey(images[1])


def kind_of(name: str) -> str:
    """Return what kind of recording an input is, in words."""
    path = Path(name).expanduser()
    if is_device(name) and not path.is_dir():
        return 'camera device, side by side'
    kinds = FOLDERS if path.is_dir() else FILES
    return next((kind.words for kind in kinds if kind.recognises(path)), 'unknown')


class Kind(NamedTuple):
    """A kind of recording: what it is called, what recognises it, and what opens it."""

    words: str
    recognises: Callable[[Path], bool]
    open: Callable[[Path, StereoCameraSettings], StereoSource]


BAG = Kind('ROS bag', is_bag, open_bag)
FOLDERS = (
    Kind('TUM RGB-D folder', is_tum_rgbd, open_tum_rgbd),
    Kind('KITTI odometry folder', is_kitti, open_kitti),
    Kind('EuRoC folder', is_euroc, open_euroc),
    BAG,
    Kind('folders of images', has_image_sides, open_image_folders),
)
FILES = (BAG, Kind('video, side by side', is_video, open_video))

VIDEO_SUFFIXES = {'.mp4', '.avi', '.mkv', '.mov', '.webm', '.m4v', '.mpg', '.mpeg', '.mjpeg'}


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
