"""ROS bags as a source of stereo pairs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from segfloor_ros.camera.calibration import EyeCalibration, StereoCalibration
from segfloor_ros.camera.calibration_files import read_eye_calibration
from segfloor_ros.camera.depth import depth_calibration, disparity_of_depth
from segfloor_ros.camera.images import (
    CorruptImageError,
    Grey,
    decode_compressed,
    decode_depth,
    decode_raw,
)
from segfloor_ros.camera.settings import StereoCameraSettings
from segfloor_ros.camera.sources.bag_file import BagFile, open_bag_file
from segfloor_ros.camera.sources.bag_sensors import bag_sensors, stamp_ns
from segfloor_ros.camera.sources.bag_topics import (
    StereoTopics,
    find_depth_topics,
    find_topics,
    has_pair,
)
from segfloor_ros.camera.sources.found_calibration import given_calibration
from segfloor_ros.camera.sources.pairing import Stamped, StampPairing
from segfloor_ros.camera.sources.sensor_files import DEPTH
from segfloor_ros.camera.sources.source import PairEntry, StereoSource
from segfloor_ros.camera.sources.stamps import rate_of
from segfloor_ros.errors import CalibrationError, InputError
from segfloor_ros.measurements import RecordedSensor

STAMPS_FOR_RATE = 20


def open_bag(path: Path, settings: StereoCameraSettings) -> BagSource:
    """Open a bag: find its stereo topics and their calibration. Raises InputError or
    CalibrationError.
    """
    with open_bag_file(path) as bag:
        types = {name: topic.msgtype for name, topic in bag.topics.items() if topic.num_messages}
        if not types:
            raise InputError(f'{path}: the bag is empty; record the image topics again')
        depth = find_depth_topics(str(path), types, settings)
        if depth is not None and (settings.depth or not has_pair(types, settings)):
            topics = depth
            calibration = depth_calibration(_left_eye(path, bag, topics, settings))
        else:
            topics = find_topics(
                str(path), types, settings.left_image_topic, settings.right_image_topic
            )
            calibration = given_calibration(settings) or _read_calibration(path, bag, topics)
        count = min(bag.topics[topic].num_messages for topic in (topics.left, topics.right))
        first = islice(bag.messages([topics.left]), STAMPS_FOR_RATE)
        rate_hz = rate_of(sorted(stamp_ns(message) for _, message in first))
        if topics.is_rectified:
            calibration = calibration.rectified()
        sensors = bag_sensors(path, bag, topics.left, calibration.left.R, settings)
        if depth is not None:
            messages = bag.topics[depth.right].num_messages
            sensors.append(RecordedSensor(DEPTH, depth.right, messages, topics is depth))
    return BagSource(path, topics, calibration, count, rate_hz, settings, sensors)


class BagSource(StereoSource):
    """The images of two topics, paired by their header stamps while they are read."""

    def __init__(
        self,
        path: Path,
        topics: StereoTopics,
        calibration: StereoCalibration,
        count: int,
        rate_hz: float,
        settings: StereoCameraSettings,
        sensors: Sequence[RecordedSensor] = (),
    ) -> None:
        self._path = path
        self._topics = topics
        self._tolerance_s = settings.pairing_tolerance_s
        super().__init__(
            str(path),
            calibration,
            frame_count=count,
            rate_hz=rate_hz,
            bit_depth=settings.bit_depth,
            sensors=sensors,
        )

    def _entries(self) -> Iterator[PairEntry]:
        pairing: StampPairing[Any] = StampPairing(
            self._tolerance_s,
            (f'{self._path}, {self._topics.left}', f'{self._path}, {self._topics.right}'),
        )
        with open_bag_file(self._path) as bag:
            for index, (left, right) in enumerate(self._pairs(bag, pairing)):
                yield PairEntry(index, left.stamp_ns, self._loader(left.item, right.item))
        self.skipped_frames += max(pairing.duplicates)
        pairing.report()

    def _pairs(
        self, bag: BagFile, pairing: StampPairing[Any]
    ) -> Iterator[tuple[Stamped[Any], Stamped[Any]]]:
        sides = {self._topics.left: 0, self._topics.right: 1}
        for topic, message in bag.messages(list(sides)):
            yield from pairing.add(sides[topic], stamp_ns(message), message)
        yield from pairing.finish()

    def _loader(self, left: Any, right: Any) -> Callable[[], tuple[Grey, NDArray[Any]]]:
        topics = self._topics
        if topics.right_is_depth:
            return lambda: (
                _decode(topics.left, left),
                disparity_of_depth(_decode(topics.right, right, decode_depth), self.camera),
            )
        return lambda: (_decode(topics.left, left), _decode(topics.right, right))


def _decode(
    topic: str, message: Any, decode: Callable[..., NDArray[Any]] = decode_raw
) -> NDArray[Any]:
    try:
        if hasattr(message, 'encoding'):
            return decode(
                message.data,
                width=message.width,
                height=message.height,
                encoding=message.encoding,
                step=message.step,
                is_bigendian=bool(message.is_bigendian),
            )
        return decode_compressed(message.data.tobytes())
    except CorruptImageError as error:
        raise CorruptImageError(f'{topic}: {error}') from None
    except InputError as error:
        raise InputError(f'{topic}: {error}') from None


def _read_calibration(path: Path, bag: BagFile, topics: StereoTopics) -> StereoCalibration:
    for side, info in (('left', topics.left_info), ('right', topics.right_info)):
        if not info:
            raise CalibrationError(
                f'{path}: no CameraInfo beside {getattr(topics, side)}; record it too, or give '
                'stereo_camera.left_calibration and right_calibration'
            )
    eyes = [_eye(path, bag, topic) for topic in (topics.left_info, topics.right_info)]
    return StereoCalibration(*eyes)


def _left_eye(
    path: Path, bag: BagFile, topics: StereoTopics, settings: StereoCameraSettings
) -> EyeCalibration:
    if settings.left_calibration:
        return read_eye_calibration(Path(settings.left_calibration))
    if not topics.left_info:
        raise CalibrationError(
            f'{path}: no CameraInfo beside {topics.left}; record it too, or give '
            'stereo_camera.left_calibration'
        )
    return _eye(path, bag, topics.left_info)


def _eye(path: Path, bag: BagFile, topic: str) -> EyeCalibration:
    _, info = next(bag.messages([topic]))
    # ROS 1 names the matrices in capitals, ROS 2 does not.
    D, K, R, P = (getattr(info, n if hasattr(info, n) else n.lower()) for n in 'DKRP')
    return EyeCalibration(
        int(info.width), int(info.height), K, D, R, P, info.distortion_model, f'{path}, {topic}'
    )
