"""What kind of recording an input is, what it holds, and whether it will do; videos, whose frames
show the left image beside the right one, and cameras of this machine: one that does likewise, or
two.

Video4Linux by OpenCV. Two cameras without a common trigger are asked for their images one right
after the other; where the robot turns fast, that is not at the same time.
"""

from __future__ import annotations

import logging
import math
import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.apps.recordings.bag import open_bag
from segfloor_ros.apps.recordings.bag_file import is_bag, open_bag_file
from segfloor_ros.apps.recordings.calibration_files import find_calibration
from segfloor_ros.apps.recordings.files import rate_of
from segfloor_ros.apps.recordings.image_folders import (
    has_image_sides,
    is_euroc,
    is_kitti,
    is_tum_rgbd,
    open_euroc,
    open_image_folders,
    open_kitti,
    open_tum_rgbd,
)
from segfloor_ros.apps.recordings.source import DEFAULT_RATE_HZ, MaskFolder, PairEntry, StereoSource
from segfloor_ros.core.camera.images import to_grey
from segfloor_ros.core.camera.pixels import Grey
from segfloor_ros.core.camera.recording import RecordedSensor
from segfloor_ros.core.camera.settings import StereoCameraSettings
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.paths import user_path
from segfloor_ros.core.files.whole import check_file
from segfloor_ros.core.plugins.rig.check import BURST, RigCheck
from segfloor_ros.core.standard_error import silent_libraries

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

BURSTS = 8
"""Parts of the recording that are looked at."""

PAUSE_S, PAUSE_FRAMES = 0.5, 5
"""A camera moves far in so long a gap; a slow one is no gap where all of them are as long."""


def open_source(settings: StereoCameraSettings) -> StereoSource:
    """Open the recording or device `settings.input`, whatever its kind.

    Raises InputError when there is nothing to read or its parts do not fit together,
    CalibrationError when the calibration is missing, impossible or for other images.
    """
    if not settings.input:
        raise InputError(f'no input is given; set stereo_camera.input to {KINDS}')
    try:
        path = user_path(settings.input)
        if not (path.exists() or is_device(path)):
            raise InputError(f'{path}: no such file or folder; give {KINDS}')
        kind = _kind(path)
        if kind is None:
            raise InputError(f'{path}: not a known kind of recording; give {KINDS}')
        source = kind.open(path, settings)
        if settings.depth and not source.takes_depth:
            raise InputError(
                f'{source.name}: no depth images can be read from it; leave out --depth'
            )
        source.cut(settings.start, settings.frames, settings.every)
        if settings.masks:
            source.masks = MaskFolder(user_path(settings.masks), source.camera)
        return source
    except OSError as error:
        raise InputError(
            f'{error.filename or settings.input}: cannot be read ({error.strerror})'
        ) from None


def is_video(path: Path) -> bool:
    """Whether `path` is named like a video file."""
    return path.suffix.lower() in VIDEO_SUFFIXES


def open_device(path: Path, settings: StereoCameraSettings) -> StereoSource:
    """Open a camera, or two, by their numbers, with the calibration of the settings or of the
    current folder. Raises InputError or CalibrationError.
    """
    name = str(path)
    calibration = find_calibration(f'device {name}', (Path.cwd(),), settings)
    left = calibration.left
    device = StereoDevice(name, (left.width, left.height), settings.rate_hz, settings.exposure_s)

    def entries(source: StereoSource) -> Iterator[PairEntry]:
        for index, (stamp_ns, images) in enumerate(device.pairs()):
            yield PairEntry(index, stamp_ns, partial(_pair, images, source.takes_colour))

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
                yield PairEntry(index, stamp_ns, partial(_pair, halves(image), source.takes_colour))

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


def _pair(images: ColourPair, takes_colour: bool) -> tuple[Grey, Grey]:
    return images[0] if takes_colour else to_grey(images[0]), to_grey(images[1])


def is_device(path: Path) -> bool:
    """Whether `path` is a camera, its number or /dev/video with its number, or two with a comma."""
    return re.fullmatch(f'{DEVICE}(,{DEVICE})?', str(path)) is not None


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
FILES = (
    Kind('camera device, side by side', is_device, open_device),
    BAG,
    Kind('video, side by side', is_video, open_video),
)

VIDEO_SUFFIXES = {'.mp4', '.avi', '.mkv', '.mov', '.webm', '.m4v', '.mpg', '.mpeg', '.mjpeg'}


def _kind(path: Path) -> Kind | None:
    kinds = FOLDERS if path.is_dir() else FILES
    return next((kind for kind in kinds if kind.recognises(path)), None)


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


@dataclass(frozen=True)
class Stream:
    """Messages or files of one kind: where, what they are, how many, how many a second and their
    longest gap; None where that is not known.
    """

    where: str
    what: str
    messages: int
    rate_hz: float | None = None
    longest_gap_s: float | None = None


@dataclass(frozen=True)
class Inspection:
    """What there is to say of a recording. fov_deg: across and along the rectified image. rows_px:
    by how much the same points stand in other rows, None where too little is seen. faults: as
    `InputFault`. to_mend: what is wrong and what to do, in lines.
    """

    name: str
    kind: str
    size_mb: float
    pairs: int
    skipped: int
    duration_s: float
    rate_hz: float
    image: str
    distortion: str
    is_rectified: bool
    baseline_m: float | None
    focal_px: float
    fov_deg: tuple[float, float]
    rows_px: float | None
    streams: list[Stream]
    faults: list[dict[str, Any]]
    to_mend: list[str]


def inspect_recording(
    source: StereoSource, path: Path, on_progress: Callable[[int], None]
) -> Inspection:
    """Read an open recording once and look at some of its pairs. path: of the input. Raises
    InputError or CalibrationError where it is inconsistent.
    """
    check = RigCheck(source.camera)
    stamps = _look_through(source, check, on_progress)
    faults = [*check.faults.values()]
    camera, eye = source.camera, source.calibration.left
    size_px = np.array([camera.width, camera.height])
    across, along = 2 * np.degrees(np.arctan(size_px / 2 / (camera.fx, camera.fy)))
    pairs = _stream('pairs', 'left with depth' if source.takes_depth else 'left and right', stamps)
    sensors = [_sensor_stream(sensor) for sensor in source.sensors]
    return Inspection(
        name=source.name,
        kind=kind.words if (kind := _kind(path)) else 'unknown',
        size_mb=size_mb(path),
        pairs=len(stamps),
        skipped=source.skipped_frames,
        duration_s=1e-9 * (stamps[-1] - stamps[0]) if stamps else 0.0,
        rate_hz=source.rate_hz,
        image=f'{camera.width}x{camera.height}',
        distortion='none' if eye.is_straight else eye.distortion_model,
        is_rectified=source.calibration.is_rectified,
        baseline_m=None if source.takes_depth else camera.baseline_m,
        focal_px=camera.fx,
        fov_deg=(float(across), float(along)),
        rows_px=None if math.isnan(check.rows_px) else check.rows_px,
        streams=[pairs, *sensors, *_other_topics(path, sensors)],
        faults=check.as_dicts(),
        to_mend=[*(fault.line() for fault in faults), *_gaps(stamps, source)],
    )


def _look_through(
    source: StereoSource, check: RigCheck, on_progress: Callable[[int], None]
) -> list[int]:
    """Return the stamps of all pairs; those of some bursts are looked at."""
    count = source.frame_count or BURST * BURSTS
    starts = np.unique(np.linspace(0, max(count - BURST, 0), BURSTS).astype(int)).tolist()
    looked_at = {start + i for start in starts for i in range(BURST)}
    stamps: list[int] = []
    for number, entry in enumerate(source.entries()):
        if number in starts and number - 1 not in looked_at:
            check.jump()
        stamps.append(entry.stamp_ns)
        frame = source.frame(entry) if number in looked_at else None
        if frame is not None:
            check.see(frame)
        on_progress(number + 1)
        if source.frame_count is None and len(stamps) >= count:
            break
    return stamps


def _stream(where: str, what: str, stamps_ns: Sequence[int]) -> Stream:
    steps_s = 1e-9 * np.diff(stamps_ns)
    if len(steps_s) == 0 or steps_s.max() <= 0:
        return Stream(where, what, len(stamps_ns))
    return Stream(where, what, len(stamps_ns), rate_of(stamps_ns), float(steps_s.max()))


def _sensor_stream(sensor: RecordedSensor) -> Stream:
    if not sensor.used:
        return Stream(sensor.where, f'{sensor.name}, not used', sensor.messages)
    stamps = sorted(m.stamp_ns for m in sensor.read())
    if not stamps:
        return Stream(sensor.where, sensor.name, sensor.messages)
    return _stream(sensor.where, sensor.name, stamps)


def _other_topics(path: Path, sensors: Sequence[Stream]) -> list[Stream]:
    """Return the other topics of a bag."""
    if not (path.exists() and is_bag(path)):
        return []
    known = {sensor.where for sensor in sensors}
    with open_bag_file(path) as bag:
        return [
            Stream(name, topic.msgtype, topic.num_messages)
            for name, topic in sorted(bag.topics.items())
            if name not in known
        ]


def _gaps(stamps: Sequence[int], source: StereoSource) -> list[str]:
    """Return in words what is missing among the pairs."""
    found = []
    steps_s = 1e-9 * np.diff(stamps)
    usual_s = float(np.median(steps_s)) if len(steps_s) else 0.0
    pauses = np.flatnonzero(steps_s > max(PAUSE_S, PAUSE_FRAMES * usual_s))
    if len(pauses):
        longest = int(np.argmax(steps_s))
        found.append(
            f'{len(pauses)} pauses, the longest of {steps_s[longest]:.1f} s after '
            f'{1e-9 * (stamps[longest] - stamps[0]):.1f} s; record to a faster disk, or expect '
            'the camera to be lost there until it sees a known place again'
        )
    if source.skipped_frames:
        found.append(
            f'{source.skipped_frames} pairs cannot be read or came twice; record them again where '
            'they matter'
        )
    return found


def size_mb(path: Path) -> float:
    """Return the size of a file, or of all in a folder."""
    return sum(f.stat().st_size for f in [path, *path.rglob('*')] if f.is_file()) / 1e6
