"""Duplicate points: found by pixel, depth and look; merged with all that hangs on them."""

import numpy as np
import pytest
from hand_made_maps import add, keyframe

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import NO_POINT
from segfloor_ros.core.geometry import transform_points
from segfloor_ros.core.slam.mapping.keyframe_mapping import find_duplicates, fuse_duplicates
from segfloor_ros.core.slam.rig import Rig
from segfloor_ros.core.slam.sparse_map import SparseMap

CAMERA = StereoCamera(640, 480, 300.0, 300.0, 319.5, 239.5, 0.1)


def seen_twice(second_xyz, descriptor=0):
    """Keyframes 0 and 1 made points 0, 1, 2 and 3, 4; keyframe 2 shares 1 with the first and sees
    points 5, 6 of its own. Point 5 lies at second_xyz; keyframe 0's point 0 at (0, 0, 2).
    """
    sparse_map = SparseMap(Rig(CAMERA))
    add(sparse_map, keyframe(0, [NO_POINT] * 3), [0, 1, 2], [[0, 0, 2], [0.5, 0, 2], [-0.5, 0, 2]])
    add(sparse_map, keyframe(1, [0, NO_POINT, NO_POINT]), [1, 2], [[0, 0.5, 2], [0, -0.5, 2]])
    third = keyframe(2, [NO_POINT, NO_POINT, 1])
    add(sparse_map, third, [0, 1], [second_xyz, [0.3, 0.3, 2]])
    sparse_map.descriptor[:] = np.arange(7, dtype=np.uint8)[:, None] * 37
    sparse_map.descriptor[5] = sparse_map.descriptor[0] ^ descriptor
    return sparse_map, third


def duplicates(*arguments):
    a, b = find_duplicates(*arguments)
    return sorted(zip(a.tolist(), b.tolist(), strict=True))


def test_same_pixel_depth_and_look_is_a_duplicate():
    # A pixel is 2 m / 300 = 6.7 mm wide there; disparity 15 px changes by a pixel per 0.13 m.
    assert duplicates(*seen_twice([0.006, 0.0, 2.05])) == [(5, 0)]


def test_another_pixel_depth_or_look_is_not():
    assert duplicates(*seen_twice([0.02, 0.0, 2.0])) == []
    assert duplicates(*seen_twice([0.0, 0.0, 2.4])) == []
    assert duplicates(*seen_twice([0.0, 0.0, 2.0], descriptor=0x0F)) == []


def test_the_older_id_survives_with_all_observations():
    sparse_map, third = seen_twice([0.006, 0.0, 2.05])
    assert fuse_duplicates(sparse_map, third) == 1
    np.testing.assert_array_equal(np.flatnonzero(~sparse_map.alive), [5])
    np.testing.assert_array_equal(third.point_id, [0, 6, 1])
    assert sparse_map.observer_count[0] == 3
    # Two keyframes knew point 0, one point 5: its position stays, the newest look is taken on.
    np.testing.assert_allclose(sparse_map.xyz_world[0], [0, 0, 2])
    assert sparse_map.viewing_distance_m[0] == pytest.approx(np.linalg.norm([0.006, 0.0, 2.05]))
    points, keyframes, rows = sparse_map.edges_of(np.array([0, 5]))
    np.testing.assert_array_equal(points, [0, 0, 0])
    np.testing.assert_array_equal(keyframes, [0, 1, 2])
    np.testing.assert_array_equal(rows, [0, 0, 0])


def test_what_one_keyframe_sees_as_two_stays_two():
    sparse_map, third = seen_twice([0.0, 0.0, 2.0])
    fourth = keyframe(3, [0, 5])
    add(sparse_map, fourth)
    np.testing.assert_array_equal(
        sparse_map.seen_together(np.array([5, 6]), np.array([0, 2])), [True, False]
    )
    assert fuse_duplicates(sparse_map, third) == 0
    assert sparse_map.alive.all()


def test_the_projection_of_a_merged_point_stays_where_it_was():
    sparse_map, third = seen_twice([0.006, 0.0, 2.05])
    before = CAMERA.project(transform_points(third.T_camera_world, sparse_map.xyz_world[[5]]))
    fuse_duplicates(sparse_map, third)
    after = CAMERA.project(transform_points(third.T_camera_world, sparse_map.xyz_world[[0]]))
    assert np.abs(before - after).max() < 2.0
