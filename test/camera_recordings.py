"""Small recordings of every kind, made on the spot."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

from segfloor_ros.apps.recordings import StereoSource, open_source
from segfloor_ros.apps.recordings.bag import ODOMETRY_TYPE, TF_TYPE
from segfloor_ros.apps.recordings.calibration_files import write_ros_calibration
from segfloor_ros.core.camera.calibration import EyeCalibration, StereoCalibration
from segfloor_ros.core.camera.settings import StereoCameraSettings

WIDTH, HEIGHT = 64, 48
FX, BASELINE_M = 50.0, 0.2
K = np.array([[FX, 0.0, 32.0], [0.0, FX, 24.0], [0.0, 0.0, 1.0]])
P_LEFT = np.hstack([K, np.zeros((3, 1))])
P_RIGHT = np.hstack([K, [[-FX * BASELINE_M], [0.0], [0.0]]])
DISTORTION = (-0.2, 0.05, 0.001, -0.001, 0.0)
MS = 1_000_000
"""Nanoseconds in a millisecond."""

Pair = tuple[NDArray[Any], NDArray[Any]]


def opened(path: Path, **settings: Any) -> StereoSource:
    """Open a recording with some settings."""
    return open_source(StereoCameraSettings(input=str(path), **settings))


def grey_pairs(count: int, width: int = WIDTH, height: int = HEIGHT) -> list[Pair]:
    """Return different grey pairs; neighbouring pixels resemble each other, as in pictures."""
    generator = np.random.default_rng(5)
    images = [
        cv2.GaussianBlur(generator.integers(0, 256, (height, width), np.uint8), (5, 5), 0)
        for _ in range(2 * count)
    ]
    return list(zip(images[::2], images[1::2], strict=True))


def calibration(distorted: bool = False) -> StereoCalibration:
    """Return the calibration of the small recordings."""
    D = DISTORTION if distorted else np.zeros(5)
    eyes = (
        EyeCalibration(WIDTH, HEIGHT, K, D, np.eye(3), P, origin=side)
        for side, P in (('left', P_LEFT), ('right', P_RIGHT))
    )
    return StereoCalibration(*eyes)


def write_image(path: Path, image: NDArray[Any]) -> None:
    """Write an image, making its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def kitti_line(name: str, P: NDArray[np.floating]) -> str:
    """Return a line of calib.txt."""
    return f'{name}: ' + ' '.join(f'{value:.12e}' for value in P.ravel()) + '\n'


def write_kitti(folder: Path, pairs: Sequence[Pair], first: int = 0, step_s: float = 0.1) -> Path:
    """Write a KITTI odometry folder."""
    for i, (left, right) in enumerate(pairs, first):
        write_image(folder / 'image_0' / f'{i:06d}.png', left)
        write_image(folder / 'image_1' / f'{i:06d}.png', right)
    (folder / 'calib.txt').write_text(kitti_line('P0', P_LEFT) + kitti_line('P1', P_RIGHT))
    lines = [f'{i * step_s:.6f}\n' for i in range(first + len(pairs))]
    (folder / 'times.txt').write_text(''.join(lines))
    return folder


def write_folders(
    folder: Path,
    pairs: Sequence[Pair],
    names: tuple[str, str] = ('left/left{}.png', 'right/right{}.png'),
    first: int = 1,
    distorted: bool = False,
) -> Path:
    """Write two image folders with ROS calibration files."""
    for i, pair in enumerate(pairs, first):
        for name, image in zip(names, pair, strict=True):
            write_image(folder / name.format(i), image)
    write_ros_calibration(folder / 'left.yaml', calibration(distorted).left, 'left')
    write_ros_calibration(folder / 'right.yaml', calibration(distorted).right, 'right')
    return folder


def sensor_yaml(T_body_eye: NDArray[np.floating], D: Sequence[float] = (0, 0, 0, 0)) -> str:
    """Return an EuRoC sensor.yaml."""
    data = ', '.join(map(str, T_body_eye.ravel()))
    return (
        '%YAML:1.0\n# Sensor extrinsics\n'
        f'T_BS:\n  cols: 4\n  rows: 4\n  data: [{data}]\n'
        f'resolution: [{WIDTH}, {HEIGHT}]\ncamera_model: pinhole\n'
        f'intrinsics: [{FX}, {FX}, 32.0, 24.0] #fu, fv, cu, cv\n'
        f'distortion_model: radial-tangential\ndistortion_coefficients: {list(D)}\n'
    )


def write_euroc(
    folder: Path, pairs: Sequence[Pair], left_ns: Sequence[int], right_ns: Sequence[int]
) -> Path:
    """Write an EuRoC ASL folder; the body frame is the left camera's."""
    T_left_right = np.eye(4)
    T_left_right[0, 3] = BASELINE_M
    for side, (camera, T, stamps) in enumerate(
        (('cam0', np.eye(4), left_ns), ('cam1', T_left_right, right_ns))
    ):
        root = folder / 'mav0' / camera
        for pair, stamp_ns in zip(pairs, stamps, strict=False):
            write_image(root / 'data' / f'{stamp_ns}.png', pair[side])
        rows = ''.join(f'{stamp_ns},{stamp_ns}.png\n' for stamp_ns in stamps)
        (root / 'data.csv').write_text('#timestamp [ns],filename\n' + rows)
        (root / 'sensor.yaml').write_text(sensor_yaml(T))
    return folder


class Message(NamedTuple):
    """A message of a bag: topic, type, recording time, and a function that makes it of types."""

    topic: str
    msgtype: str
    time_ns: int
    make: Callable[[Any, Any], Any]


def image_message(
    topic: str,
    stamp_ns: int,
    image: NDArray[Any],
    encoding: str = 'mono8',
    time_ns: int | None = None,
    **changes: Any,
) -> Message:
    """Return an Image message; `changes` overwrite fields of it."""
    height, width = image.shape[:2]
    data = np.frombuffer(image.tobytes(), np.uint8)
    fields = {
        'height': height,
        'width': width,
        'encoding': encoding,
        'is_bigendian': 0,
        'step': data.size // height,
        'data': data,
    } | changes
    return Message(
        topic,
        'sensor_msgs/msg/Image',
        stamp_ns if time_ns is None else time_ns,
        lambda types, header: types['sensor_msgs/msg/Image'](header=header(stamp_ns), **fields),
    )


def compressed_message(topic: str, stamp_ns: int, data: bytes, words: str = 'png') -> Message:
    """Return a CompressedImage message."""
    msgtype = 'sensor_msgs/msg/CompressedImage'
    array = np.frombuffer(data, np.uint8)
    return Message(
        topic,
        msgtype,
        stamp_ns,
        lambda types, header: types[msgtype](header=header(stamp_ns), format=words, data=array),
    )


def info_message(topic: str, stamp_ns: int, eye: EyeCalibration, **changes: Any) -> Message:
    """Return a CameraInfo message; `changes` overwrite fields of it."""
    msgtype = 'sensor_msgs/msg/CameraInfo'
    matrices = {'d': eye.D, 'k': eye.K.ravel(), 'r': eye.R.ravel(), 'p': eye.P.ravel()}
    fields = {'height': eye.height, 'width': eye.width, **matrices} | changes

    def make(types: Any, header: Callable[[int], Any]) -> Any:
        names = types[msgtype].__dataclass_fields__
        # ROS 1 writes the matrices in capitals.
        values = {n if n in names else n.upper(): value for n, value in fields.items()}
        roi = types['sensor_msgs/msg/RegionOfInterest'](0, 0, 0, 0, False)
        return types[msgtype](
            header=header(stamp_ns),
            distortion_model=eye.distortion_model,
            binning_x=0,
            binning_y=0,
            roi=roi,
            **values,
        )

    return Message(topic, msgtype, stamp_ns, make)


def stereo_messages(
    pairs: Sequence[Pair],
    stamps_ns: Sequence[int],
    names: tuple[str, str] = ('/stereo/left/image_raw', '/stereo/right/image_raw'),
    eyes: StereoCalibration | None = None,
    encoding: str = 'mono8',
) -> list[Message]:
    """Return the messages of a stereo camera, CameraInfo first."""
    eyes = eyes or calibration(distorted=True)
    infos = [f'{name.rpartition("/")[0]}/camera_info' for name in names]
    messages = []
    for stamp_ns, pair in zip(stamps_ns, pairs, strict=True):
        for topic, info, eye, image in zip(
            names, infos, (eyes.left, eyes.right), pair, strict=True
        ):
            messages.append(info_message(info, stamp_ns, eye))
            messages.append(image_message(topic, stamp_ns, image, encoding))
    return messages


def odometry_message(topic: str, stamp_ns: int, x_m: float, frame: str = 'odom') -> Message:
    """Return an Odometry of `base_link`, x_m ahead."""

    def make(types: Any, header: Any) -> Any:
        vector = types['geometry_msgs/msg/Vector3'](0.0, 0.0, 0.0)
        pose = types['geometry_msgs/msg/Pose'](
            types['geometry_msgs/msg/Point'](x_m, 0.0, 0.0),
            types['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0),
        )
        stamped = header(stamp_ns)
        stamped.frame_id = frame
        return types[ODOMETRY_TYPE](
            header=stamped,
            child_frame_id='base_link',
            pose=types['geometry_msgs/msg/PoseWithCovariance'](pose, np.zeros(36)),
            twist=types['geometry_msgs/msg/TwistWithCovariance'](
                types['geometry_msgs/msg/Twist'](vector, vector), np.zeros(36)
            ),
        )

    return Message(topic, ODOMETRY_TYPE, stamp_ns, make)


def transform_message(
    parent: str,
    child: str,
    translation: tuple[float, float, float],
    quat_xyzw: tuple[float, float, float, float],
) -> Message:
    """Return a fixed transform: where `child` is in `parent`."""

    def make(types: Any, header: Any) -> Any:
        stamped = header(0)
        stamped.frame_id = parent
        transform = types['geometry_msgs/msg/TransformStamped'](
            header=stamped,
            child_frame_id=child,
            transform=types['geometry_msgs/msg/Transform'](
                types['geometry_msgs/msg/Vector3'](*translation),
                types['geometry_msgs/msg/Quaternion'](*quat_xyzw),
            ),
        )
        return types[TF_TYPE]([transform])

    return Message('/tf_static', TF_TYPE, 0, make)


def write_rosbag2(path: Path, messages: Iterable[Message], plugin: str = 'mcap') -> Path:
    """Write a rosbag2 folder."""
    typestore = get_typestore(Stores.ROS2_JAZZY)

    def header(stamp_ns: int) -> Any:
        stamp = typestore.types['builtin_interfaces/msg/Time'](*divmod(stamp_ns, 10**9))
        return typestore.types['std_msgs/msg/Header'](stamp=stamp, frame_id='camera')

    storage = rosbag2.StoragePlugin.MCAP if plugin == 'mcap' else rosbag2.StoragePlugin.SQLITE3
    with rosbag2.Writer(path, version=9, storage_plugin=storage) as writer:
        connections: dict[str, Any] = {}
        for message in messages:
            if message.topic not in connections:
                connections[message.topic] = writer.add_connection(
                    message.topic, message.msgtype, typestore=typestore
                )
            data = typestore.serialize_cdr(message.make(typestore.types, header), message.msgtype)
            writer.write(connections[message.topic], message.time_ns, data)
    return path


def write_rosbag1(path: Path, messages: Iterable[Message]) -> Path:
    """Write a ROS 1 bag."""
    typestore = get_typestore(Stores.ROS1_NOETIC)

    def header(stamp_ns: int) -> Any:
        stamp = typestore.types['builtin_interfaces/msg/Time'](*divmod(stamp_ns, 10**9))
        return typestore.types['std_msgs/msg/Header'](seq=0, stamp=stamp, frame_id='camera')

    with rosbag1.Writer(path) as writer:
        connections: dict[str, Any] = {}
        for message in messages:
            if message.topic not in connections:
                connections[message.topic] = writer.add_connection(
                    message.topic, message.msgtype, typestore=typestore
                )
            data = typestore.serialize_ros1(message.make(typestore.types, header), message.msgtype)
            writer.write(connections[message.topic], message.time_ns, data)
    return path
