"""Points from the parallax of two keyframes without stereo depth."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.geometry import invert, make_transform, transform_points
from segfloor_ros.slam.map.records import KeyframeRecord
from segfloor_ros.slam.map.residuals import Observations
from segfloor_ros.slam.map.sparse_map import SparseMap
from segfloor_ros.slam.mapping.triangulation import fundamental_matrix, triangulate_between
from segfloor_ros.slam.results import NO_POINT
from segfloor_ros.slam.tracking.features import Features

CAMERA = StereoCamera(640, 480, 300.0, 300.0, 319.5, 239.5, 0.1)
POINTS = np.random.default_rng(1).uniform([-3, -2, 6], [3, 2, 14], (60, 3))
LOOK = np.random.default_rng(2).integers(0, 256, (60, 32), dtype=np.uint8)
OCTAVE = np.ones(60, np.uint8)


def view(index, T_world_camera, points=POINTS, octave=OCTAVE, disparity=np.nan):
    """A keyframe whose feature i shows point i, without a map point and without disparity."""
    uvr = CAMERA.project(transform_points(invert(T_world_camera), points))
    uvd = np.column_stack([uvr[:, :2], np.full(len(points), disparity)])
    found = Features(uvd[:, :2].astype(np.float32), octave, LOOK)
    observations = Observations(uvd, np.full(uvd.shape, 0.5))
    none = np.full(len(points), NO_POINT, np.int32)
    pose = invert(T_world_camera)
    return KeyframeRecord(index, index, index * 1000, pose, found, observations, none)


def moved(x=0.8, z=0.3, yaw=0.05):
    R = Rotation.from_euler('y', yaw).as_matrix()
    return make_transform(R, np.array([x, 0.1, z]))


@pytest.fixture
def pair():
    return view(1, moved()), view(0, np.eye(4))


def test_the_fundamental_matrix_joins_pixels_of_the_same_point(pair):
    F = fundamental_matrix(CAMERA, *pair)
    uv, uv_other = (
        np.column_stack([k.observations.uvd_px[:, :2], np.ones(len(POINTS))]) for k in pair
    )
    assert np.abs(np.einsum('ni,ij,nj->n', uv, F, uv_other)).max() < 1e-9


def test_rays_with_parallax_cross_at_the_point(pair):
    new = triangulate_between(CAMERA, *pair, 0.0)
    assert len(new.rows) > 50
    np.testing.assert_array_equal(new.rows, new.other_rows)
    np.testing.assert_allclose(new.xyz_world, POINTS[new.rows], atol=1e-6)


def test_no_point_without_parallax():
    turned = view(1, moved(0.0, 0.0, 0.1))
    barely = view(1, moved(0.03, 0.0, 0.0))
    for keyframe in (turned, barely):
        assert len(triangulate_between(CAMERA, keyframe, view(0, np.eye(4)), 0.0).rows) == 0


def test_a_disparity_that_contradicts_and_a_size_that_does_not_fit_are_refused():
    other = view(0, np.eye(4))
    # True disparities lie between 2.1 and 5 px.
    wrong = view(1, moved(), disparity=20.0)
    assert len(triangulate_between(CAMERA, wrong, other, 0.0).rows) == 0
    assert len(triangulate_between(CAMERA, view(1, moved()), other, 0.0).rows) > 50
    smaller = view(1, moved(), octave=OCTAVE + 5)
    assert len(triangulate_between(CAMERA, smaller, other, 0.0).rows) == 0


def test_features_of_known_points_are_left_alone(pair):
    pair[0].point_id[:30] = 7
    new = triangulate_between(CAMERA, *pair, 0.0)
    assert (new.rows >= 30).all()


def test_both_keyframes_observe_the_new_points(pair):
    sparse_map = SparseMap()
    patches = np.zeros((len(POINTS), 11, 11), np.uint8)
    for keyframe in reversed(pair):
        sparse_map.add_keyframe(keyframe, patches, np.zeros(0, np.intp), np.zeros((0, 3)))
    rows = np.array([3, 9])
    sparse_map.add_points_between(*(pair[0], rows, pair[1], rows), POINTS[rows], patches)
    np.testing.assert_array_equal(sparse_map.observer_count, [2, 2])
    np.testing.assert_array_equal(pair[0].point_id[rows], [0, 1])
    np.testing.assert_array_equal(pair[1].point_id[rows], [0, 1])
    np.testing.assert_array_equal(sparse_map.edges_of(np.array([1]))[1], [1, 0])
    np.testing.assert_array_equal(sparse_map.descriptor, LOOK[rows])
