"""Round trips through the bags that we write."""

import dataclasses
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from camera_recordings import (
    calibration,
    grey_pairs,
    opened,
    sensor_yaml,
    write_folders,
    write_kitti,
)
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from segfloor_ros.apps.recordings import StereoSource
from segfloor_ros.apps.recordings.bag_writer import BagWriter, ImageCoding, convert
from segfloor_ros.apps.recordings.calibration_files import write_ros_calibration
from segfloor_ros.core.camera.recording import MeasurementLog
from segfloor_ros.core.contracts import ImuSample
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.geometry import make_transform


def assert_same_recording(one: StereoSource, other: StereoSource) -> None:
    """Stamps, numbers, rectified pixels and calibration are equal to the last bit."""
    assert one.camera == other.camera
    for eye, copy in (
        (one.calibration.left, other.calibration.left),
        (one.calibration.right, other.calibration.right),
    ):
        assert eye.distortion_model == copy.distortion_model
        for name in 'KDRP':
            np.testing.assert_array_equal(getattr(eye, name), getattr(copy, name))
    for frame, again in zip(one.frames(), other.frames(), strict=True):
        assert (frame.index, frame.stamp_ns) == (again.index, again.stamp_ns)
        np.testing.assert_array_equal(frame.left, again.left)
        np.testing.assert_array_equal(frame.right, again.right)


@pytest.mark.parametrize('coding', [ImageCoding.raw, ImageCoding.png])
@pytest.mark.parametrize('name', ['drive.mcap', 'drive'])
@pytest.mark.parametrize('distorted', [False, True])
def test_round_trips_are_exact(
    tmp_path: Path, coding: ImageCoding, name: str, distorted: bool
) -> None:
    source = opened(write_folders(tmp_path / 'images', grey_pairs(5), distorted=distorted))
    out = tmp_path / 'new' / name
    progress: list[int] = []
    assert convert(source, out, coding, progress.append) == 5
    assert progress == [1, 2, 3, 4, 5]
    assert out.is_file() == (name == 'drive.mcap')
    assert_same_recording(source, opened(out))
    assert list(out.parent.iterdir()) == [out]


WITHOUT_ROS = """
import sys
from pathlib import Path
for name in ('rclpy', 'builtin_interfaces', 'std_msgs', 'geometry_msgs', 'nav_msgs', 'sensor_msgs',
             'stereo_msgs'):
    sys.modules[name] = None
from segfloor_ros.apps.recordings import open_source
from segfloor_ros.apps.recordings.bag_writer import convert
from segfloor_ros.core.camera.settings import StereoCameraSettings
convert(open_source(StereoCameraSettings(input=sys.argv[1])), Path(sys.argv[2]))
"""


def test_a_bag_is_written_without_ros(tmp_path: Path) -> None:
    folder = write_kitti(tmp_path / 'drive', grey_pairs(2))
    (folder / 'wheel_odometry.txt').write_text(WHEELS)
    (folder / 'imu.csv').write_text(IMU)
    out = tmp_path / 'drive.mcap'
    command = [sys.executable, '-c', WITHOUT_ROS, str(folder), str(out)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert_same_recording(opened(folder), opened(out))
    assert len(measured(opened(out))) == len(measured(opened(folder))) > 0


def test_jpeg_is_close(tmp_path: Path) -> None:
    source = opened(write_kitti(tmp_path / 'drive', grey_pairs(2)))
    convert(source, tmp_path / 'small.mcap', ImageCoding.jpeg)
    again = opened(tmp_path / 'small.mcap')
    for frame, copy in zip(source.frames(), again.frames(), strict=True):
        assert np.abs(frame.left.astype(int) - copy.left).mean() < 3


@pytest.mark.parametrize(
    ('distorted', 'coding', 'image', 'kind'),
    [
        (True, ImageCoding.raw, 'image_raw', 'Image'),
        (False, ImageCoding.raw, 'image_rect', 'Image'),
        (True, ImageCoding.png, 'image_raw/compressed', 'CompressedImage'),
    ],
)
def test_topics_types_and_headers_are_the_usual_ones(
    tmp_path: Path, distorted: bool, coding: ImageCoding, image: str, kind: str
) -> None:
    source = opened(write_folders(tmp_path / 'images', grey_pairs(2), distorted=distorted))
    convert(source, tmp_path / 'drive', coding)
    with AnyReader([tmp_path / 'drive']) as reader:
        types = {name: topic.msgtype for name, topic in reader.topics.items()}
        assert types == {
            f'/left/{image}': f'sensor_msgs/msg/{kind}',
            f'/right/{image}': f'sensor_msgs/msg/{kind}',
            '/left/camera_info': 'sensor_msgs/msg/CameraInfo',
            '/right/camera_info': 'sensor_msgs/msg/CameraInfo',
        }
        for connection, time_ns, data in reader.messages():
            header = reader.deserialize(data, connection.msgtype).header
            assert header.stamp.sec * 10**9 + header.stamp.nanosec == time_ns
            assert header.frame_id.startswith(connection.topic.split('/')[1])
            assert header.frame_id.endswith('_optical_frame')


def test_nothing_is_left_after_an_error(tmp_path: Path) -> None:
    folder = write_kitti(tmp_path / 'drive', grey_pairs(3))
    source = opened(folder)
    (folder / 'image_0' / '000002.png').unlink()
    out = tmp_path / 'out' / 'drive.mcap'
    with pytest.raises(InputError, match=r'000002.png: cannot be read'):
        convert(source, out)
    assert list(out.parent.iterdir()) == []


def test_existing_files_are_not_overwritten(tmp_path: Path) -> None:
    source = opened(write_kitti(tmp_path / 'drive', grey_pairs(1)))
    out = tmp_path / 'drive.mcap'
    out.write_text('precious')
    with (
        pytest.raises(InputError, match=r'drive.mcap: exists already; choose'),
        BagWriter(out, source.calibration),
    ):
        pass
    assert out.read_text() == 'precious'
    with pytest.raises(InputError, match=r'cannot be written'):
        convert(source, out / 'below' / 'drive.mcap')


WHEELS = '0.00 2 0 0 0 0 0 1\n0.05 2.1 0 0 0 0 0.6 0.8\n0.2 3 0 0 0 0 0 1\n'
IMU = ''.join(f'{t},0.1,0.2,0.3,0.4,-9.81,{t / 1e9}\n' for t in range(0, 210_000_000, 5_000_000))


@pytest.mark.parametrize(('distorted', 'beside'), [(False, False), (True, False), (True, True)])
def test_wheels_imu_and_depth_are_kept(tmp_path: Path, distorted: bool, beside: bool) -> None:
    """Also of images that are not rectified: the file's axes are those of the rectified ones."""
    pairs = grey_pairs(3)
    if distorted:
        folder = write_folders(tmp_path / 'images', pairs, distorted=True)
        for side in ('left', 'right'):  # the rectified axes are not those of the raw images
            eye = getattr(calibration(distorted=True), side)
            turned = Rotation.from_rotvec((0.05, -0.1, 0.2)).as_matrix()
            path = folder / f'{side}.yaml'
            write_ros_calibration(path, dataclasses.replace(eye, R=turned), side)
    else:
        folder = write_kitti(tmp_path / 'images', pairs)
    (folder / 'wheel_odometry.txt').write_text(WHEELS)
    (folder / 'imu.csv').write_text(IMU)
    if beside:
        T_left_imu = make_transform(np.eye(3), np.array([0.1, 0.0, -0.3]))
        (folder / 'imu.yaml').write_text(sensor_yaml(T_left_imu))
    (folder / 'depth').mkdir()
    height, width = pairs[0][0].shape
    depth_mm = np.arange(height * width, dtype=np.uint16).reshape(height, width)
    for k in range(3):
        cv2.imwrite(str(folder / 'depth' / f'{k:06d}.png'), depth_mm + k)
    source = opened(folder)
    convert(source, tmp_path / 'drive.mcap', depth=opened(folder, depth=True))
    again = opened(tmp_path / 'drive.mcap')
    assert {s.name: s.used for s in again.sensors} == {
        'wheel_odometry': True,
        'imu': True,
        'depth': False,
    }
    for one, other in zip(measured(source), measured(again), strict=True):
        for name, value in vars(one).items():
            np.testing.assert_allclose(getattr(other, name), value, atol=1e-9)
    by_folder, by_bag = opened(folder, depth=True), opened(tmp_path / 'drive.mcap', depth=True)
    for frame, copy in zip(by_folder.frames(), by_bag.frames(), strict=True):
        np.testing.assert_array_equal(frame.left, copy.left)
        np.testing.assert_allclose(frame.right, copy.right, rtol=1e-6)
    # A depth camera's images are not turned, those of the pair are: the IMU's axes follow.
    for one, other in zip(measured(by_folder), measured(by_bag), strict=True):
        if isinstance(one, ImuSample):
            np.testing.assert_allclose(other.accel_m_s2, one.accel_m_s2, atol=1e-9)
            np.testing.assert_allclose(other.place_m, one.place_m, atol=1e-9)
            assert one.place_m.any() == beside


def measured(source: StereoSource) -> list[Any]:
    """Everything measured, by stamp within each sensor."""
    return list(MeasurementLog(source.sensors).until(10**19))
