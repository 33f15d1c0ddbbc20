"""What mapping refuses: features at another depth than their point, and adjustments gone astray."""

from dataclasses import replace

import numpy as np
import pytest
from hand_made_maps import CAMERA, SCENES, add, seen

from segfloor_ros.core.contracts import NO_POINT
from segfloor_ros.core.geometry import make_transform, transform_points
from segfloor_ros.core.slam.mapping.keyframe_mapping import LocalMapper
from segfloor_ros.core.slam.rig import OffsetEstimate, Rig
from segfloor_ros.core.slam.sparse_map import SparseMap
from segfloor_ros.core.slam.tracking.patch_alignment import SIDE_PX
from segfloor_ros.core.twists import se3_exp


@pytest.fixture(params=SCENES)
def scene(request):
    """Points (24, 3) in front of keyframe 0."""
    return SCENES[request.param]


def mapped(points):
    """A map of points, made by keyframe 0, and a mapper without any offset."""
    sparse_map = SparseMap(Rig(CAMERA))
    rows = np.arange(len(points))
    add(sparse_map, seen(points, 0, [NO_POINT] * len(points)), rows, points)
    return sparse_map, LocalMapper(sparse_map)


def patches(points):
    return np.zeros((len(points), SIDE_PX, SIDE_PX), np.uint8)


def test_an_adjustment_that_loses_what_the_newest_keyframe_saw_changes_nothing(scene):
    points = scene
    sparse_map, mapper = mapped(points)
    second = seen(points, 1, np.arange(len(points)), x=0.1)
    mapper.insert(second, patches(points))
    before, mapped_before = second.T_camera_world.copy(), sparse_map.xyz_world.copy()
    adjustment = mapper.plan_adjustment(second)
    result = mapper.solve(adjustment)
    turned = make_transform(np.eye(3), np.array([0.5, 0.0, 0.0])) @ result.T_camera_world
    newest = adjustment.edge_keyframe == 1
    astray = replace(result, T_camera_world=turned, inliers=~newest)
    mapper.apply(adjustment, astray)
    np.testing.assert_array_equal(second.T_camera_world, before)
    np.testing.assert_array_equal(sparse_map.xyz_world, mapped_before)
    mapper.apply(adjustment, replace(astray, inliers=np.ones_like(newest)))
    assert not np.array_equal(second.T_camera_world, before)


def test_an_adjustment_retires_views_of_what_others_have_seen_as_well(scene):
    points = scene
    sparse_map, mapper = mapped(points)
    for index in range(1, 9):
        view = seen(points, index, np.arange(len(points)), x=0.01 * index)
        mapper.insert(view, patches(points))
    adjustment = mapper.plan_adjustment(view)
    mapper.apply(adjustment, mapper.solve(adjustment))
    retired = [k.index for k in sparse_map.keyframes if k.retired]
    # Neither the first nor the latest three; three others must go on seeing each point.
    assert retired == [1, 2, 3, 4, 5]
    assert sparse_map.alive.all()


def test_new_points_are_where_their_disparities_without_the_offset_have_them(scene):
    points = scene
    sparse_map = SparseMap(Rig(CAMERA))
    sparse_map.rig.offset.estimate = OffsetEstimate(np.array([0.4, -0.3, 0.2]), np.eye(3))
    keyframe = seen(points, 0, [NO_POINT] * len(points))
    uvd_px = keyframe.observations.uvd_px
    right, below = ((uvd_px[:, :2] - (CAMERA.cx, CAMERA.cy)) / (CAMERA.width / 2)).T
    uvd_px[:, 2] += 0.4 - 0.3 * right + 0.2 * below
    # A camera that is neither at the origin nor level.
    keyframe.T_camera_world = se3_exp(np.array([0.5, -0.2, 1.0, 0.2, -0.4, 0.1]))
    LocalMapper(sparse_map).insert(keyframe, patches(points))
    expected = transform_points(keyframe.T_world_camera, points)
    np.testing.assert_allclose(sparse_map.xyz_world, expected, atol=1e-9)
