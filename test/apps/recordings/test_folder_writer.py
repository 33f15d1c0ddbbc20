"""Round trips through the folders that we write: KITTI and TUM RGB-D."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_recordings import (
    MS,
    calibration,
    grey_pairs,
    image_message,
    info_message,
    odometry_message,
    opened,
    sensor_yaml,
    stereo_messages,
    transform_message,
    write_folders,
    write_image,
    write_kitti,
    write_rosbag2,
)
from command_line import segfloor

from segfloor_ros.apps.recordings import StereoSource
from segfloor_ros.apps.recordings.bag_writer import convert
from segfloor_ros.apps.recordings.folder_writer import Layout, at_times, write_folder
from segfloor_ros.apps.trajectory import Trajectory, read_trajectory
from segfloor_ros.core.camera.recording import MeasurementLog
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.geometry import make_transform

WHEELS = '0.00 2 0 0 0 0 0 1\n0.05 2.1 0 0 0 0 0.6 0.8\n0.2 3 0 0 0 0 0 1\n'
IMU = ''.join(f'{t},0.1,0.2,0.3,0.4,-9.81,{t / 1e9}\n' for t in range(0, 210 * MS, 5 * MS))
STAMPS_NS = [1_700_000_000_123_456_789, 1_700_000_000_223_456_790, 1_700_000_000_323_456_788]
"""Of a robot's clock: to the nanosecond."""

TO_OPTICAL = (-0.5, 0.5, -0.5, 0.5)
"""The axes of a camera that looks ahead, seen from its robot."""


def assert_same_frames(one: StereoSource, other: StereoSource) -> None:
    """Stamps and rectified pixels are equal to the last bit, disparities up to their rounding."""
    for frame, again in zip(one.frames(), other.frames(), strict=True):
        assert frame.stamp_ns == again.stamp_ns
        np.testing.assert_array_equal(frame.left, again.left)
        rounding = 1e-6 if frame.right.dtype == np.float32 else 0.0
        np.testing.assert_allclose(frame.right, again.right, rtol=rounding)


def measured(source: StereoSource) -> list[Any]:
    return list(MeasurementLog(source.sensors).until(10**19))


@pytest.mark.parametrize('distorted', [False, True])
def test_a_bag_as_a_kitti_folder_gives_the_same_pairs_stamps_and_calibration(
    tmp_path: Path, distorted: bool
) -> None:
    names = ('/left/image_raw', '/right/image_raw')
    if not distorted:
        names = ('/left/image_rect', '/right/image_rect')
    eyes = calibration(distorted=distorted)
    bag = write_rosbag2(tmp_path / 'bag', stereo_messages(grey_pairs(3), STAMPS_NS, names, eyes))
    source, progress = opened(bag), []
    assert write_folder(source, tmp_path / 'new' / '07', Layout.kitti, progress.append) == 3
    assert progress == [1, 2, 3]
    again = opened(tmp_path / 'new' / '07')
    assert again.calibration.is_rectified
    assert again.camera == source.camera
    assert_same_frames(source, again)
    assert sorted(p.name for p in (tmp_path / 'new').iterdir()) == ['07']


def rgbd_bag(path: Path) -> Path:
    """Write colour images with depths in mm, the lens distorted."""
    eye = calibration(distorted=True).left
    messages = []
    for k, (stamp_ns, (left, _)) in enumerate(zip(STAMPS_NS, grey_pairs(3), strict=True)):
        colour = np.stack([left, left[::-1], left[:, ::-1]], axis=2)
        depth = np.arange(left.size, dtype=np.uint16).reshape(left.shape) + k
        messages += [
            info_message('/rgb/camera_info', stamp_ns, eye),
            image_message('/rgb/image_raw', stamp_ns, colour, 'bgr8'),
            image_message('/depth_registered/image_raw', stamp_ns, depth, '16UC1'),
        ]
    return write_rosbag2(path, messages)


def test_a_depth_camera_as_a_tum_folder_gives_the_same_images_and_depths(tmp_path: Path) -> None:
    source = opened(rgbd_bag(tmp_path / 'bag'))
    write_folder(source, tmp_path / 'tum', Layout.tum)
    again = opened(tmp_path / 'tum')
    assert again.camera == source.camera
    np.testing.assert_array_equal(again.calibration.left.D, source.calibration.left.D)
    # Read as grey, a decoder mixes the colours of a PNG otherwise than OpenCV, by one level.
    for frame, copy in zip(source.frames(), again.frames(), strict=True):
        assert np.abs(frame.left.astype(int) - copy.left).max() <= 1
    again.takes_colour = source.takes_colour = True
    assert_same_frames(source, again)
    for frame, copy in zip(source.frames(), again.frames(), strict=True):
        np.testing.assert_array_equal(frame.colour, copy.colour)


def test_wheels_imu_and_depth_go_beside_the_images(tmp_path: Path) -> None:
    folder = write_kitti(tmp_path / 'drive', grey_pairs(3))
    (folder / 'wheel_odometry.txt').write_text(WHEELS)
    (folder / 'imu.csv').write_text(IMU)
    T_left_imu = make_transform(np.eye(3), np.array([0.1, 0.0, -0.3]))
    (folder / 'imu.yaml').write_text(sensor_yaml(T_left_imu))
    depth_mm = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64)
    for k in range(3):
        write_image(folder / 'depth' / f'{k:06d}.png', depth_mm + k)
    source, depth = opened(folder), opened(folder, depth=True)
    for layout in (Layout.kitti, Layout.tum):
        out = tmp_path / layout.value
        write_folder(source, out, layout, depth=depth)
        for one, other in zip(measured(source), measured(opened(out)), strict=True):
            for name, value in vars(one).items():
                np.testing.assert_allclose(getattr(other, name), value, atol=1e-9)
        assert_same_frames(depth, opened(out, depth=True))
    assert_same_frames(source, opened(tmp_path / 'kitti'))


def test_depths_that_lie_on_raw_images_are_not_laid_beside_rectified_ones(tmp_path: Path) -> None:
    folder = write_folders(tmp_path / 'images', grey_pairs(2), distorted=True)
    for k in (1, 2):
        write_image(folder / 'depth' / f'left{k}.png', np.full((48, 64), 900, np.uint16))
    write_folder(opened(folder), tmp_path / 'out', Layout.kitti, depth=opened(folder, depth=True))
    assert not (tmp_path / 'out' / 'depth').exists()


def test_true_poses_are_those_of_the_camera_at_the_images(tmp_path: Path) -> None:
    """The camera sits 0.2 m ahead on a base that drives straight on."""
    stamps = [100 * MS, 150 * MS, 200 * MS]
    bag = write_rosbag2(
        tmp_path / 'bag',
        [
            transform_message('base_link', 'camera', (0.2, 0.0, 0.3), TO_OPTICAL),
            *(odometry_message('/truth', t * MS, t / 100.0, 'world') for t in (90, 110, 210)),
            *stereo_messages(grey_pairs(3), stamps),
        ],
    )
    done = segfloor('convert', bag, tmp_path / 'kitti', '--truth', '/truth')
    assert done.returncode == 0, done.stderr
    assert '3 pairs' in done.stdout
    times_s, poses = read_trajectory(tmp_path / 'kitti' / 'poses.txt')
    np.testing.assert_allclose(times_s, [0.1, 0.15, 0.2])
    # In the axes of the first camera ahead is z.
    np.testing.assert_allclose(poses[:, :3, 3], [[0, 0, 0], [0, 0, 0.5], [0, 0, 1.0]], atol=1e-9)
    np.testing.assert_allclose(poses[:, :3, :3], np.tile(np.eye(3), (3, 1, 1)), atol=1e-9)
    late = segfloor('convert', bag, tmp_path / 'late', '--truth', '/late')
    assert late.returncode == 2
    assert 'no Odometry on /late; it has /truth' in late.stderr
    assert not (tmp_path / 'late').exists()


def test_poses_of_a_file_must_cover_the_images(tmp_path: Path) -> None:
    source = opened(write_kitti(tmp_path / 'drive', grey_pairs(3)))
    part = Trajectory(np.array([0, 150 * MS]), np.tile(np.eye(4), (2, 1, 1)))
    with pytest.raises(InputError, match=r'0\.000000000 to 0\.150000000 s\) do not cover'):
        write_folder(source, tmp_path / 'out', Layout.kitti, truth=part)
    assert not (tmp_path / 'out').exists()


def test_times_of_a_file_that_are_rounded_cover_the_images(tmp_path: Path) -> None:
    """Seconds since 1970 have seven digits after the point as floats."""
    first_ns = 1_700_000_000_000_000_150
    stamps_ns = [first_ns, first_ns + 100 * MS]
    rounded = np.rint(np.array([stamp_ns / 1e9 for stamp_ns in stamps_ns]) * 1e9).astype(np.int64)
    assert rounded[0] > stamps_ns[0]
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 1.0
    found = at_times(Trajectory(rounded, poses), stamps_ns, 'drive')
    np.testing.assert_allclose(found.poses[:, 0, 3], [0.0, 1.0], atol=1e-5)


@pytest.mark.parametrize('name', ['file', 'folder', 'link'])
def test_nothing_that_exists_is_overwritten(tmp_path: Path, name: str) -> None:
    source = opened(write_kitti(tmp_path / 'drive', grey_pairs(1)))
    (tmp_path / 'file').write_text('precious')
    (tmp_path / 'folder').mkdir()
    (tmp_path / 'link').symlink_to(tmp_path / 'nowhere')
    with pytest.raises(InputError, match='exists already; choose another name'):
        write_folder(source, tmp_path / name, Layout.kitti)
    assert (tmp_path / 'file').read_text() == 'precious'
    assert not list((tmp_path / 'folder').iterdir())


def test_the_layout_follows_from_what_is_converted(tmp_path: Path) -> None:
    folder = write_kitti(tmp_path / 'drive', grey_pairs(2))
    convert(opened(folder), tmp_path / 'stereo.mcap')
    rgbd_bag(tmp_path / 'rgbd')
    cases = [
        ('drive', 'new', 'new/metadata.yaml'),
        ('stereo.mcap', 'kitti', 'kitti/calib.txt'),
        ('stereo.mcap', 'copy.mcap', 'copy.mcap'),
        ('rgbd', 'tum', 'tum/rgb.txt'),
    ]
    for name, out, expected in cases:
        done = segfloor('convert', tmp_path / name, tmp_path / out)
        assert done.returncode == 0, done.stderr
        assert (tmp_path / expected).is_file()


@pytest.mark.parametrize(
    ('options', 'message'),
    [
        (('--layout', 'tum'), 'has no depth images, which a TUM RGB-D folder is made of'),
        (('--truth', 'poses.txt'), '--truth goes with a folder'),
        (('--layout', 'kitti', '--images', 'jpeg'), 'the images of a folder are PNG'),
    ],
)
def test_what_does_not_fit_ends_in_one_line(tmp_path: Path, options, message: str) -> None:
    folder = write_kitti(tmp_path / 'drive', grey_pairs(2))
    done = segfloor('convert', folder, tmp_path / 'out', *options)
    assert done.returncode == 2
    assert message in done.stderr
    assert not (tmp_path / 'out').exists()
