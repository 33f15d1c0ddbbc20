"""Results leave SLAM in ROS frames: the base on its mount, with the covariance of its pose."""

from dataclasses import replace

import numpy as np
from sampled_poses import assert_spread, drawn_poses, twists_from, uneven_covariance
from stereo_room import CAMERA, MOUNT

from segfloor_ros.core.contracts import FrameResult, MovingPoints
from segfloor_ros.core.geometry import Array, invert, make_transform
from segfloor_ros.core.plugins.assembly import equipped_slam
from segfloor_ros.core.slam.held_results import in_map
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.twists import rotation_vectors, se3_exp

RNG = np.random.default_rng(11)
T_BASE_LEFT = se3_exp(np.array([0.3, -0.1, 0.5, -1.4, 0.2, -1.5]))
T_CAMERA_WORLD = se3_exp(np.array([1.0, 0.4, -2.0, 0.3, 1.1, -0.4]))


def result(covariance: np.ndarray) -> FrameResult:
    T_odom_camera = invert(T_CAMERA_WORLD)
    return FrameResult(0, 0, True, T_odom_camera, np.eye(4), covariance, 50, 'tracking', 0)


def test_the_base_is_where_its_camera_is_mounted() -> None:
    found = in_map(result(np.eye(6)), T_BASE_LEFT)
    # The first camera is T_BASE_LEFT in `map`, this one has moved from there.
    expected = T_BASE_LEFT @ invert(T_CAMERA_WORLD) @ invert(T_BASE_LEFT)
    np.testing.assert_allclose(found.T_odom_base, expected, atol=1e-12)


def test_a_correction_of_the_odometry_brings_the_base_to_where_its_camera_is_in_the_map() -> None:
    T_world_odom = se3_exp(np.array([0.2, -0.3, 0.1, 0.1, -0.2, 0.5]))
    found = in_map(replace(result(np.eye(6)), T_map_odom=T_world_odom), T_BASE_LEFT)
    expected = T_BASE_LEFT @ T_world_odom @ invert(T_CAMERA_WORLD) @ invert(T_BASE_LEFT)
    np.testing.assert_allclose(found.T_map_odom @ found.T_odom_base, expected, atol=1e-12)


def test_what_moves_goes_in_the_map_from_where_it_was_to_where_it_is() -> None:
    before = RNG.normal(size=(5, 3)) + np.array([0.0, 0.0, 4.0])
    velocity = RNG.normal(size=(5, 3))
    was, will = (
        in_map(replace(result(np.eye(6)), moving=MovingPoints(xyz, velocity)), T_BASE_LEFT).moving
        for xyz in (before, before + 0.1 * velocity)
    )
    assert was is not None and will is not None
    gone = was.xyz_map + 0.1 * was.velocity_m_s
    np.testing.assert_allclose(gone, will.xyz_map, atol=1e-5)


def errors_from(T: Array, samples: Array) -> Array:
    """Return the errors (N, 6) of the place and the turn of samples (N, 4, 4), in the axes of the
    frame in which T (4, 4) and they are given.
    """
    turns = rotation_vectors(samples[:, :3, :3] @ T[:3, :3].T)
    return np.concatenate([samples[:, :3, 3] - T[:3, 3], turns], axis=1)


T_MAP_ODOM = se3_exp(np.array([0.2, -0.3, 0.1, 0.4, -0.3, 0.9]))


def test_the_covariance_is_that_of_the_place_and_the_turn_of_the_base_in_odom_and_map() -> None:
    covariance = uneven_covariance(RNG, 3.0)
    T_world_odom = invert(T_BASE_LEFT) @ T_MAP_ODOM @ T_BASE_LEFT
    found = in_map(replace(result(covariance), T_map_odom=T_world_odom), T_BASE_LEFT)
    cameras = drawn_poses(RNG, T_CAMERA_WORLD, covariance)
    bases = T_BASE_LEFT @ invert(cameras) @ invert(T_BASE_LEFT)
    assert_spread(errors_from(found.T_odom_base, bases), found.covariance)
    T_map_base = found.T_map_odom @ found.T_odom_base
    assert_spread(errors_from(T_map_base, found.T_map_odom @ bases), found.covariance_in_map)


def test_a_pose_is_as_unsure_as_where_its_map_began_and_the_way_since() -> None:
    """A drive that was broken off maps on its own, from a place that is unsure."""
    began = se3_exp(np.array([-0.6, 0.8, 0.3, -0.5, 0.4, 0.7]))
    of_start, of_way = uneven_covariance(RNG, 4.0), uneven_covariance(RNG)
    slam = equipped_slam(CAMERA, StereoSlamSettings(), MOUNT)
    slam.front_end.motion.take(T_CAMERA_WORLD, of_way, 0)
    slam.session.unsure_start = began, of_start
    last = slam.last_pose
    assert last is not None
    way = drawn_poses(RNG, T_CAMERA_WORLD @ invert(began), of_way)
    samples = way @ drawn_poses(RNG, began, of_start)
    assert_spread(twists_from(T_CAMERA_WORLD, samples), last.covariance)


def test_a_tilted_mount_turns_the_axes_of_the_covariance() -> None:
    """What is unsure along the view of a camera that looks left is unsure to the left."""
    along_view = np.diag([0.0, 0.0, 1e-4, 0.0, 0.0, 0.0])
    R_base_left = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    still = FrameResult(0, 0, True, np.eye(4), np.eye(4), along_view, 50, 'tracking', 0)
    found = in_map(still, make_transform(R_base_left, np.zeros(3))).covariance
    np.testing.assert_allclose(found, np.diag([0.0, 1e-4, 0.0, 0.0, 0.0, 0.0]), atol=1e-12)


def test_the_covariance_in_the_map_is_turned_along_with_the_odometry() -> None:
    """A quarter turn to the left: what is unsure ahead in `odom` is unsure to the left in `map`."""
    T_map_odom = make_transform(
        np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([3.0, 1.0, 0.0])
    )
    covariance = np.diag([4.0, 1.0, 0.5, 0.3, 0.1, 0.2])
    covariance[0, 5] = covariance[5, 0] = 0.25
    found = replace(result(covariance), T_map_odom=T_map_odom).covariance_in_map
    expected = np.diag([1.0, 4.0, 0.5, 0.1, 0.3, 0.2])
    expected[1, 5] = expected[5, 1] = 0.25
    np.testing.assert_allclose(found, expected, atol=1e-12)
