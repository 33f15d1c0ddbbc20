"""Wheel odometry and IMU topics of a bag."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from segfloor_ros.camera import ros_messages
from segfloor_ros.camera.settings import StereoCameraSettings
from segfloor_ros.camera.sources.bag_file import BagFile, check_given, open_bag_file
from segfloor_ros.camera.sources.sensor_files import IMU, WHEEL_ODOMETRY, check_gravity, is_upright
from segfloor_ros.geometry import Array, FrameTree, make_transform
from segfloor_ros.measurements import Measurement, RecordedSensor, WheelPose

ODOMETRY_TYPE, IMU_TYPE = 'nav_msgs/msg/Odometry', 'sensor_msgs/msg/Imu'
TF_TYPE, STATIC_TF = 'tf2_msgs/msg/TFMessage', '/tf_static'
NOT_WHEELS = ('truth', 'visual', 'vio', 'slam', 'keyframe', 'lidar', 'laser', 'icp', 'gps', 'map')
"""Words in the names of odometry that is not the wheels'."""

GRAVITY_SAMPLES = 50
GLOBAL_FRAMES = ('map', 'world', 'earth')
"""Frames that wheels know nothing of."""


def bag_sensors(
    path: Path, bag: BagFile, left_topic: str, R_left_raw: Array, settings: StereoCameraSettings
) -> list[RecordedSensor]:
    """Return the sensors of a bag. R_left_raw: (3, 3) from the frame of the images on `left_topic`
    to the rectified left one. Raises InputError.
    """
    ignored = settings.ignored_sensors
    found = []
    wheels = _wheel_topic(path, bag, settings.wheel_odometry_topic)
    if wheels:
        found.append(
            RecordedSensor(
                WHEEL_ODOMETRY,
                wheels,
                bag.topics[wheels].num_messages,
                WHEEL_ODOMETRY not in ignored,
                cache(lambda: list(_wheel_poses(path, wheels))),
            )
        )
    imu = _imu_topic(path, bag, settings.imu_topic)
    if imu:
        used, T_raw_imu, where = IMU not in ignored, None, imu
        if used:
            T_raw_imu = _T_raw_imu(bag, left_topic, imu)
            if T_raw_imu is None:
                used, where = False, f'{imu} (no tf from its frame to the camera)'
        T_left_raw = make_transform(R_left_raw, np.zeros(3))
        T_left_imu = T_left_raw @ (np.eye(4) if T_raw_imu is None else T_raw_imu)
        found.append(
            RecordedSensor(
                IMU,
                where,
                bag.topics[imu].num_messages,
                used,
                cache(lambda: _imu_samples(path, imu, T_left_imu)),
            )
        )
    return found


def _wheel_topic(path: Path, bag: BagFile, given: str) -> str:
    topics = _topics(path, bag, ODOMETRY_TYPE, given, 'wheel_odometry_topic')
    if given:
        return given
    candidates = []
    for topic in topics:
        published_by_slam = f'{topic.rpartition("/")[0]}/keyframe/odometry' in topics
        if published_by_slam or any(word in topic.lower() for word in NOT_WHEELS):
            continue
        first = bag.first(topic)
        if first.header.frame_id.strip('/') not in GLOBAL_FRAMES:
            candidates.append(topic)
    return min(candidates, key=lambda t: ('wheel' not in t, 'filtered' in t, t), default='')


def _imu_topic(path: Path, bag: BagFile, given: str) -> str:
    topics = _topics(path, bag, IMU_TYPE, given, 'imu_topic')
    if given:
        return given
    complete = []
    for topic in topics:
        first = bag.first(topic)
        if ros_messages.measures_motion(first):
            complete.append(topic)
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
    frames = []
    for topic in (left_topic, imu_topic):
        first = bag.first(topic)
        frames.append(first.header.frame_id.strip('/'))
    if frames[0] == frames[1]:
        return np.eye(4)
    T_left_imu = _fixed_transforms(bag).lookup(*frames)
    if T_left_imu is not None:
        return T_left_imu
    some = islice(bag.messages([imu_topic]), GRAVITY_SAMPLES)
    felt = np.nanmedian(
        [ros_messages.xyz(message.linear_acceleration) for _, message in some], axis=0
    )
    return np.eye(4) if is_upright(felt) else None


def _fixed_transforms(bag: BagFile) -> FrameTree:
    tree = FrameTree()
    for topic, info in bag.topics.items():
        if info.msgtype != TF_TYPE or not topic.endswith(STATIC_TF):
            continue
        for _, message in bag.messages([topic]):
            for transform in message.transforms:
                parent, child = transform.header.frame_id, transform.child_frame_id
                moved = transform.transform
                pose = ros_messages.rigid_motion(moved.translation, moved.rotation, topic)
                tree.add_fixed(parent.strip('/'), child.strip('/'), pose)
    return tree


def _wheel_poses(path: Path, topic: str) -> Iterator[WheelPose]:
    with _messages(path, topic) as messages:
        yield from (ros_messages.wheel_pose(message, f'{path}, {topic}') for message in messages)


def _imu_samples(path: Path, topic: str, T_left_imu: Array) -> Sequence[Measurement]:
    with _messages(path, topic) as messages:
        samples = [ros_messages.imu_sample(message, T_left_imu) for message in messages]
    check_gravity(f'{path}, {topic}', np.array([sample.accel_m_s2 for sample in samples]))
    return samples


@contextmanager
def _messages(path: Path, topic: str) -> Iterator[Iterator[Any]]:
    with open_bag_file(path) as bag:
        yield (message for _, message in bag.messages([topic]))
