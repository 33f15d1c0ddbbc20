"""Wheels, IMU and depth through `segfloor replay` and `convert`, against `segfloor run`."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from stereo_drive import room_drive, write_kitti
from stereo_room import MOUNT, depth_of_room
from test_replay import segfloor

from segfloor_ros.apps.trajectory import read_trajectory
from segfloor_ros.core.contracts import StereoFrame
from segfloor_ros.core.quaternions import quaternion_xyzw

FRAMES, BLIND = 16, range(8, 11)
GRAVITY_M_S2 = 9.81
MOUNTED = [
    *('--set', f'stereo_slam.camera_height_m={MOUNT.height_m}'),
    *('--set', f'stereo_slam.camera_pitch_rad={MOUNT.pitch_rad}'),
    *('--set', f'stereo_slam.camera_roll_rad={MOUNT.roll_rad}'),
]


@pytest.fixture(scope='module')
def drive(tmp_path_factory) -> Path:
    """A drive with wheels, an IMU and depth images, whose images show nothing for a while."""
    frames, poses = room_drive(FRAMES)
    grey = np.full(frames[0].left.shape, 90, np.uint8)
    for k in BLIND:
        frames[k] = StereoFrame(k, frames[k].stamp_ns, grey, grey)
    folder = write_kitti(tmp_path_factory.mktemp('recording') / 'drive', frames)
    rows = [[k * 0.1, *pose[:3, 3], *quaternion_xyzw(pose[:3, :3])] for k, pose in enumerate(poses)]
    np.savetxt(folder / 'wheel_odometry.txt', rows, fmt='%.9f')
    R_left_base = MOUNT.T_base_left[:3, :3].T
    gyro, up = R_left_base @ (0.0, 0.0, 0.1), R_left_base @ (0.0, 0.0, GRAVITY_M_S2)
    samples = [[round(k * 1e7), *gyro, *up] for k in range(10 * FRAMES)]
    np.savetxt(folder / 'imu.csv', samples, fmt=['%d', *['%.9f'] * 6], delimiter=',')
    (folder / 'depth').mkdir()
    for frame, pose in zip(frames, poses, strict=True):
        depth_mm = depth_of_room(pose @ MOUNT.T_base_left)
        cv2.imwrite(str(folder / 'depth' / f'{frame.index:06d}.png'), depth_mm)
    return folder


def positions(out: Path) -> np.ndarray:
    return read_trajectory(out / 'trajectory.txt')[1][:, :3, 3]


def results(*arguments: object) -> tuple[dict[str, int], np.ndarray]:
    """Run a command; returns the messages used of each sensor and the positions."""
    out = Path(str(arguments[arguments.index('--out') + 1]))
    status, _, errors = segfloor(*arguments, *MOUNTED)
    assert status == 0, errors
    return json.loads((out / 'summary.json').read_text())['sensors'], positions(out)


@pytest.mark.slow
@pytest.mark.parametrize('options', [(), ('--depth',), ('--ignore', 'imu')], ids=str)
def test_sensors_come_through_replay_and_through_a_bag(drive, tmp_path, options) -> None:
    sensors, expected = results('run', drive, '--out', tmp_path / 'run', *options)
    assert sensors['wheel_odometry'] == FRAMES
    assert ('depth' in sensors, 'imu' in sensors) == ('--depth' in options, 'imu' not in options)
    assert len(expected) == FRAMES
    replayed = results('replay', drive, '--out', tmp_path / 'replay', '--rate', 0, *options)
    assert replayed[0].keys() == sensors.keys()
    np.testing.assert_allclose(replayed[1], expected, atol=2e-3)
    bag = tmp_path / 'drive.mcap'
    assert segfloor('convert', drive, bag)[0] == 0
    from_bag = results('replay', bag, '--out', tmp_path / 'bag', '--rate', 0, *options)
    assert from_bag[0] == replayed[0]
    np.testing.assert_allclose(from_bag[1], expected, atol=2e-3)
