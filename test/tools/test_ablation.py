"""`tools.ablation`: what is patched exists, and what is drawn, read and added is as said."""

import numpy as np
import pytest
from floor_scenes import SMALL_CAMERA, Scene, floor_patch, wall
from stereo_drive import room_drive, write_kitti
from stereo_room import CAMERA, MOUNT
from typer.testing import CliRunner

from segfloor_ros.core.camera.recording import RecordedSensor
from segfloor_ros.core.contracts import FLOOR, StereoFrame, WheelPose
from segfloor_ros.core.floor.segmentation import FloorSegmentation
from segfloor_ros.core.floor.settings import FloorSegmentationSettings
from segfloor_ros.core.geometry import invert
from segfloor_ros.core.plugins.assembly import equipped_slam
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.nodes.configuration import resolve
from tools.ablation import app
from tools.driving import after_sensors, noisy
from tools.mechanisms import FLOOR as FLOOR_MECHANISMS
from tools.mechanisms import GRID, RECORDED, SLAM

ALL = {**SLAM, **FLOOR_MECHANISMS, **GRID, **RECORDED}


@pytest.mark.parametrize('name', sorted(ALL))
def test_what_is_left_out_is_part_of_the_package(name) -> None:
    with ALL[name].left_out():
        changed = ALL[name].configured(resolve())
    for setting, value in ALL[name].settings.items():
        assert getattr(changed.stereo_slam, setting) == value
    assert bool(ALL[name].patches or ALL[name].settings) is (name != 'nothing')


def test_noise_follows_its_seed() -> None:
    grey = np.full((60, 80), 100, np.uint8)
    frames = [StereoFrame(0, 0, grey, grey)]
    (bare,), (first,), (again,), (other,) = (noisy(frames, seed) for seed in (0, 1, 1, 2))
    assert bare.left is grey
    np.testing.assert_array_equal(first.left, again.left)
    assert (first.left != other.left).mean() > 0.3
    assert first.right.astype(float).std() == pytest.approx(1.0, abs=0.1)


def test_slam_has_what_sensors_measured_up_to_a_frame_before_it():
    told = [WheelPose(k * 40_000_000, np.eye(4)) for k in range(20)]
    sensors = [RecordedSensor('wheel_odometry', 'here', len(told), True, lambda: told)]
    slam = equipped_slam(CAMERA, StereoSlamSettings(), MOUNT)
    frames, _ = room_drive(3)
    had = [
        (frame.index, slam.sensors.messages['wheel_odometry'])
        for frame in after_sensors(slam, sensors, frames)
    ]
    assert had == [(0, 1), (1, 4), (2, 6)]


@pytest.mark.slow
def test_the_error_of_a_path_without_a_mechanism_is_printed(tmp_path) -> None:
    frames, T_world_base = room_drive(8)
    drive = write_kitti(tmp_path / 'room', frames)
    T_world_left = np.array(T_world_base) @ MOUNT.T_base_left
    relative = invert(T_world_left[0]) @ T_world_left
    np.savetxt(drive / 'poses.txt', relative[:, :3].reshape(-1, 12))
    result = CliRunner().invoke(app, ['path', str(drive), '--only', 'fusion of points'])
    assert result.exit_code == 0, result.exception
    rows = [line.split(' | ') for line in result.output.splitlines()]
    assert [row[:2] for row in rows] == [['room', 'nothing'], ['room', 'fusion of points']]
    for _, _, error_m, tracked, keyframes, points in rows:
        assert 0 < float(error_m) < 0.02
        assert int(tracked) == 8 and int(keyframes) >= 2 and int(points) > 100


@pytest.mark.parametrize('name', sorted(FLOOR_MECHANISMS))
def test_floor_is_segmented_without_each_mechanism(name) -> None:
    room = Scene([floor_patch(), wall(2.0)], SMALL_CAMERA)
    left, right, _, _ = room.render()
    with FLOOR_MECHANISMS[name].left_out():
        stage = FloorSegmentation(SMALL_CAMERA, FloorSegmentationSettings())
        mask = stage.process(left, right, room.mount).mask
    assert mask.shape == left.shape
    assert np.mean(mask == FLOOR) > 0.2


def test_noise_leaves_a_disparity_as_it_is() -> None:
    left, disparity = np.full((9, 9), 100, np.uint8), np.full((9, 9), 7.5, np.float32)
    frame = StereoFrame(0, 0, left, disparity)
    (as_it_was,), (spoiled,) = noisy([frame], 0), noisy([frame], 1)
    assert as_it_was is frame
    np.testing.assert_array_equal(spoiled.right, disparity)
    assert 0 < np.abs(spoiled.left - left.astype(float)).max() < 6
