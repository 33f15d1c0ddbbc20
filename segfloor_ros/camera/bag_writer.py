"""Writing stereo pairs to rosbag2 (mcap), by `rosbags`, without a ROS install."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Mapping
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
JPEG_QUALITY = 90


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

    It appears when it is complete; after an error nothing is left. jpeg_quality: 1 to 100. Raises
    InputError when `out` exists or cannot be written.
    """

    def __init__(
        self,
        out: Path,
        calibration: StereoCalibration,
        coding: ImageCoding = ImageCoding.raw,
        jpeg_quality: int = JPEG_QUALITY,
    ) -> None:
        self._out = out
        self._calibration = calibration
        self._coding = coding
        self._encoders: dict[ImageCoding, tuple[str, list[int]]] = {
            ImageCoding.png: ('.png', [cv2.IMWRITE_PNG_COMPRESSION, 3]),
            ImageCoding.jpeg: ('.jpg', [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality]),
        }
        self._staging = Path()
        self._writer: Any = None
        self._typestore: Any = None
        self._connections: dict[str, Any] = {}

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
        self._add_image_topics()
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

    @property
    def types(self) -> Mapping[str, Any]:
        """The classes of Jazzy's messages by name, e.g. `nav_msgs/msg/Odometry`."""
        types: Mapping[str, Any] = self._typestore.types
        return types

    def add_topic(self, name: str, message_type: str) -> None:
        """Add a topic to which `write_message` can write."""
        self._connections[name] = self._writer.add_connection(
            name, message_type, typestore=self._typestore
        )

    def write(self, pair: RawPair) -> None:
        """Append one pair, recorded at its own stamp."""
        eyes = (self._calibration.left, self._calibration.right)
        for side, frame_id, eye, image in zip(
            SIDES, FRAME_IDS, eyes, (pair.left, pair.right), strict=True
        ):
            header = self.header(pair.stamp_ns, frame_id)
            self.write_message(
                f'/{side}/camera_info', pair.stamp_ns, self._info_message(header, eye)
            )
            self.write_message(
                self._image_topic(side),
                pair.stamp_ns,
                self._picture_message(pair.stamp_ns, frame_id, image),
            )

    def write_message(self, topic: str, stamp_ns: int, message: Any) -> None:
        """Append a message of one of `types` to a topic, recorded at stamp_ns."""
        connection = self._connections[topic]
        data = self._typestore.serialize_cdr(message, connection.msgtype)
        self._writer.write(connection, stamp_ns, data)

    def header(self, stamp_ns: int, frame_id: str) -> Any:
        """Return a std_msgs/Header."""
        sec, nanosec = divmod(stamp_ns, 1_000_000_000)
        stamp = self.types['builtin_interfaces/msg/Time'](sec=sec, nanosec=nanosec)
        return self.types['std_msgs/msg/Header'](stamp=stamp, frame_id=frame_id)

    def _add_image_topics(self) -> None:
        kind = IMAGE if self._coding is ImageCoding.raw else COMPRESSED
        for side in SIDES:
            self.add_topic(self._image_topic(side), kind)
            self.add_topic(f'/{side}/camera_info', CAMERA_INFO)

    def _image_topic(self, side: str) -> str:
        image = 'image_rect' if self._calibration.is_rectified else 'image_raw'
        suffix = '' if self._coding is ImageCoding.raw else '/compressed'
        return f'/{side}/{image}{suffix}'

    def image_message(
        self, stamp_ns: int, image: NDArray[Any], encoding: str, frame_id: str = FRAME_IDS[0]
    ) -> Any:
        """Return a sensor_msgs/Image of an image (H, W) of one channel."""
        pixels = np.ascontiguousarray(image)
        height, width = pixels.shape
        return self.types[IMAGE](
            header=self.header(stamp_ns, frame_id),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=0,
            step=width * pixels.itemsize,
            data=pixels.ravel().view(np.uint8),
        )

    def _picture_message(self, stamp_ns: int, frame_id: str, image: NDArray[np.uint8]) -> Any:
        if self._coding is ImageCoding.raw:
            return self.image_message(stamp_ns, image, 'mono8', frame_id)
        suffix, options = self._encoders[self._coding]
        _, data = cv2.imencode(suffix, np.ascontiguousarray(image), options)
        words = f'mono8; {self._coding.value} compressed mono8'
        header = self.header(stamp_ns, frame_id)
        return self.types[COMPRESSED](header=header, format=words, data=data.ravel())

    def _info_message(self, header: Any, eye: EyeCalibration) -> Any:
        whole_image = self.types['sensor_msgs/msg/RegionOfInterest'](0, 0, 0, 0, False)
        return self.types[CAMERA_INFO](
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
