"""What mapping refuses: features at another depth than their point, and adjustments gone astray."""

from dataclasses import replace

import numpy as np
from test_sparse_map import add, keyframe

from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.geometry import make_transform
from segfloor_ros.slam.mapping import LocalMapper
from segfloor_ros.slam.patch_alignment import SIDE_PX
from segfloor_ros.slam.residuals import Observations
from segfloor_ros.slam.results import NO_POINT
from segfloor_ros.slam.settings import StereoSlamSettings
from segfloor_ros.slam.sparse_map import SparseMap

# f b = 30 px m: at 2 m a disparity of 15 px.
CAMERA = StereoCamera(640, 480, 300.0, 300.0, 319.5, 239.5, 0.1)
POINTS = np.array([[x, y, 2.0] for x in (-1.0, -0.3, 0.4, 1.1) for y in (-0.6, -0.1, 0.5, 0.9)])


def seen(index, point_id, disparity_px, x=0.0):
    """A keyframe at x that sees POINTS at their pixels, with the disparities given."""
    record = keyframe(index, point_id, x)
    uvd = CAMERA.project(POINTS - [x, 0.0, 0.0])
    uvd[:, 2] = disparity_px
    return replace(record, observations=Observations(uvd, np.full((len(POINTS), 3), 0.5)))


def mapped():
    """A map of POINTS, made by keyframe 0, and a mapper without any offset."""
    sparse_map = SparseMap()
    rows = np.arange(len(POINTS))
    add(sparse_map, seen(0, [NO_POINT] * len(POINTS), 15.0), rows, POINTS)
    return sparse_map, LocalMapper(CAMERA, StereoSlamSettings())


def patches():
    return np.zeros((len(POINTS), SIDE_PX, SIDE_PX), np.uint8)


def test_a_feature_whose_disparity_contradicts_its_point_gets_one_of_its_own():
    sparse_map, mapper = mapped()
    measured = np.full(len(POINTS), 15.0)
    measured[3] = 25.0
    measured[5] = np.nan
    second = seen(1, np.arange(len(POINTS)), measured, x=0.1)
    mapper.insert(sparse_map, second, patches())
    kept = np.arange(len(POINTS)) != 3
    np.testing.assert_array_equal(second.point_id[kept], np.flatnonzero(kept))
    assert second.point_id[3] == len(POINTS)
    # 30 px m / 25 px
    np.testing.assert_allclose(sparse_map.xyz_world[len(POINTS), 2], 1.2)


def test_an_adjustment_that_loses_what_the_newest_keyframe_saw_changes_nothing():
    sparse_map, mapper = mapped()
    second = seen(1, np.arange(len(POINTS)), 15.0, x=0.1)
    mapper.insert(sparse_map, second, patches())
    before, points = second.T_camera_world.copy(), sparse_map.xyz_world.copy()
    adjustment = mapper.plan_adjustment(sparse_map, second)
    result = mapper.solve(adjustment)
    turned = make_transform(np.eye(3), np.array([0.5, 0.0, 0.0])) @ result.T_camera_world
    newest = adjustment.edge_keyframe == 1
    astray = replace(result, T_camera_world=turned, inliers=~newest)
    mapper.apply(sparse_map, adjustment, astray)
    np.testing.assert_array_equal(second.T_camera_world, before)
    np.testing.assert_array_equal(sparse_map.xyz_world, points)
    mapper.apply(sparse_map, adjustment, replace(astray, inliers=np.ones_like(newest)))
    assert not np.array_equal(second.T_camera_world, before)


def test_an_adjustment_retires_views_of_what_others_have_seen_as_well():
    sparse_map, mapper = mapped()
    for index in range(1, 9):
        view = seen(index, np.arange(len(POINTS)), 15.0, x=0.01 * index)
        mapper.insert(sparse_map, view, patches())
    adjustment = mapper.plan_adjustment(sparse_map, view)
    mapper.apply(sparse_map, adjustment, mapper.solve(adjustment))
    retired = [k.index for k in sparse_map.keyframes if k.retired]
    # Neither the first nor the latest three; three others must go on seeing each point.
    assert retired == [1, 2, 3, 4, 5]
    assert sparse_map.alive.all()
