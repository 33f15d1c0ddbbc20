"""Writing stereo pairs to rosbag2 (mcap), by `rosbags`, without a ROS install."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable
from enum import Enum
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.calibration import EyeCalibration, StereoCalibration
from segfloor_ros.camera.sources.bag_file import MISSING_LIBRARY
from segfloor_ros.camera.sources.bag_topics import CAMERA_INFO, COMPRESSED, IMAGE
from segfloor_ros.camera.sources.source import RawPair, StereoSource
from segfloor_ros.errors import InputError

SIDES = ('left', 'right')
FRAME_IDS = ('left_camera_optical_frame', 'right_camera_optical_frame')
ENCODER_OPTIONS = {
    'png': ('.png', [cv2.IMWRITE_PNG_COMPRESSION, 3]),
    'jpeg': ('.jpg', [cv2.IMWRITE_JPEG_QUALITY, 90]),
}


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
) -> int:
    """Write every pair of a source to a new bag and return how many there were.

    The grey pairs are written as the camera saw them, with the calibration to rectify them, to
    `/left/image_raw` and `/right/image_raw`, or `image_rect` where they are rectified already.
    on_progress is told the number of pairs done. Raises InputError.
    """
    done = 0
    with BagWriter(out, source.calibration, coding) as bag:
        for pair in source.raw_pairs():
            bag.write(pair)
            done += 1
            on_progress(done)
    return done


class BagWriter:
    """A new bag of stereo pairs: one file where its name ends in `.mcap`, else a rosbag2 folder.

    It appears when it is complete; after an error nothing is left. Raises InputError when `out`
    exists or cannot be written.
    """

    def __init__(
        self, out: Path, calibration: StereoCalibration, coding: ImageCoding = ImageCoding.raw
    ) -> None:
        self._out = out
        self._calibration = calibration
        self._coding = coding
        self._staging = Path()
        self._writer: Any = None
        self._typestore: Any = None
        self._connections: dict[tuple[str, str], Any] = {}

    def __enter__(self) -> BagWriter:
        if self._out.exists():
            raise InputError(f'{self._out}: exists already; remove it or choose another name')
        try:
            from rosbags import rosbag2
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            raise InputError(f'{self._out}: {MISSING_LIBRARY}') from None
        try:
            self._out.parent.mkdir(parents=True, exist_ok=True)
            self._staging = Path(tempfile.mkdtemp(prefix='.bag-', dir=self._out.parent))
        except OSError as error:
            raise InputError(f'{self._out}: cannot be written ({error.strerror})') from None
        self._typestore = get_typestore(Stores.ROS2_JAZZY)
        self._writer = rosbag2.Writer(
            self._staging / self._out.stem, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP
        )
        if self._coding is ImageCoding.raw:
            self._writer.set_compression(
                rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD
            )
        self._writer.open()
        self._add_topics()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            if kind is not None:
                self._writer.abort()
                return
            self._writer.close()
            bag = self._staging / self._out.stem
            if self._out.suffix == '.mcap':
                bag = bag / f'{self._out.stem}.mcap'
            bag.rename(self._out)
        finally:
            shutil.rmtree(self._staging, ignore_errors=True)

    def write(self, pair: RawPair) -> None:
        """Append one pair, recorded at its own stamp."""
        eyes = (self._calibration.left, self._calibration.right)
        for side, frame_id, eye, image in zip(
            SIDES, FRAME_IDS, eyes, (pair.left, pair.right), strict=True
        ):
            header = self._header(pair.stamp_ns, frame_id)
            self._write(side, 'info', pair.stamp_ns, self._info_message(header, eye))
            self._write(side, 'image', pair.stamp_ns, self._image_message(header, image))

    def _add_topics(self) -> None:
        image_type, suffix = (
            (IMAGE, '') if self._coding is ImageCoding.raw else (COMPRESSED, '/compressed')
        )
        image = 'image_rect' if self._calibration.is_rectified else 'image_raw'
        topics = (('image', f'{image}{suffix}', image_type), ('info', 'camera_info', CAMERA_INFO))
        for side in SIDES:
            for what, name, msgtype in topics:
                self._connections[side, what] = self._writer.add_connection(
                    f'/{side}/{name}', msgtype, typestore=self._typestore
                )

    def _write(self, side: str, what: str, stamp_ns: int, message: Any) -> None:
        connection = self._connections[side, what]
        data = self._typestore.serialize_cdr(message, connection.msgtype)
        self._writer.write(connection, stamp_ns, data)

    def _header(self, stamp_ns: int, frame_id: str) -> Any:
        types = self._typestore.types
        sec, nanosec = divmod(stamp_ns, 1_000_000_000)
        stamp = types['builtin_interfaces/msg/Time'](sec=sec, nanosec=nanosec)
        return types['std_msgs/msg/Header'](stamp=stamp, frame_id=frame_id)

    def _image_message(self, header: Any, image: NDArray[np.uint8]) -> Any:
        types = self._typestore.types
        pixels = np.ascontiguousarray(image)
        if self._coding is not ImageCoding.raw:
            suffix, options = ENCODER_OPTIONS[self._coding.value]
            _, data = cv2.imencode(suffix, pixels, options)
            words = f'mono8; {self._coding.value} compressed mono8'
            return types[COMPRESSED](header=header, format=words, data=data.ravel())
        height, width = pixels.shape
        return types[IMAGE](
            header=header,
            height=height,
            width=width,
            encoding='mono8',
            is_bigendian=0,
            step=width,
            data=pixels.ravel(),
        )

    def _info_message(self, header: Any, eye: EyeCalibration) -> Any:
        types = self._typestore.types
        whole_image = types['sensor_msgs/msg/RegionOfInterest'](0, 0, 0, 0, False)
        return types[CAMERA_INFO](
            header=header,
            height=eye.height,
            width=eye.width,
            distortion_model=eye.distortion_model,
            d=eye.D,
            k=eye.K.ravel(),
            r=eye.R.ravel(),
            p=eye.P.ravel(),
            binning_x=0,
            binning_y=0,
            roi=whole_image,
        )
