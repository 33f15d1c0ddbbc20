"""What moves is found, and neither bends the path nor enters the map."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from moving_drive import MovingDrive
from stereo_room import CAMERA, MOUNT

from segfloor_ros.core.camera.pixels import union
from segfloor_ros.core.contracts import NO_POINT
from segfloor_ros.core.geometry import invert
from segfloor_ros.core.plugins.assembly import equipped_slam
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.slam.tracking.images import dilate, is_inside

FRAMES = 36


def crossing(index):
    """From the right to the left at 1.6 m ahead of the camera, 4.5 cm a frame, after a second."""
    return (0.03 * index + 1.6, -1.3 + 0.045 * (index - 8)) if index >= 8 else None


def standing(index):
    return (2.6, 0.3)


CROSSING = MovingDrive(crossing)


@cache
def run(drive, with_masks=False, detect_moving=True, **settings):
    own = StereoSlamSettings(detect_moving=detect_moving, **settings)
    slam = equipped_slam(CAMERA, own, MOUNT)
    results = []
    for index in range(FRAMES):
        frame = drive.frame(index)
        if with_masks:
            frame = replace(frame, excluded=drive.mask(index))
        results += slam.process(frame)
    return results


def worst_error_m(drive, results):
    assert all(result.tracked for result in results)
    poses = [invert(drive.pose(r.index)) @ r.T_map_odom @ r.T_odom_base for r in results]
    return max(float(np.linalg.norm(pose[:3, 3])) for pose in poses)


def keyframes(results):
    return [result.keyframe for result in results if result.keyframe is not None]


def test_regions_unite_and_grow():
    a, b = (np.zeros((5, 8), np.uint8) for _ in range(2))
    a[2, 2], b[2, 5] = 255, 255
    both = union(a, b)
    assert (both > 0).sum() == 2 and union(None, None) is None and union(a, None) is a
    grown = dilate(both, 1)
    assert grown[2, 1] == grown[1, 2] == 255 and grown[0, 2] == grown[1, 1] == 0
    inside = is_inside(both, np.array([[2.4, 1.6], [3.6, 2.0], [-3.0, 2.0]]))
    np.testing.assert_array_equal(inside, [True, False, False])
    assert not is_inside(None, np.zeros((3, 2))).any()


def test_features_and_points_stay_out_of_the_masks_that_are_given():
    drive = CROSSING
    results = run(drive, with_masks=True, detect_moving=False)
    assert worst_error_m(drive, results) < 0.01
    for keyframe in keyframes(results):
        wide = dilate(drive.mask(keyframe.frame_index), 5)
        # Once matched, features are moved by up to two pixels to where their points lie.
        assert not is_inside(drive.mask(keyframe.frame_index), keyframe.features.uv_px).any()
        np.testing.assert_array_equal(keyframe.moving, wide)
    without = keyframes(run(drive, detect_moving=False))
    on_board = [is_inside(drive.mask(k.frame_index), k.features.uv_px).sum() for k in without]
    assert max(on_board) > 50


def test_what_crosses_is_found_without_masks():
    drive = CROSSING
    results = run(drive)
    assert worst_error_m(drive, results) < 0.01
    overlaps = []
    for keyframe in keyframes(results):
        truth = drive.mask(keyframe.frame_index) > 0
        found = keyframe.moving > 0 if keyframe.moving is not None else np.zeros_like(truth)
        # Its fringe is as wide as the matcher's block; feet would reach farther down.
        wide = dilate(drive.mask(keyframe.frame_index), 12) > 0
        below = np.maximum.accumulate(wide, axis=0)
        assert (found & ~below).mean() < 0.003
        assert (found & ~wide).mean() < 0.006
        if truth.mean() > 0.05:
            overlaps.append((found & truth).sum() / truth.sum())
    assert np.median(overlaps) > 0.8


def test_a_late_mask_takes_the_points_back_that_its_keyframe_has_made():
    drive = MovingDrive(standing)
    slam = equipped_slam(CAMERA, StereoSlamSettings(detect_moving=False), MOUNT)
    for index in range(12):
        slam.process(drive.frame(index))
    keyframe = slam.map.keyframes[-1]
    inside = is_inside(drive.mask(keyframe.frame_index), keyframe.observations.uvd_px[:, :2])
    ids = keyframe.point_id.copy()
    own = (ids != NO_POINT) & (slam.map.points['born'][ids] == keyframe.index)
    assert (own & inside).any() and (own & ~inside).any()
    slam.late_masks.add(keyframe.stamp_ns + 1, drive.mask(keyframe.frame_index))
    slam.late_masks.add(keyframe.stamp_ns, drive.mask(keyframe.frame_index))
    assert slam.process(drive.frame(12))[0].tracked
    assert (keyframe.point_id[own & inside] == NO_POINT).all()
    assert not slam.map.alive[ids[own & inside]].any()
    wide = dilate(drive.mask(keyframe.frame_index), 6)
    far = own & ~is_inside(wide, keyframe.observations.uvd_px[:, :2])
    np.testing.assert_array_equal(keyframe.point_id[far], ids[far])
    # What keyframes before it have made is not its to take back.
    older = (ids != NO_POINT) & inside & ~own
    assert older.any()
    np.testing.assert_array_equal(keyframe.point_id[older], ids[older])


@pytest.mark.slow
@pytest.mark.parametrize('place', [lambda index: None, standing])
def test_what_stands_is_kept(place):
    results = run(MovingDrive(place))
    shares = [0.0 if k.moving is None else (k.moving > 0).mean() for k in keyframes(results)]
    assert max(shares) < 0.01 and np.mean(shares) < 0.001


def test_the_points_of_what_crosses_have_its_place_and_velocity():
    drive = CROSSING
    seen = [(r.index, r.moving) for r in run(drive) if r.moving is not None]
    # A search every third frame or oftener.
    assert len(seen) > FRAMES / 3 - 1
    velocities, distances = [], []
    for index, moving in seen:
        if index < 16 or len(moving.xyz_map) < 30:
            continue
        x, y = crossing(index)
        distances.append(np.median(np.abs(moving.xyz_map[:, 0] - x)))
        assert abs(np.median(moving.xyz_map[:, 1]) - y) < 0.25
        velocities.append(np.nanmedian(moving.velocity_m_s, axis=0))
    assert len(velocities) >= 4 and np.median(distances) < 0.1
    np.testing.assert_allclose(np.median(velocities, axis=0), [0.3, 0.45, 0.0], atol=0.12)


@pytest.mark.slow
def test_points_of_what_has_left_leave_the_map():
    def leaves(index):
        return (2.2, 0.0) if index < 14 else None

    ahead = [[], []]
    for detect, counts in zip((True, False), ahead, strict=True):
        for keyframe in keyframes(run(MovingDrive(leaves), detect_moving=detect)):
            near = keyframe.cloud.xyz_map
            on_board = (np.abs(near[:, 0] - 2.2) < 0.15) & (np.abs(near[:, 1]) < 0.3)
            counts.append((on_board & (near[:, 2] > 0.1)).sum())
    assert max(ahead[0]) > 20
    assert ahead[0][-1] < 0.1 * max(ahead[0]) and ahead[0][-1] < ahead[1][-1]


def walking_into_the_image(index):
    """From the left through the image, 0.4 m ahead of the camera, for four frames."""
    return (0.03 * index + 0.4, -0.28 + 0.12 * (index - 20)) if 20 <= index <= 23 else None


@pytest.mark.slow
def test_what_suddenly_fills_most_of_the_image_does_not_take_the_pose_along():
    drive = MovingDrive(walking_into_the_image)
    assert (drive.mask(22) > 0).mean() > 0.7
    assert worst_error_m(drive, run(drive)) < 0.02
