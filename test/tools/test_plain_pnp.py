"""The plain method places what is seen and nothing else, and rows say where SLAM does worse."""

import dataclasses

import numpy as np
import pytest
from stereo_drive import room_drive
from stereo_room import CAMERA, MOUNT

from segfloor_ros.core.geometry import invert, make_transform
from segfloor_ros.core.twists import se3_exp
from segfloor_ros.nodes.configuration import resolve
from tools.plain_pnp import Row, arrow, compare_steps, is_wrong, rows_by_name, write_rows
from tools.plain_tracker import (
    PlainSteps,
    chance_of_match,
    distinct,
    needed_inliers,
    place,
    plain_steps,
    sgbm_disparity,
)
from tools.recorded_frames import in_steps, motions, poses_at, shrunk, with_noise
from tools.tracked_frames import track_frames

FRAMES = 5


@pytest.fixture(scope='module')
def drive():
    """Frames of a generated room, and where the left camera was."""
    frames, T_world_base = room_drive(FRAMES)
    return frames, np.array(T_world_base) @ MOUNT.T_base_left


@pytest.fixture(scope='module')
def plain(drive):
    frames, _ = drive
    return plain_steps(((f.left, sgbm_disparity(f.left, f.right)) for f in frames), CAMERA)


def test_the_steps_of_a_drive_are_placed(drive, plain, tmp_path) -> None:
    assert plain.placed.tolist() == [False] + [True] * (FRAMES - 1)
    off = invert(motions(drive[1])[1:]) @ invert(plain.T_now_before[1:])
    # Of steps of 6 cm, with the ORB of whatever OpenCV is installed.
    assert np.median(np.linalg.norm(off[:, :3, 3], axis=1)) < 0.04
    plain.save(tmp_path / 'folder' / 'plain.npz')
    read = PlainSteps.read(tmp_path / 'folder' / 'plain.npz')
    np.testing.assert_array_equal(read.T_now_before, plain.T_now_before)
    np.testing.assert_array_equal(read.placed, plain.placed)


def test_chance_matches_place_nothing() -> None:
    rng = np.random.default_rng(0)
    for count in (5, 20, 60, 200):
        size = CAMERA.width, CAMERA.height
        pixels, elsewhere = rng.uniform(0, size, (2, count, 2))
        points = CAMERA.back_project(elsewhere, rng.uniform(1, 5, count))
        _, matches, inliers, needed = place(points, pixels, CAMERA)
        assert inliers < needed
        assert matches == len(distinct(pixels))


def test_more_matches_and_crowds_take_more_inliers() -> None:
    # By hand for N = 10, p = 1e-4: NFA(6) = 4 7 C(10,6) C(6,3) 1e-12 = 1.2e-7, NFA(5) = 7e-4.
    assert needed_inliers(10, 1e-4) == 5
    assert needed_inliers(4, 1e-4) == 5
    assert needed_inliers(100, 1e-4) < needed_inliers(1000, 1e-4) < needed_inliers(1000, 1e-3)
    assert needed_inliers(6, 0.5) == 7  # never enough
    spread = np.stack(np.meshgrid(np.arange(0, 300, 20), np.arange(0, 200, 20)), 2).reshape(-1, 2)
    area = 9 * np.pi / (CAMERA.width * CAMERA.height)
    assert chance_of_match(spread.astype(float), CAMERA) == pytest.approx(area)
    assert chance_of_match(spread / 20.0, CAMERA) > 10 * area
    assert len(distinct(np.array([[10.0, 10], [10.5, 10], [40, 10]]))) == 2


def test_a_step_is_wrong_where_slam_errs_alone() -> None:
    nan = np.nan
    plain_m = np.array([0.01, 0.01, 0.03, 0.2, nan, 0.01])
    slam_m = np.array([0.04, 0.06, 0.08, 0.9, 0.9, nan])
    assert is_wrong(plain_m, slam_m, np.full(6, 0.2)).tolist() == [False, True, *[False] * 4]


def test_rows_say_what_slam_misses(drive, plain, tmp_path) -> None:
    frames, true = drive
    slam = track_frames(CAMERA, frames, (), resolve(), with_mount=False)
    row = compare_steps('room', 'rate 1', plain, slam, true)
    assert (row.placed, row.tracked, row.missed, row.wrong) == (FRAMES - 1, FRAMES, [], [])
    assert row.slam_max_m is not None
    assert row.slam_max_m < 0.02
    T = slam.T_map_left.copy()
    T[3] = np.nan
    lost = dataclasses.replace(slam, T_map_left=T)
    assert compare_steps('room', 'rate 1', plain, lost, None).missed == [3, 4]
    T = slam.T_map_left.copy()
    T[4, :3, 3] += 0.3
    off = dataclasses.replace(slam, T_map_left=T)
    assert compare_steps('room', 'rate 1', plain, off, true).wrong == [4]
    write_rows(tmp_path / 'rows.json', [row])
    read = rows_by_name(tmp_path / 'rows.json')['room, rate 1']
    assert isinstance(read, Row)
    assert read == row
    assert (arrow('', '3'), arrow('3', '3'), arrow('2', '3')) == ('3', '3', '2 → 3')


def test_true_poses_are_those_of_the_time() -> None:
    twists = np.array([[0.0, 0, 0, 0, 0, 0], [0.2, 0, 0, 0, 0, 0.4], [1, 0, 0, 0, 0, 1]])
    times_s, poses = np.array([1.0, 1.1, 3.0]), se3_exp(twists)
    found = poses_at(times_s, poses, np.array([1.0, 1.05, 1.1, 2.0, 3.0, 3.1]))
    np.testing.assert_allclose(found[[0, 2, 4]], poses, atol=1e-9)
    np.testing.assert_allclose(found[1][:3, 3], poses[1][:3, 3] / 2)
    assert np.isnan(found[[3, 5]]).all()
    step = motions(poses)
    assert np.isnan(step[0]).all()
    np.testing.assert_allclose(poses[1] @ step[2], poses[2], atol=1e-12)


def test_frames_are_changed_as_their_variant_says(drive) -> None:
    frames, _ = drive
    steps = in_steps(np.array([[0.2, 0.4, 3.3, np.nan]], np.float32), 1.0)
    np.testing.assert_array_equal(steps, np.array([[np.nan, np.nan, 3, np.nan]], np.float32))
    noisy = with_noise(frames[0], 4.0)
    np.testing.assert_array_equal(noisy.left, with_noise(frames[0], 4.0).left)
    assert 2 < np.std(noisy.left - frames[0].left.astype(float)) < 6
    small, (frame,) = shrunk(CAMERA, frames[:1])
    assert frame.left.shape == frame.right.shape == (small.height, small.width)
    point = make_transform(np.eye(3), np.array([0.3, -0.2, 2.0]))[None, :3, 3]
    scale = small.width / CAMERA.width
    before, after = CAMERA.project(point)[0], small.project(point)[0]
    np.testing.assert_allclose((after[:2] + 0.5), (before[:2] + 0.5) * scale, atol=0.01)
