"""ROS bags as a source of stereo pairs, wheel odometry and IMU samples."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache, partial
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import segfloor_ros.apps.recordings.bag_file as bag_topics
from segfloor_ros.apps.recordings.bag_file import BagFile, check_given, open_bag_file
from segfloor_ros.apps.recordings.calibration_files import given_calibration, given_left_calibration
from segfloor_ros.apps.recordings.files import (
    DEPTH,
    IMU,
    WHEEL_ODOMETRY,
    check_gravity,
    check_shared_clock,
    rate_of,
)
from segfloor_ros.apps.recordings.source import PairEntry, StampPairing, StereoSource
from segfloor_ros.core.camera.calibration import EyeCalibration, StereoCalibration
from segfloor_ros.core.camera.camera_info import eye_calibration
from segfloor_ros.core.camera.depth import depth_calibration, disparity_of_depth
from segfloor_ros.core.camera.images import Grey, colour_image, depth_image, grey_image
from segfloor_ros.core.camera.measurements import (
    imu_sample,
    is_upright,
    measures_motion,
    rigid_motion,
    stamp_ns,
    wheel_pose,
    xyz,
)
from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.camera.recording import RecordedSensor
from segfloor_ros.core.camera.settings import StereoCameraSettings
from segfloor_ros.core.contracts import Measurement, WheelPose
from segfloor_ros.core.errors import CalibrationError, InputError
from segfloor_ros.core.files.whole import checked_ns
from segfloor_ros.core.geometry import Array, make_transform
from segfloor_ros.nodes.frame_tree import FrameTree
from segfloor_ros.nodes.shared.joining import Stamped

FIRST_MESSAGES = 50
"""Of a topic: enough for its rate, or for gravity."""

ODOMETRY_TYPE, IMU_TYPE = 'nav_msgs/msg/Odometry', 'sensor_msgs/msg/Imu'
TF_TYPE, STATIC_TF = 'tf2_msgs/msg/TFMessage', '/tf_static'
NOT_WHEELS = ('truth', 'visual', 'vio', 'slam', 'keyframe', 'lidar', 'laser', 'icp', 'gps', 'map')
"""Words in the names of odometry that is not the wheels'."""

logger = logging.getLogger(__name__)

GLOBAL_FRAMES = ('map', 'world', 'earth')
"""Frames that wheels know nothing of."""


def open_bag(path: Path, settings: StereoCameraSettings) -> StereoSource:
    """Open a bag: find its stereo topics and their calibration. Raises InputError or
    CalibrationError.
    """
    with open_bag_file(path) as bag:
        types = {name: topic.msgtype for name, topic in bag.topics.items() if topic.num_messages}
        if not types:
            raise InputError(f'{path}: the bag is empty; record the image topics again')
        topics, depth = _image_topics(path, types, settings)
        if topics.right_is_depth:
            calibration = depth_calibration(_left_eye(path, bag, topics, settings))
        else:
            given = given_calibration(settings, topics.is_rectified)
            calibration = given or _read_calibration(path, bag, topics)
        count = min(bag.topics[topic].num_messages for topic in (topics.left, topics.right))
        stamps, _ = (_first_stamps(path, bag, topic) for topic in (topics.left, topics.right))
        rate_hz = rate_of(stamps)
        sensors = bag_sensors(path, bag, topics.left, calibration.left.R, settings)
        if stamps:
            # The end is not known before all images are read; half of them may be missing.
            check_shared_clock(sensors, [stamps[0], stamps[0] + round(2e9 * count / rate_hz)])
        if depth is not None:
            messages = bag.topics[depth.right].num_messages
            sensors.append(RecordedSensor(DEPTH, depth.right, messages, topics is depth))
    read = partial(_entries, path, topics, calibration.camera, settings)
    return StereoSource(
        str(path), calibration, read, frame_count=count, rate_hz=rate_hz, sensors=sensors
    )


def _image_topics(
    path: Path, types: dict[str, str], settings: StereoCameraSettings
) -> tuple[bag_topics.StereoTopics, bag_topics.StereoTopics | None]:
    """Return the topics that are read, and those with depth images, where there are any."""
    depth = bag_topics.find_depth_topics(str(path), types, settings)
    if depth is not None and (settings.depth or not bag_topics.has_pair(types, settings)):
        return depth, depth
    left, right = settings.left_image_topic, settings.right_image_topic
    return bag_topics.find_topics(str(path), types, left, right), depth


def _entries(
    path: Path,
    topics: bag_topics.StereoTopics,
    camera: StereoCamera,
    settings: StereoCameraSettings,
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
        image = (colour_image if source.takes_colour else grey_image)(left, topics.left)
        if topics.right_is_depth:
            depth = depth_image(right, topics.right)
            return image, disparity_of_depth(depth, camera, settings.depth_scale or None)
        return image, grey_image(right, topics.right)

    names = (f'{path}, {topics.left}', f'{path}, {topics.right}')
    pairing: StampPairing[Any] = StampPairing(settings.pairing_tolerance_s, names)
    with open_bag_file(path) as bag:
        for index, (left, right) in enumerate(pairs(bag)):
            yield PairEntry(index, left.stamp_ns, partial(load, left.item, right.item))
    source.skipped_frames += max(pairing.duplicates)
    pairing.report()


def _first_stamps(path: Path, bag: BagFile, topic: str) -> list[int]:
    """Return the stamps of the first images of a topic in order. Raises InputError where they are
    all zero.
    """
    where, first = f'{path}, {topic}', islice(bag.messages([topic]), FIRST_MESSAGES)
    stamps = sorted(_stamp_ns(message, where) for _, message in first)
    if len(stamps) > 1 and not any(stamps):
        raise InputError(
            f'{where}: all stamps are zero, so no image has a time; let the driver stamp its '
            'images and record again'
        )
    return stamps


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
    sides = (topics.left, topics.left_info), (topics.right, topics.right_info)
    eyes = (_eye(path, bag, *side, given, topics.is_rectified) for side in sides)
    return StereoCalibration(*eyes)


def _left_eye(
    path: Path, bag: BagFile, topics: bag_topics.StereoTopics, settings: StereoCameraSettings
) -> EyeCalibration:
    given = given_left_calibration(settings)
    if given is not None:
        return given.rectified() if topics.is_rectified else given
    setting = 'stereo_camera.left_calibration'
    return _eye(path, bag, topics.left, topics.left_info, setting, topics.is_rectified)


def _eye(
    path: Path, bag: BagFile, image: str, topic: str, setting: str, is_rectified: bool
) -> EyeCalibration:
    if not topic:
        raise CalibrationError(
            f'{path}: no CameraInfo beside {image}; record it too, or give {setting}'
        )
    return eye_calibration(bag.first(topic), f'{path}, {topic}', is_rectified)


def bag_sensors(
    path: Path, bag: BagFile, left_topic: str, R_left_raw: Array, settings: StereoCameraSettings
) -> list[RecordedSensor]:
    """Return the sensors of a bag. R_left_raw: (3, 3) from the frame of the images on `left_topic`
    to the rectified left one. Raises InputError.
    """
    found = []
    used = {name: name not in settings.ignored_sensors for name in (WHEEL_ODOMETRY, IMU)}
    if wheels := _wheel_topic(path, bag, settings.wheel_odometry_topic):
        count = bag.topics[wheels].num_messages
        read_wheels = cache(lambda: list(_wheel_poses(path, wheels)))
        found.append(
            RecordedSensor(WHEEL_ODOMETRY, wheels, count, used[WHEEL_ODOMETRY], read_wheels)
        )
    if imu := _imu_topic(path, bag, settings.imu_topic):
        count, where = bag.topics[imu].num_messages, imu
        T_raw_imu = _T_raw_imu(bag, left_topic, imu) if used[IMU] else np.eye(4)
        if T_raw_imu is None:
            where = f'{imu} (no tf from its frame to the camera)'
            used[IMU], T_raw_imu = False, np.eye(4)
        T_left_imu = make_transform(R_left_raw, np.zeros(3)) @ T_raw_imu
        read_imu = cache(lambda: _imu_samples(path, imu, T_left_imu))
        found.append(RecordedSensor(IMU, where, count, used[IMU], read_imu))
    return found


def _wheel_topic(path: Path, bag: BagFile, given: str) -> str:
    topics = _topics(path, bag, ODOMETRY_TYPE, given, 'wheel_odometry_topic')
    if given:
        return given
    candidates = [
        topic
        for topic in topics
        if f'{topic.rpartition("/")[0]}/keyframe/odometry' not in topics  # of SLAM
        and not any(word in topic.lower() for word in NOT_WHEELS)
        and _frame_of(bag, topic) not in GLOBAL_FRAMES
    ]
    return min(candidates, key=lambda t: ('wheel' not in t, 'filtered' in t, t), default='')


def _imu_topic(path: Path, bag: BagFile, given: str) -> str:
    topics = _topics(path, bag, IMU_TYPE, given, 'imu_topic')
    if given:
        return given
    complete = [topic for topic in topics if measures_motion(bag.first(topic))]
    return max(complete, key=lambda t: (bag.topics[t].num_messages, t), default='')


def _topics(path: Path, bag: BagFile, kind: str, given: str, setting: str) -> list[str]:
    found = (t for t, topic in bag.topics.items() if topic.msgtype == kind and topic.num_messages)
    topics = sorted(found)
    check_given(str(path), given, topics, f'messages of type {kind}', setting)
    return topics


def _T_raw_imu(bag: BagFile, left_topic: str, imu_topic: str) -> Array | None:
    """Return the IMU's frame in that of the left images (4, 4), by the fixed transforms of the bag.
    Without any, an IMU for which up is up in the image is taken for one in the frame of the images;
    None for others.
    """
    left, imu = _frame_of(bag, left_topic), _frame_of(bag, imu_topic)
    if left == imu:
        return np.eye(4)
    T_left_imu = _fixed_transforms(bag).lookup(left, imu)
    if T_left_imu is not None:
        return T_left_imu
    some = islice(bag.messages([imu_topic]), FIRST_MESSAGES)
    accel_m_s2 = np.nanmedian([xyz(message.linear_acceleration) for _, message in some], axis=0)
    return np.eye(4) if is_upright(accel_m_s2) else None


def _frame_of(bag: BagFile, topic: str) -> str:
    return str(bag.first(topic).header.frame_id.strip('/'))


def _fixed_transforms(bag: BagFile) -> FrameTree:
    tree = FrameTree()
    for topic, info in bag.topics.items():
        if info.msgtype != TF_TYPE or not topic.endswith(STATIC_TF):
            continue
        for _, message in bag.messages([topic]):
            for transform in message.transforms:
                parent, child = transform.header.frame_id, transform.child_frame_id
                moved = transform.transform
                pose = rigid_motion(moved.translation, moved.rotation, topic)
                tree.add_fixed(parent.strip('/'), child.strip('/'), pose)
    return tree


def _wheel_poses(path: Path, topic: str) -> Iterator[WheelPose]:
    with _messages(path, topic) as messages:
        yield from (wheel_pose(message, f'{path}, {topic}') for message in messages)


def odometry_path(
    path: Path, topic: str, settings: StereoCameraSettings
) -> tuple[NDArray[np.int64], Array, Array]:
    """Return stamps (N,) in ns, ascending, and poses (N, 4, 4) of an Odometry topic, and the frame
    of the left images in that of its child (4, 4), by the fixed transforms of the bag; without any
    both are taken for one. Raises InputError.
    """
    with open_bag_file(path) as bag:
        types = {name: one.msgtype for name, one in bag.topics.items() if one.num_messages}
        if types.get(topic) != ODOMETRY_TYPE:
            found = sorted(name for name, kind in types.items() if kind == ODOMETRY_TYPE)
            raise InputError(
                f'{path}: no Odometry on {topic}; it has {", ".join(found) or "none at all"}'
            )
        child = str(bag.first(topic).child_frame_id).strip('/')
        left = _frame_of(bag, _image_topics(path, types, settings)[0].left)
        T_child_left = _fixed_transforms(bag).lookup(child, left)
    if T_child_left is None:
        logger.warning(
            '%s: no fixed transform from %s to %s; the poses of %s are written as those of the '
            'camera', path, child or 'the base', left, topic,
        )  # fmt: skip
    by_stamp = {one.stamp_ns: one.T_wheels_base for one in _wheel_poses(path, topic)}
    stamps = sorted(ns for ns, pose in by_stamp.items() if np.isfinite(pose).all())
    poses = np.array([by_stamp[ns] for ns in stamps]).reshape(-1, 4, 4)
    T = np.eye(4) if T_child_left is None else T_child_left
    return np.array(stamps, np.int64), poses, T


def _imu_samples(path: Path, topic: str, T_left_imu: Array) -> Sequence[Measurement]:
    with _messages(path, topic) as messages:
        samples = [imu_sample(message, T_left_imu) for message in messages]
    check_gravity(f'{path}, {topic}', np.array([sample.accel_m_s2 for sample in samples]))
    return samples


@contextmanager
def _messages(path: Path, topic: str) -> Iterator[Iterator[Any]]:
    with open_bag_file(path) as bag:
        yield (message for _, message in bag.messages([topic]))
