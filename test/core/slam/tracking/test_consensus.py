"""Two motions in one image: which of them is the camera's."""

from types import SimpleNamespace

import numpy as np
import pytest
from stereo_room import CAMERA, MOUNT

from segfloor_ros.core.geometry import Array, invert, transform_points
from segfloor_ros.core.slam.rig import Observations, Rig
from segfloor_ros.core.slam.tracking.pose import Consensus, refine_pose
from segfloor_ros.core.twists import se3_exp, se3_log

STILL, MOVING = 60, 140
TRUTH = se3_exp(np.array([0.02, -0.01, 0.05, 0.004, 0.02, -0.006]))
CARRIED = np.array([0.15, 0.0, 0.05])
"""How far what moves has come since it was mapped, in metres."""


def scene(observers_of_still: int, sigma_px: float = 0.3) -> tuple[SimpleNamespace, Observations]:
    """Points that stand still and, after them, more points that were carried on together."""
    rng = np.random.default_rng(4)
    count = STILL + MOVING
    points = np.column_stack(
        [rng.uniform(-1.5, 1.5, count), rng.uniform(-0.8, 0.2, count), rng.uniform(2, 5, count)]
    )
    now = points.copy()
    now[STILL:] += CARRIED
    observers = np.where(np.arange(count) < STILL, observers_of_still, 1)
    uvr = CAMERA.project(transform_points(TRUTH, now))
    uvd = np.column_stack([uvr[:, :2], uvr[:, 0] - uvr[:, 2]]) + rng.normal(0, sigma_px, (count, 3))
    sparse_map = SimpleNamespace(xyz_world=points, observer_count=observers, rig=Rig(CAMERA))
    return sparse_map, Observations(uvd, np.full((count, 3), sigma_px))


def error_m(T_camera_world: Array) -> float:
    return float(np.linalg.norm(se3_log(T_camera_world @ invert(TRUTH))[:3]))


def test_a_majority_that_moves_does_not_carry_the_pose_away():
    sparse_map, seen = scene(observers_of_still=4)
    ids = np.arange(STILL + MOVING, dtype=np.int32)
    of_most = refine_pose(CAMERA, np.eye(4), sparse_map.xyz_world, seen)
    assert error_m(of_most.T_camera_world) > 0.1
    found = Consensus(sparse_map).refine(np.eye(4), ids, seen)
    assert error_m(found.T_camera_world) < 0.01
    assert found.inliers[:STILL].mean() > 0.8
    assert not found.inliers[STILL:].any()


def test_points_on_the_floor_need_no_record():
    sparse_map, seen = scene(observers_of_still=1)
    ids = np.arange(STILL + MOVING, dtype=np.int32)
    consensus = Consensus(sparse_map)
    assert error_m(consensus.refine(np.eye(4), ids, seen).T_camera_world) > 0.1
    up = MOUNT.up_in_camera
    lifted = MOUNT.heights_m(sparse_map.xyz_world[:STILL])[:, None] * up
    on_floor = sparse_map.xyz_world[:STILL] - lifted
    ahead = on_floor[:, 2] > 1
    sparse_map.xyz_world[:STILL] = np.where(ahead[:, None], on_floor, sparse_map.xyz_world[:STILL])
    uvr = CAMERA.project(transform_points(TRUTH, sparse_map.xyz_world[:STILL]))
    seen.uvd_px[:STILL] = np.column_stack([uvr[:, :2], uvr[:, 0] - uvr[:, 2]])
    sparse_map.rig.mount = MOUNT
    assert error_m(consensus.refine(np.eye(4), ids, seen).T_camera_world) < 0.01


@pytest.mark.parametrize('observers', [1, 4])
def test_where_all_agree_the_pose_is_that_of_all(observers):
    sparse_map, seen = scene(observers_of_still=observers)
    ids = np.arange(STILL, dtype=np.int32)
    alone = seen.take(ids)
    found = Consensus(sparse_map).refine(np.eye(4), ids, alone)
    of_all = refine_pose(
        CAMERA, np.eye(4), sparse_map.xyz_world[ids], alone, readout=sparse_map.rig.shutter.expected
    )
    np.testing.assert_array_equal(found.T_camera_world, of_all.T_camera_world)
    np.testing.assert_array_equal(found.inliers, of_all.inliers)


def test_corners_of_what_moves_do_not_overrule_the_patches_of_the_same_image():
    sparse_map, seen = scene(observers_of_still=1)
    ids = np.arange(STILL + MOVING, dtype=np.int32)
    patches = refine_pose(CAMERA, TRUTH, sparse_map.xyz_world[:STILL], seen.take(ids[:STILL]))
    consensus = Consensus(sparse_map)
    alone = consensus.refine(np.eye(4), ids, seen)
    assert error_m(alone.T_camera_world) > 0.1
    found = consensus.refine(np.eye(4), ids, seen, known=patches)
    assert error_m(found.T_camera_world) < 0.01
    assert not found.inliers[STILL:].any()


def test_where_next_to_nothing_fits_the_patches_no_corner_agrees():
    sparse_map, seen = scene(observers_of_still=1)
    ids = np.arange(STILL, STILL + MOVING, dtype=np.int32)
    still = np.arange(STILL)
    patches = refine_pose(CAMERA, TRUTH, sparse_map.xyz_world[still], seen.take(still))
    found = Consensus(sparse_map).refine(np.eye(4), ids, seen.take(ids), known=patches)
    assert not found.inliers.any()


def test_a_known_pose_stands_however_few_corners_fit_it():
    sparse_map, seen = scene(observers_of_still=1)
    still, few = np.arange(STILL), np.arange(STILL - 10, STILL + 40, dtype=np.int32)
    patches = refine_pose(CAMERA, TRUTH, sparse_map.xyz_world[still], seen.take(still))
    found = Consensus(sparse_map).at(patches, few, seen.take(few))
    np.testing.assert_array_equal(found.T_camera_world, patches.T_camera_world)
    assert 7 <= found.inliers.sum() <= 10
    assert not found.inliers[10:].any()
