"""Stereo pairs, and what a robot measures besides, as a rosbag2 (mcap): by `rosbags`, without a ROS
install, or by the writer that a ROS install has.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from contextlib import ExitStack
from enum import Enum
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.apps.recordings.bag_file import CAMERA_INFO, COMPRESSED, IMAGE, MISSING_LIBRARY
from segfloor_ros.apps.recordings.source import StereoSource
from segfloor_ros.core.camera.calibration import EyeCalibration, StereoCalibration
from segfloor_ros.core.camera.model import is_disparity
from segfloor_ros.core.camera.pixels import JPEG_QUALITY
from segfloor_ros.core.camera.recording import IMU_FRAME, MeasurementLog, RawPair
from segfloor_ros.core.contracts import ImuSample, Measurement, WheelPose
from segfloor_ros.core.errors import InputError, os_errors
from segfloor_ros.core.files.writing import scratch_folder
from segfloor_ros.core.geometry import make_transform
from segfloor_ros.nodes.messages.camera_infos import camera_info_message, compressed_message
from segfloor_ros.nodes.messages.images import image_message
from segfloor_ros.nodes.messages.making import Make
from segfloor_ros.nodes.messages.poses import transform_message
from segfloor_ros.nodes.messages.sensors import imu_message, wheel_message

SIDES = ('left', 'right')
FRAME_IDS = ('left_camera_optical_frame', 'right_camera_optical_frame')
TF_TOPIC = '/tf_static'

WHEELS_TOPIC, IMU_TOPIC, DEPTH_TOPIC = '/wheel_odometry', '/imu', '/depth/image_raw'

RESERVE_S, LEAST_FREE_BYTES = 10.0, 64_000_000
"""A recording ends while there is space for what comes in this time, so that its file is whole."""

ODOMETRY = 'nav_msgs/msg/Odometry'
IMU = 'sensor_msgs/msg/Imu'
TF = 'tf2_msgs/msg/TFMessage'


class ImageCoding(str, Enum):
    """How images are kept in a bag: pixels in zstd chunks, PNG (both exact), or JPEG (small)."""

    raw = 'raw'
    png = 'png'
    jpeg = 'jpeg'


def convert(
    source: StereoSource,
    out: Path,
    coding: ImageCoding = ImageCoding.raw,
    on_progress: Callable[[int], None] = lambda done: None,
    depth: StereoSource | None = None,
) -> int:
    """Write every pair of a source to a new bag and return how many there were.

    The grey pairs are written as the camera saw them, with the calibration to rectify them, to
    `/left/image_raw` and `/right/image_raw`, or `image_rect` where they are rectified already; what
    wheels and IMU measured, to `/wheel_odometry` and `/imu`. Depth images go to `/depth/image_raw`
    (32FC1, m): those of the source, or of `depth`, the same recording opened with them. on_progress
    gets the number of pairs done. Raises InputError.
    """
    done, log = 0, MeasurementLog(source.sensors)
    depths = _by_stamp(depth)
    writing = os_errors(f'{out}: cannot be written')
    with writing, BagWriter(out, source.calibration, coding) as bag:
        for pair in source.raw_pairs():
            for measurement in log.until(pair.stamp_ns):
                bag.write_measurement(measurement)
            bag.write(pair)
            other = depths(pair.stamp_ns)
            if other is not None and depth is not None:
                bag.write_depth(other, depth.camera.disparity_times_depth)
            done += 1
            on_progress(done)
        for measurement in log.until(np.iinfo(np.int64).max):
            bag.write_measurement(measurement)
    return done


def _by_stamp(source: StereoSource | None) -> Callable[[int], RawPair | None]:
    """Return a function that returns the pair of a source at a stamp, each later than the last."""
    pairs = iter(()) if source is None else source.raw_pairs()
    waiting: list[RawPair] = []

    def take(stamp_ns: int) -> RawPair | None:
        while not waiting or waiting[-1].stamp_ns < stamp_ns:
            pair = next(pairs, None)
            if pair is None:
                return None
            waiting[:] = [pair]
        return waiting[-1] if waiting[-1].stamp_ns == stamp_ns else None

    return take


class BagLibrary(Protocol):
    """A library that writes a rosbag2 folder of one mcap file. make: makes its messages."""

    make: Make

    def knows(self, kind: str) -> bool:
        """Whether messages of a type can be written."""

    def serialize(self, message: Any, kind: str) -> bytes | memoryview:
        """Return a message of a type in CDR."""

    def write(self, topic: str, kind: str, stamp_ns: int, data: bytes | memoryview) -> None:
        """Append a message in CDR."""

    def close(self, is_whole: bool) -> None:
        """Complete the bag, or give it up."""


OpenLibrary = Callable[[Path, bool], BagLibrary]
"""Opens a folder that is not there yet; whether its chunks are compressed."""

_ros_library: OpenLibrary | None = None


def write_rosbag2_with(open_library: OpenLibrary | None) -> None:
    """Have bags written by another library from now on; None: by rosbags again."""
    global _ros_library
    _ros_library = open_library


class Rosbags:
    """Writes by `rosbags`. Raises ImportError where that is not installed."""

    def __init__(self, folder: Path, compressed: bool) -> None:
        from rosbags import rosbag2
        from rosbags.typesys import Stores, get_typestore

        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._connections: dict[str, Any] = {}
        self._writer = rosbag2.Writer(folder, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
        if compressed:
            self._writer.set_compression(
                rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD
            )
        self._writer.open()

    def knows(self, kind: str) -> bool:
        """Whether it is a type of ROS 2 Jazzy."""
        return kind in self._store.types

    def make(self, kind: str, **fields: Any) -> Any:
        """Return a message of a type."""
        return self._store.types[kind](**fields)

    def serialize(self, message: Any, kind: str) -> bytes | memoryview:
        """Return a message of a type in CDR."""
        return self._store.serialize_cdr(message, kind)

    def write(self, topic: str, kind: str, stamp_ns: int, data: bytes | memoryview) -> None:
        """Append a message in CDR."""
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, kind, typestore=self._store
            )
        self._writer.write(self._connections[topic], stamp_ns, data)

    def close(self, is_whole: bool) -> None:
        """Complete the bag, or give it up."""
        (self._writer.close if is_whole else self._writer.abort)()


class NewBag:
    """A new bag of serialised messages: one file where its name ends in `.mcap`, else a rosbag2
    folder. compressed: in zstd chunks. bytes: of the messages so far.

    keeps: whether what is written stays, whatever ends the recording: it is at its final place from
    the first message on. Else the bag appears when it is complete, and after an error nothing is
    left. Raises InputError when `out` exists or cannot be written.
    """

    def __init__(self, out: Path, compressed: bool = False, keeps: bool = False) -> None:
        self._out = out
        self._keeps = keeps
        self._compressed = compressed
        self._stack = ExitStack()
        self._topics: set[str] = set()
        self.bytes = 0

    def __enter__(self) -> NewBag:
        out, is_file = self._out, self._out.suffix == '.mcap'
        if os.path.lexists(out):
            raise InputError(f'{out}: exists already; choose another name')
        try:
            with os_errors(f'{out}: cannot be written'):
                out.parent.mkdir(parents=True, exist_ok=True)
                self._folder = self._stack.enter_context(scratch_folder(out.parent)) / out.stem
                if self._keeps and not is_file:
                    self._folder = out
                self.library = (_ros_library or Rosbags)(self._folder, self._compressed)
                if is_file:
                    (self._file,) = self._folder.glob('*.mcap')
                    os.link(self._file, out)  # the same file by two names
                    if not self._keeps:
                        out.unlink()
        except ImportError:
            self._stack.close()
            raise InputError(f'{out}: {MISSING_LIBRARY}') from None
        except InputError:
            self._stack.close()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        out, is_file = self._out, self._out.suffix == '.mcap'
        is_whole = kind is None or (self._keeps and bool(self._topics))
        try:
            self.library.close(is_whole)
            if not is_whole and self._keeps:
                out.unlink() if is_file else shutil.rmtree(out)
            if is_whole and not self._keeps:
                (self._file if is_file else self._folder).rename(out)
        finally:
            self._stack.close()

    def knows(self, kind: str) -> bool:
        """Whether messages of a type can be written."""
        return self.library.knows(kind)

    def has(self, topic: str) -> bool:
        """Whether a message of a topic was written."""
        return topic in self._topics

    def write(self, topic: str, kind: str, stamp_ns: int, data: bytes | memoryview) -> None:
        """Append a message of a type, in CDR, recorded at stamp_ns."""
        self._topics.add(topic)
        self.library.write(topic, kind, stamp_ns, data)
        self.bytes += len(data)

    def is_disk_full(self, elapsed_s: float) -> bool:
        """Whether the space that is left is short for the next seconds, if messages go on to come
        as fast as in the seconds so far.
        """
        next_bytes = RESERVE_S * self.bytes / max(elapsed_s, 1.0)
        return shutil.disk_usage(self._folder).free < LEAST_FREE_BYTES + next_bytes


class BagWriter:
    """A new bag of stereo pairs."""

    def __init__(
        self,
        out: Path,
        calibration: StereoCalibration,
        coding: ImageCoding = ImageCoding.raw,
        keeps: bool = False,
    ) -> None:
        self.file = NewBag(out, coding is ImageCoding.raw, keeps)
        self._calibration = calibration
        self._coding = coding

        self._turn_imu = np.eye(3) if calibration.is_rectified else calibration.left.R.T

    def __enter__(self) -> BagWriter:
        self.file.__enter__()
        self._make = self.file.library.make
        return self

    def __exit__(self, *error: Any) -> None:
        self.file.__exit__(*error)

    def write(self, pair: RawPair) -> None:
        """Append one pair, recorded at its own stamp; of a depth camera, image and depth."""
        left, right = self._calibration.left, self._calibration.right
        self._write_image('left', pair.stamp_ns, FRAME_IDS[0], left, pair.left)
        if is_disparity(pair.right):
            self.write_depth(pair, self._calibration.camera.disparity_times_depth)
        else:
            self._write_image('right', pair.stamp_ns, FRAME_IDS[1], right, pair.right)

    def _write_image(
        self, side: str, stamp_ns: int, frame_id: str, eye: EyeCalibration, image: NDArray[np.uint8]
    ) -> None:
        info = camera_info_message(stamp_ns, frame_id, eye, self._make)
        self._write(f'/{side}/camera_info', CAMERA_INFO, stamp_ns, info)
        topic = f'/{side}/image_rect' if self._calibration.is_rectified else f'/{side}/image_raw'
        if self._coding is ImageCoding.raw:
            message = image_message(stamp_ns, frame_id, image, make=self._make)
            self._write(topic, IMAGE, stamp_ns, message)
        else:
            quality = JPEG_QUALITY if self._coding is ImageCoding.jpeg else None
            message = compressed_message(stamp_ns, frame_id, image, quality, self._make)
            self._write(f'{topic}/compressed', COMPRESSED, stamp_ns, message)

    def write_depth(self, pair: RawPair, disparity_times_depth: float) -> None:
        """Append the depths of a pair whose right image is a disparity (H, W)."""
        with np.errstate(divide='ignore'):
            depth_m = np.float32(disparity_times_depth) / pair.right
        image = depth_m.astype(np.float32)
        message = image_message(pair.stamp_ns, FRAME_IDS[0], image, make=self._make)
        self._write(DEPTH_TOPIC, IMAGE, pair.stamp_ns, message)

    def write_measurement(self, measurement: Measurement) -> None:
        """Append what wheels or an IMU measured, the latter in the raw left optical frame."""
        stamp_ns = measurement.stamp_ns
        if isinstance(measurement, WheelPose):
            odometry = wheel_message(measurement, 'base_link', np.zeros(6), self._make)
            self._write(WHEELS_TOPIC, ODOMETRY, stamp_ns, odometry)
        elif isinstance(measurement, ImuSample):
            frame_id = self._imu_frame(measurement)
            imu = imu_message(measurement, frame_id, self._turn_imu, self._make)
            self._write(IMU_TOPIC, IMU, stamp_ns, imu)

    def _imu_frame(self, sample: ImuSample) -> str:
        """Return the frame of an IMU, which is written before its first sample."""
        if not sample.place_m.any():
            return FRAME_IDS[0]
        if not self.file.has(TF_TOPIC):
            T_raw_imu = make_transform(np.eye(3), self._turn_imu @ sample.place_m)
            link = transform_message(0, FRAME_IDS[0], IMU_FRAME, T_raw_imu, self._make)
            transforms = self._make(TF, transforms=[link])
            self._write(TF_TOPIC, TF, sample.stamp_ns, transforms)
        return IMU_FRAME

    def _write(self, topic: str, kind: str, stamp_ns: int, message: Any) -> None:
        self.file.write(topic, kind, stamp_ns, self.file.library.serialize(message, kind))
