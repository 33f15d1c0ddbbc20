"""ROS bags as a source of stereo pairs."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from segfloor_ros.camera.calibration.files import given_calibration, given_left_calibration
from segfloor_ros.camera.calibration.parameters import EyeCalibration, StereoCalibration
from segfloor_ros.camera.depth import depth_calibration, disparity_of_depth
from segfloor_ros.camera.images import Grey, depth_image, grey_image
from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.camera.ros_messages import eye_calibration, stamp_ns
from segfloor_ros.camera.settings import StereoCameraSettings
from segfloor_ros.camera.sources import bag_file as bag_topics
from segfloor_ros.camera.sources.bag_file import BagFile, open_bag_file
from segfloor_ros.camera.sources.bag_sensors import bag_sensors
from segfloor_ros.camera.sources.pairing import Stamped, StampPairing, rate_of
from segfloor_ros.camera.sources.sensor_files import DEPTH, check_shared_clock
from segfloor_ros.camera.sources.source import PairEntry, StereoSource
from segfloor_ros.errors import CalibrationError, InputError
from segfloor_ros.files.whole import checked_ns
from segfloor_ros.measurements import RecordedSensor

STAMPS_FOR_RATE = 20


def open_bag(path: Path, settings: StereoCameraSettings) -> StereoSource:
    """Open a bag: find its stereo topics and their calibration. Raises InputError or
    CalibrationError.
    """
    with open_bag_file(path) as bag:
        types = {name: topic.msgtype for name, topic in bag.topics.items() if topic.num_messages}
        if not types:
            raise InputError(f'{path}: the bag is empty; record the image topics again')
        depth = bag_topics.find_depth_topics(str(path), types, settings)
        if depth is not None and (settings.depth or not bag_topics.has_pair(types, settings)):
            topics = depth
            calibration = depth_calibration(_left_eye(path, bag, topics, settings))
        else:
            topics = bag_topics.find_topics(
                str(path), types, settings.left_image_topic, settings.right_image_topic
            )
            calibration = given_calibration(settings) or _read_calibration(path, bag, topics)
        count = min(bag.topics[topic].num_messages for topic in (topics.left, topics.right))
        first = islice(bag.messages([topics.left]), STAMPS_FOR_RATE)
        stamps = sorted(_stamp_ns(message, f'{path}, {topics.left}') for _, message in first)
        rate_hz = rate_of(stamps)
        if topics.is_rectified:
            calibration = calibration.rectified()
        sensors = bag_sensors(path, bag, topics.left, calibration.left.R, settings)
        if stamps:
            # The end is not known before all images are read; half of them may be missing.
            check_shared_clock(sensors, [stamps[0], stamps[0] + round(2e9 * count / rate_hz)])
        if depth is not None:
            messages = bag.topics[depth.right].num_messages
            sensors.append(RecordedSensor(DEPTH, depth.right, messages, topics is depth))
    read = partial(_entries, path, topics, calibration.camera, settings.pairing_tolerance_s)
    return StereoSource(
        str(path),
        calibration,
        read,
        frame_count=count,
        rate_hz=rate_hz,
        bit_depth=settings.bit_depth,
        sensors=sensors,
    )


def _entries(
    path: Path,
    topics: bag_topics.StereoTopics,
    camera: StereoCamera,
    tolerance_s: float,
    source: StereoSource,
) -> Iterator[PairEntry]:
    """Yield the images of two topics, paired by their header stamps while they are read."""

    def pairs(bag: BagFile) -> Iterator[tuple[Stamped[Any], Stamped[Any]]]:
        sides = {topics.left: 0, topics.right: 1}
        for topic, message in bag.messages(list(sides)):
            stamp = _stamp_ns(message, f'{path}, {topic}')
            yield from pairing.add(sides[topic], stamp, message)
        yield from pairing.finish()

    def load(left: Any, right: Any) -> tuple[Grey, NDArray[Any]]:
        image = grey_image(left, topics.left)
        if topics.right_is_depth:
            return image, disparity_of_depth(depth_image(right, topics.right), camera)
        return image, grey_image(right, topics.right)

    names = (f'{path}, {topics.left}', f'{path}, {topics.right}')
    pairing: StampPairing[Any] = StampPairing(tolerance_s, names)
    with open_bag_file(path) as bag:
        for index, (left, right) in enumerate(pairs(bag)):
            yield PairEntry(index, left.stamp_ns, partial(load, left.item, right.item))
    source.skipped_frames += max(pairing.duplicates)
    pairing.report()


def _stamp_ns(message: Any, where: str) -> int:
    try:
        return checked_ns(stamp_ns(message), f'{stamp_ns(message)} ns')
    except ValueError as error:
        raise InputError(
            f'{where}: an image has the stamp {stamp_ns(message)} ns {error}'
        ) from None


def _read_calibration(
    path: Path, bag: BagFile, topics: bag_topics.StereoTopics
) -> StereoCalibration:
    given = 'stereo_camera.left_calibration and right_calibration'
    left = _eye(path, bag, topics.left, topics.left_info, given)
    return StereoCalibration(left, _eye(path, bag, topics.right, topics.right_info, given))


def _left_eye(
    path: Path, bag: BagFile, topics: bag_topics.StereoTopics, settings: StereoCameraSettings
) -> EyeCalibration:
    given = given_left_calibration(settings)
    if given is not None:
        return given
    return _eye(path, bag, topics.left, topics.left_info, 'stereo_camera.left_calibration')


def _eye(path: Path, bag: BagFile, image: str, topic: str, setting: str) -> EyeCalibration:
    if not topic:
        raise CalibrationError(
            f'{path}: no CameraInfo beside {image}; record it too, or give {setting}'
        )
    return eye_calibration(bag.first(topic), f'{path}, {topic}')
