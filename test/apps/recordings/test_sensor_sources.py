"""Wheel odometry and IMU of folders, EuRoC sequences and bags: what is read, and bad files."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_recordings import (
    BASELINE_M,
    HEIGHT,
    MS,
    WIDTH,
    Message,
    calibration,
    grey_pairs,
    odometry_message,
    opened,
    sensor_yaml,
    stereo_messages,
    transform_message,
    write_euroc,
    write_kitti,
    write_rosbag2,
)
from scipy.spatial.transform import Rotation

from segfloor_ros.apps.recordings import StereoSource
from segfloor_ros.apps.recordings.bag import IMU_TYPE
from segfloor_ros.core.camera.calibration import StereoCalibration
from segfloor_ros.core.camera.recording import MeasurementLog
from segfloor_ros.core.contracts import ImuSample, WheelPose
from segfloor_ros.core.errors import InputError, SettingsError
from segfloor_ros.core.twists import se3_exp

WHEELS = '# t x y z qx qy qz qw\n0.00 2 0 0 0 0 0 1\n0.05 2.1 0 0 0 0 0.6 0.8\n0.2 3 0 0 0 0 0 1\n'
IMU = '#timestamp [ns],w x,w y,w z,a x,a y,a z\n' + ''.join(
    f'{t},0.1,0.2,0.3,0,-9.81,{t / 1e9}\n' for t in range(0, 210 * MS, 5 * MS)
)


def kitti(path: Path, **files: str) -> Path:
    folder = write_kitti(path, grey_pairs(3))
    for name, text in files.items():
        (folder / name.replace('__', '.')).write_text(text)
    return folder


def measured(source: StereoSource) -> list[Any]:
    return list(MeasurementLog(source.sensors).until(10**19))


def test_wheels_and_imu_of_a_folder_are_read(tmp_path: Path) -> None:
    source = opened(kitti(tmp_path, wheel_odometry__txt=WHEELS, imu__csv=IMU))
    assert [(s.name, s.messages, s.used) for s in source.sensors] == [
        ('wheel_odometry', 3, True),
        ('imu', 42, True),
    ]
    wheels = [m for m in measured(source) if isinstance(m, WheelPose)]
    imu = [m for m in measured(source) if isinstance(m, ImuSample)]
    assert [m.stamp_ns for m in wheels] == [0, 50 * MS, 200 * MS]
    np.testing.assert_allclose(wheels[1].T_wheels_base[:2, 3], [2.1, 0.0])
    # Half a turn of 0.6 = sin, 0.8 = cos: the x axis points to cos, sin of the whole turn.
    np.testing.assert_allclose(wheels[1].T_wheels_base[:2, 0], [0.28, 0.96])
    np.testing.assert_allclose(imu[1].gyro_rad_s, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(imu[-1].accel_m_s2, [0.0, -9.81, 0.205])


def test_the_log_hands_out_up_to_the_first_at_or_after_a_time(tmp_path: Path) -> None:
    log = MeasurementLog(opened(kitti(tmp_path, wheel_odometry__txt=WHEELS)).sensors)
    handed_out = [[m.stamp_ns // MS for m in log.until(t * MS)] for t in (0, 40, 50, 100, 150, 300)]
    assert handed_out == [[0], [50], [], [200], [], []]


def test_ignored_sensors_are_found_but_not_used(tmp_path: Path) -> None:
    folder = kitti(tmp_path, wheel_odometry__txt='nonsense', imu__csv=IMU)
    source = opened(folder, ignore='wheel_odometry,imu')
    assert [(s.name, s.used) for s in source.sensors] == [('wheel_odometry', False), ('imu', False)]
    assert measured(source) == []
    with pytest.raises(SettingsError, match='ignore: wheels is no sensor; known are wheel_odom'):
        opened(folder, ignore='wheels')


@pytest.mark.parametrize(
    ('name', 'text', 'message'),
    [
        ('wheel_odometry__txt', '0 1 2 3\n', r'wheel_odometry.txt, line 1: expected t x y z qx'),
        ('wheel_odometry__txt', '0 1 2 x 0 0 0 1\n', 'line 1: expected t x y z qx qy qz qw'),
        ('wheel_odometry__txt', '0 0 0 0 0 0 0 1\n1 nan 0 0 0 0 0 1\n', 'line 2: expected'),
        ('wheel_odometry__txt', '0 0 0 0 0 0 0 0\n', 'pose 1: the quaternion has length 0, not 1'),
        ('wheel_odometry__txt', '# t\n', 'holds no measurement'),
        ('wheel_odometry__txt', '99 0 0 0 0 0 0 1\n', 'do not meet .*--ignore wheel_odometry'),
        ('imu__csv', 'time,wx\n', r'imu.csv, line 1: expected stamp in ns, angular'),
        ('imu__csv', '0,0,0,0,0,-1,0\n', 'median acceleration is 1, but gravity alone is 9.81'),
    ],
)
def test_a_bad_file_is_named_in_one_line(
    tmp_path: Path, name: str, text: str, message: str
) -> None:
    with pytest.raises(InputError, match=message) as error:
        opened(kitti(tmp_path, **{name: text}))
    assert '\n' not in str(error.value)


def test_the_imu_of_euroc_is_turned_into_the_left_camera(tmp_path: Path) -> None:
    stamps = [0, 100 * MS]
    folder = write_euroc(tmp_path, grey_pairs(2), stamps, stamps)
    root = folder / 'mav0' / 'imu0'
    root.mkdir()
    T_body_imu = np.eye(4)
    # The IMU's x is the camera's y, its y the camera's -x.
    T_body_imu[:2, :2] = [[0, -1], [1, 0]]
    T_body_imu[:3, 3] = 0.1, 0.2, -0.3
    (root / 'sensor.yaml').write_text(sensor_yaml(T_body_imu))
    (root / 'data.csv').write_text('#t,w,w,w,a,a,a\n0,1,2,3,-9.81,0,0\n')
    (sample,) = measured(opened(folder))
    np.testing.assert_allclose(sample.gyro_rad_s, [-2, 1, 3], atol=1e-6)
    np.testing.assert_allclose(sample.accel_m_s2, [0, -9.81, 0], atol=1e-5)
    np.testing.assert_allclose(sample.place_m, [0.1, 0.2, -0.3], atol=1e-6)
    # The same where the body is neither of them.
    T_other_body = se3_exp(np.array([0.4, -0.2, 0.3, 0.5, -1.2, 0.7]))
    places = {'cam0': np.eye(4), 'cam1': np.eye(4), 'imu0': T_body_imu}
    places['cam1'][0, 3] = BASELINE_M
    for name, T in places.items():
        (folder / 'mav0' / name / 'sensor.yaml').write_text(sensor_yaml(T_other_body @ T))
    (of_body,) = measured(opened(folder))
    for name in ('gyro_rad_s', 'accel_m_s2', 'place_m'):
        np.testing.assert_allclose(getattr(of_body, name), getattr(sample, name), atol=1e-5)
    for camera in ('cam0', 'cam1', 'imu0'):  # and the same of a file of Kalibr
        (folder / 'mav0' / camera / 'sensor.yaml').unlink()
    eye = f'intrinsics: [50, 50, 32, 24], resolution: [{WIDTH}, {HEIGHT}], camera_model: pinhole'
    shift = [[1, 0, 0, -0.2], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    (folder / 'dso').mkdir()
    (folder / 'dso' / 'camchain.yaml').write_text(
        f'cam0: {{{eye}, T_cam_imu: {T_body_imu.tolist()}}}\ncam1: {{{eye}, T_cn_cnm1: {shift}}}\n'
    )
    (of_kalibr,) = measured(opened(folder))
    for name in ('gyro_rad_s', 'accel_m_s2', 'place_m'):
        np.testing.assert_allclose(getattr(of_kalibr, name), getattr(sample, name), atol=1e-5)


def test_a_file_beside_the_imu_of_a_folder_tells_where_it_is(tmp_path: Path) -> None:
    T_left_imu = np.eye(4)
    T_left_imu[:2, :2] = [[0, -1], [1, 0]]
    T_left_imu[:3, 3] = 0.0, 0.1, -0.3
    source = opened(kitti(tmp_path, imu__csv=IMU, imu__yaml=sensor_yaml(T_left_imu)))
    sample = measured(source)[1]
    np.testing.assert_allclose(sample.place_m, [0.0, 0.1, -0.3], atol=1e-6)
    np.testing.assert_allclose(sample.gyro_rad_s, [-0.2, 0.1, 0.3], atol=1e-6)
    assert sample.accel_m_s2[0] == pytest.approx(9.81)


def imu_message(stamp_ns: int, accel: tuple[float, float, float], frame: str) -> Message:
    def make(types: Any, header: Any) -> Any:
        vector = types['geometry_msgs/msg/Vector3']
        stamped = header(stamp_ns)
        stamped.frame_id = frame
        return types[IMU_TYPE](
            header=stamped,
            orientation=types['geometry_msgs/msg/Quaternion'](0.0, 0.0, 0.0, 1.0),
            orientation_covariance=np.zeros(9),
            angular_velocity=vector(0.1, 0.2, 0.3),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=vector(*accel),
            linear_acceleration_covariance=np.zeros(9),
        )

    return Message('/imu/data', IMU_TYPE, stamp_ns, make)


IMU_ON_CAMERA = transform_message('camera', 'imu_link', (0.0, 0.1, 0.0), (0.5, -0.5, 0.5, 0.5))
"""The IMU has the axes of a robot (x forward, z up), the camera's are optical."""


def bag(path: Path, *messages: Message) -> Path:
    pictures = stereo_messages(grey_pairs(2), [100 * MS, 200 * MS])
    return write_rosbag2(path / 'drive', [*messages, *pictures])


def test_wheels_of_a_bag_are_found_by_type_and_truth_is_not_taken_for_them(tmp_path: Path) -> None:
    source = opened(
        bag(
            tmp_path,
            *(odometry_message('/ground_truth/odom', t * MS, 9.0) for t in (100, 200)),
            *(odometry_message('/localisation', t * MS, 9.0, 'map') for t in (100, 200)),
            *(odometry_message('/odometry', t * MS, 9.0) for t in (100, 200)),
            odometry_message('/keyframe/odometry', 100 * MS, 9.0),
            *(odometry_message('/base/odom', t * MS, t / 100) for t in (200, 100)),
        )
    )
    (sensor,) = source.sensors
    assert (sensor.name, sensor.where, sensor.messages) == ('wheel_odometry', '/base/odom', 2)
    assert [m.T_wheels_base[0, 3] for m in measured(source)] == [1.0, 2.0]


def test_of_two_topics_the_one_that_is_set_is_taken(tmp_path: Path) -> None:
    wheels = [odometry_message(f'/{side}/odom', 100 * MS, x) for side, x in (('a', 1), ('b', 2))]
    recording = bag(tmp_path, *wheels, imu_message(100 * MS, (0, -9.81, 0), ''))
    source = opened(recording, wheel_odometry_topic='/b/odom', imu_topic='/imu/data')
    assert [sensor.where for sensor in source.sensors] == ['/b/odom', '/imu/data']
    assert measured(source)[0].T_wheels_base[0, 3] == 2.0
    with pytest.raises(InputError, match='imu_topic'):
        opened(recording, imu_topic='/imu/other')


@pytest.mark.parametrize('stamp_ns', [0, 10**18], ids=['since start', 'since 1970'])
def test_an_imu_of_another_clock_is_refused_in_a_bag_too(tmp_path: Path, stamp_ns: int) -> None:
    samples = [imu_message(stamp_ns + i * MS, (0, -9.81, 0), 'camera') for i in range(3)]
    recording = bag(tmp_path, *samples)
    with pytest.raises(InputError, match=r'/imu/data: its stamps, .* --ignore imu'):
        opened(recording)
    assert [sensor.used for sensor in opened(recording, ignore='imu').sensors] == [False]


def test_the_imu_of_a_bag_is_turned_by_tf(tmp_path: Path) -> None:
    source = opened(bag(tmp_path, IMU_ON_CAMERA, imu_message(100 * MS, (1, 2, 9.81), 'imu_link')))
    (sample,) = measured(source)
    # The pictures are distorted but not turned: x right is -y, y down is -z, z forward is x.
    np.testing.assert_allclose(sample.accel_m_s2, [-2, -9.81, 1], atol=1e-9)
    np.testing.assert_allclose(sample.gyro_rad_s, [-0.2, -0.3, 0.1], atol=1e-9)
    np.testing.assert_allclose(sample.place_m, [0.0, 0.1, 0.0], atol=1e-9)


def test_the_imu_of_a_bag_is_turned_by_tf_and_then_by_the_rectification(tmp_path: Path) -> None:
    eyes = calibration(distorted=True)
    R = Rotation.from_euler('z', 90, degrees=True).as_matrix()  # x becomes y, y becomes -x
    turned = StereoCalibration(*(dataclasses.replace(e, R=R) for e in (eyes.left, eyes.right)))
    pictures = stereo_messages(grey_pairs(2), [100 * MS, 200 * MS], eyes=turned)
    imu = imu_message(100 * MS, (1, 2, 9.81), 'imu_link')
    (sample,) = measured(opened(write_rosbag2(tmp_path / 'drive', [IMU_ON_CAMERA, imu, *pictures])))
    np.testing.assert_allclose(sample.accel_m_s2, [9.81, -2, 1], atol=1e-9)
    np.testing.assert_allclose(sample.gyro_rad_s, [0.3, -0.2, 0.1], atol=1e-9)
    np.testing.assert_allclose(sample.place_m, [-0.1, 0.0, 0.0], atol=1e-9)


def test_an_imu_without_transform_is_used_where_gravity_says_it_is_the_camera_s(
    tmp_path: Path,
) -> None:
    upright = bag(tmp_path / 'a', imu_message(100 * MS, (0, -9.81, 0), ''))
    assert len(measured(opened(upright))) == 1
    (sensor,) = opened(bag(tmp_path / 'b', imu_message(100 * MS, (0, 0, 9.81), 'imu'))).sensors
    assert not sensor.used and 'no tf' in sensor.where
