"""Rendered pictures against what geometry says. Skipped where nothing can be rendered."""

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from segfloor_ros.apps.evaluation.maps import load_truth
from segfloor_ros.apps.simulation.scene_file import scene_from_mapping
from segfloor_ros.apps.simulation.simulation import RecordingOptions, Simulation, record
from segfloor_ros.apps.simulation.world import RenderingError
from segfloor_ros.apps.trajectory import read_trajectory
from segfloor_ros.core.contracts import Mount
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.geometry import transform_points
from segfloor_ros.core.grid.occupancy import OCCUPIED

REPOSITORY = Path(__file__).resolve().parents[3]

ROOM = {
    'description': 'a small room for tests',
    'floor': {'texture': 'tiles'},
    'walls': [
        {
            'points': [[-1, -1.5], [4, -1.5], [4, 1.5], [-1, 1.5]],
            'closed': True,
            'texture': 'bricks',
        }
    ],
    'boxes': [{'at': [2.5, 0.6], 'size': [0.5, 0.5, 0.6], 'texture': 'wood', 'yaw_deg': 20}],
    'camera': {'width': 160, 'height': 120, 'rate_hz': 4, 'noise_sigma': 1.0},
    'path': {'waypoints': [[0, 0], [1.2, -0.2]], 'speed_m_s': 0.5},
}


def simulate(labels=False, **changes):
    try:
        return Simulation(scene_from_mapping({**ROOM, **changes}, 'test'), labels=labels)
    except RenderingError as error:
        pytest.skip(str(error))


@pytest.fixture(scope='module')
def room():
    with simulate() as simulation:
        yield simulation


def pixel_grid(camera):
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return np.stack([u.ravel(), v.ravel()], axis=1).astype(float)


def test_depth_of_floor_and_wall_is_the_geometric_one(room):
    truth, camera, rig = room.truth(0), room.camera, room.scene.camera
    # Straight ahead the inner side of the wall at x = 3.95; the camera looks 7 degrees down and
    # meets the floor first: 0.3 m below, at 0.3 / tan(7 deg) = 2.44 m ahead.
    mount = Mount(rig.height_m, np.radians(rig.pitch_deg))
    assert truth.depth_m[59:61, 79:81].mean() == pytest.approx(
        0.3 / np.sin(np.radians(7)), rel=0.02
    )
    rays = camera.back_project(pixel_grid(camera), np.ones(camera.width * camera.height))
    down = -(mount.T_base_left[:3, :3] @ rays.T)[2].reshape(camera.height, camera.width)
    on_floor = truth.floor == 255
    assert on_floor.mean() > 0.3
    np.testing.assert_allclose(truth.depth_m[on_floor], 0.3 / down[on_floor], rtol=2e-3)


def test_floor_mask_is_where_the_points_lie_on_the_floor(room):
    frame, truth = room.frame(3), room.truth(3)
    points = room.camera.back_project(pixel_grid(room.camera), truth.depth_m.ravel())
    height_m = transform_points(frame.T_world_left, points)[:, 2].reshape(truth.floor.shape)
    assert set(np.unique(truth.floor)) == {0, 255}
    assert ((np.abs(height_m) < 0.004) == (truth.floor == 255)).mean() > 0.99


def test_true_disparity_carries_the_right_image_onto_the_left(room):
    frame, truth, camera = room.frame(2), room.truth(2), room.camera
    u, v = (axis.reshape(camera.height, camera.width) for axis in pixel_grid(camera).T)
    column = (u - truth.disparity_px).astype(np.float32)
    warped = cv2.remap(frame.right, column, v.astype(np.float32), cv2.INTER_LINEAR)
    error = np.abs(warped.astype(float) - frame.left)[column >= 0]
    shifted = cv2.remap(frame.right, column + 1, v.astype(np.float32), cv2.INTER_LINEAR)
    shifted_error = np.abs(shifted.astype(float) - frame.left)[column >= 0]
    assert np.median(error) < 2.0
    assert np.median(shifted_error) > 1.5 * np.median(error)


def test_what_the_camera_sees_standing_is_occupied_in_the_map(room):
    grid = room.true_map
    near = cv2.dilate((grid.cells == OCCUPIED).astype(np.uint8), np.ones((3, 3), np.uint8))
    for index in (0, room.frame_count - 1):
        points = room.camera.back_project(
            pixel_grid(room.camera), room.truth(index).depth_m.ravel()
        )
        world = transform_points(room.frame(index).T_world_left, points)
        standing = world[(world[:, 2] > 0.1) & (world[:, 2] < 0.9)]
        cells = ((standing[:, :2] - grid.origin_xy_m) / grid.resolution_m).astype(int)
        assert near[cells[:, 1], cells[:, 0]].mean() > 0.995


@pytest.mark.slow
def test_same_seed_same_images(room):
    first, again = room.frame(1), room.frame(1)
    np.testing.assert_array_equal(first.left, again.left)
    with simulate() as other:
        np.testing.assert_array_equal(other.frame(1).right, first.right)
    with simulate(seed=2) as other:
        assert (other.frame(1).left != first.left).mean() > 0.5


def test_unrectified_images_rectify_to_the_ideal_ones(room):
    camera = {**ROOM['camera'], 'distortion': [-0.1, 0.01, 0, 0, 0], 'misalignment_deg': 0.5}
    with simulate(camera=camera) as raw:
        frame = raw.frame(2)
        for side, image in zip(raw.imaging.raw, (frame.left, frame.right), strict=True):
            maps = cv2.initUndistortRectifyMap(
                side.K, side.D, side.R, side.P[:, :3], (160, 120), cv2.CV_32FC1
            )
            rectified = cv2.remap(image, maps[0], maps[1], cv2.INTER_LINEAR)
            ideal = room.frame(2).left if side is raw.imaging.raw[0] else room.frame(2).right
            inner = (slice(12, 108), slice(12, 148))
            error = np.abs(rectified.astype(float) - ideal)[inner]
            assert np.median(error) < 3.0


@pytest.mark.slow
def test_person_moves_through_the_picture():
    person = [{'points': [[2.0, -0.8], [2.0, 0.8]], 'speed_m_s': 0.8}]
    with simulate(people=person) as walk, simulate() as empty:
        for index in (0, 2):
            nearer = walk.truth(index).depth_m < empty.truth(index).depth_m - 0.2
            columns = np.nonzero(nearer.any(axis=0))[0]
            x, y, yaw = empty.drive.xy_yaw[index]
            y_person = -0.8 + 0.8 * empty.drive.times_s[index]
            bearing = np.arctan2(y_person - y, 2.0 - x) - yaw
            assert columns.mean() == pytest.approx(79.5 - 80 * np.tan(bearing), abs=8)
            # Its feet stand on the floor, and are not floor.
            assert (walk.truth(index).floor[nearer] == 0).all()
            moving = walk.moving_mask(index) == 255
            assert moving[nearer].all() and moving.sum() < 1.2 * nearer.sum()


@pytest.mark.slow
def test_a_mover_is_not_in_the_true_map_and_its_mask_is_written_for_every_frame(tmp_path):
    people = [{'points': [[2.0, -0.8], [2.0, 0.8]], 'start_s': 1.0}]
    cars = [{'points': [[1.5, 0.0], [3.0, 0.0]], 'size': [0.4, 0.3, 0.3], 'speed_m_s': 0.2}]
    with simulate(people=people, cars=cars) as moving, simulate() as empty:
        np.testing.assert_array_equal(moving.true_map.cells, empty.true_map.cells)
        record(moving, tmp_path / 'drive', RecordingOptions(floor_every=0))
        frames = moving.frame_count
    files = sorted((tmp_path / 'drive' / 'moving').iterdir())
    assert [file.name for file in files] == [f'{i:06d}.png' for i in range(frames)]
    share = [(cv2.imread(str(file), cv2.IMREAD_UNCHANGED) == 255).mean() for file in files]
    # The car from the start, the person beside it once it walks.
    assert 0 < share[0] < share[-1] < 0.5


def test_recording_has_the_layout_of_a_kitti_folder_with_truth(room, tmp_path):
    out, seen = tmp_path / 'drive', []
    record(room, out, RecordingOptions(floor_every=4, disparity=True), seen.append)
    assert seen == list(range(1, room.frame_count + 1))
    assert [p.name for p in tmp_path.iterdir()] == ['drive']
    names = {p.name for p in out.iterdir()}
    assert {'map.pgm', 'map.yaml', 'poses.txt', 'base_poses.txt', 'times.txt', 'calib.txt'} <= names
    assert len(list((out / 'image_1').iterdir())) == room.frame_count
    left = cv2.imread(str(out / 'image_0' / '000004.png'), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(left, room.frame(4).left)
    mask = cv2.imread(str(out / 'floor' / '000004.png'), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(mask, room.truth(4).floor)
    disparity = cv2.imread(str(out / 'disparity' / '000004.png'), cv2.IMREAD_UNCHANGED) / 256
    np.testing.assert_allclose(disparity, room.truth(4).disparity_px, atol=1 / 500)
    truth = load_truth(out)
    np.testing.assert_allclose(truth.start_pose, room.drive.xy_yaw[0], atol=1e-6)
    np.testing.assert_array_equal(truth.grid.cells, room.true_map.cells)
    times, poses = read_trajectory(out / 'poses.txt')
    np.testing.assert_allclose(times, room.drive.times_s, atol=1e-6)
    T_first_last = (
        np.linalg.inv(room.frame(0).T_world_left) @ room.frame(len(times) - 1).T_world_left
    )
    np.testing.assert_allclose(poses[-1], T_first_last, atol=1e-6)
    rows = dict(line.split(':') for line in (out / 'calib.txt').read_text().splitlines())
    assert float(rows['P1'].split()[3]) == pytest.approx(-80.0 * 0.12)
    record(room, out, RecordingOptions(floor_every=0))
    assert not (out / 'floor').exists()
    (out / 'times.txt').write_text('mine')
    with pytest.raises(InputError, match=r'holds times\.txt'):
        record(room, out, RecordingOptions())
    assert (out / 'times.txt').read_text() == 'mine'


@pytest.mark.slow
def test_labels_say_what_each_pixel_shows_and_whose_it_is(tmp_path):
    people = [{'points': [[2.0, -0.8], [2.0, 0.8]], 'start_s': 9.0}]
    cars = [{'points': [[1.5, 0.3], [3.0, 0.3]], 'size': [0.4, 0.3, 0.3], 'start_s': 9.0}]
    pane = [{'at': [1.2, -0.5], 'size': [0.02, 0.3, 1.0], 'texture': 'glass'}]
    path = {'waypoints': [[0, 0], [0.1, 0]]}
    with simulate(True, people=people, cars=cars, boxes=pane, path=path) as stage:
        record(stage, tmp_path / 'd', RecordingOptions(floor_every=1, labels=True))
        floor, behind = stage.truth(0).floor, stage.frame(0).left
    with simulate(people=people, cars=cars, boxes=[], path=path) as stage:
        without = stage.frame(0).left
    names = yaml.safe_load((tmp_path / 'd' / 'labels' / 'classes.yaml').read_text())
    number = {name: value for value, name in names.items()}
    labels, instances = (
        cv2.imread(str(tmp_path / 'd' / kind / '000000.png'), cv2.IMREAD_UNCHANGED)
        for kind in ('labels', 'instances')
    )
    np.testing.assert_array_equal(labels == number['floor'], floor == 255)
    np.testing.assert_array_equal(instances == 1, labels == number['person'])
    np.testing.assert_array_equal(instances == 2, labels == number['car'])
    assert (instances == 1).any() and (instances == 2).any()
    seen_through = labels == number['glass']
    assert seen_through.sum() > 100
    # A pane hides little of what is behind it.
    difference = np.abs(behind.astype(float) - without)[seen_through]
    assert 3 < np.median(difference) < 40


def test_unrectified_recording_has_ros_calibrations(tmp_path):
    camera = {**ROOM['camera'], 'distortion': [-0.1, 0.01, 0, 0, 0]}
    with simulate(camera=camera, path={'waypoints': [[0, 0], [0.1, 0]]}) as raw:
        record(raw, tmp_path / 'raw', RecordingOptions(floor_every=0))
        calibration = yaml.safe_load((tmp_path / 'raw' / 'right.yaml').read_text())
    assert not (tmp_path / 'raw' / 'calib.txt').exists()
    assert len(list((tmp_path / 'raw' / 'left').iterdir())) == raw.frame_count
    assert calibration['distortion_coefficients']['data'][0] == -0.1
    assert calibration['projection_matrix']['data'][3] == pytest.approx(-80.0 * 0.12)
    assert (calibration['image_width'], calibration['image_height']) == (160, 120)


def test_a_recording_that_fails_leaves_nothing(room, tmp_path):
    def stop(done):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record(room, tmp_path / 'drive', RecordingOptions(), stop)
    assert list(tmp_path.iterdir()) == []


def test_a_path_into_an_obstacle_is_refused():
    with pytest.raises(InputError, match='runs into an obstacle'):
        simulate(path={'waypoints': [[0, 0], [2.5, 0.6]]})


@pytest.mark.slow
@pytest.mark.parametrize('missing', ['GL', '(?<!E)GL'])
def test_without_a_gl_library_one_line_names_the_package(tmp_path, missing):
    # A ctypes that finds no GL library, or EGL alone, as on a machine without them.
    (tmp_path / 'sitecustomize.py').write_text(
        'import ctypes, ctypes.util, re\n'
        f'missing = re.compile({missing!r}).search\n'
        'find, init = ctypes.util.find_library, ctypes.CDLL.__init__\n'
        'def no_gl(self, name, *rest, **more):\n'
        '    if name and missing(str(name)): raise OSError(name)\n'
        '    init(self, name, *rest, **more)\n'
        'ctypes.util.find_library = lambda name: None if missing(name) else find(name)\n'
        'ctypes.CDLL.__init__ = no_gl\n'
    )
    program = (
        'import sys\n'
        'from segfloor_ros.core.errors import SegfloorError\n'
        'from segfloor_ros.apps.simulation.scene_file import open_scene\n'
        'from segfloor_ros.apps.simulation.simulation import Simulation\n'
        'try: Simulation(open_scene("corridor2"))\n'
        'except SegfloorError as error: print(error)\n'
    )
    path = os.pathsep.join([str(tmp_path), str(REPOSITORY)])
    done = subprocess.run(
        [sys.executable, '-c', program],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, 'PYTHONPATH': path, 'MUJOCO_GL': 'egl'},
    )
    assert 'libegl1' in done.stdout or 'pip install' in done.stdout
    assert done.stdout.count('\n') == 1
    assert done.stderr == ''
