"""Rigid motions: round trips and small cases worked out by hand."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import Mount
from segfloor_ros.core.errors import CalibrationError
from segfloor_ros.core.geometry import (
    R_ROS_OPTICAL,
    angles_of_rotation,
    invert,
    make_transform,
    rotation_angle,
    rotation_from_angles,
    transform_points,
)
from segfloor_ros.core.quaternions import quaternion_xyzw, transform_from_quaternion
from segfloor_ros.core.twists import rotation_vectors, rotations_by, se3_exp, se3_log


@pytest.mark.parametrize('scale', [1e-9, 1e-3, 0.5, 2.5])
def test_log_inverts_exp(scale):
    twist = scale * np.array([0.3, -0.5, 0.7, 0.6, -0.2, 0.4])
    np.testing.assert_allclose(se3_log(se3_exp(twist)), twist, atol=1e-9)


def test_exp_of_a_quarter_turn_about_z_with_forward_motion_is_an_arc():
    # Radius 1: moving pi/2 along a circle that turns left ends at (1, 1).
    T = se3_exp(np.array([np.pi / 2, 0, 0, 0, 0, np.pi / 2]))
    np.testing.assert_allclose(T[:3, 3], [1, 1, 0], atol=1e-12)


def test_angles_are_those_of_scipy():
    for angles in np.random.default_rng(0).uniform(-1, 1, (50, 3)) * [3.1, 1.5, 3.1]:
        R = rotation_from_angles(*angles)
        np.testing.assert_allclose(R, Rotation.from_euler('ZYX', angles).as_matrix(), atol=1e-15)
        np.testing.assert_allclose(angles_of_rotation(R), angles, atol=1e-9)


def test_exp_takes_stacks():
    twists = np.random.default_rng(0).normal(size=(5, 6))
    for T, twist in zip(se3_exp(twists), twists, strict=True):
        np.testing.assert_allclose(T, se3_exp(twist), atol=1e-12)


def test_invert_undoes_a_transform():
    T = se3_exp(np.array([1.0, 2, 3, 0.1, 0.2, 0.3]))
    points = np.random.default_rng(1).normal(size=(7, 3))
    np.testing.assert_allclose(transform_points(invert(T), transform_points(T, points)), points)
    np.testing.assert_allclose(invert(np.stack([T, T]))[1] @ T, np.eye(4), atol=1e-12)


def test_ros_axes_of_optical_axes():
    np.testing.assert_array_equal(R_ROS_OPTICAL @ [1, 2, 3], [3, -1, -2])


def test_quaternion_round_trip_and_sign():
    R = se3_exp(np.array([0, 0, 0, 2.0, -1.0, 1.5]))[:3, :3]
    q = quaternion_xyzw(R)
    assert q[3] >= 0
    np.testing.assert_allclose(transform_from_quaternion(np.zeros(3), q)[:3, :3], R, atol=1e-12)


def test_rotation_vectors_are_those_of_scipy_up_to_half_a_turn():
    vectors = np.random.default_rng(2).normal(size=(40, 3))
    angles = np.concatenate([[0.0, 1e-12, 1e-7, np.pi], np.linspace(0.1, 3.14, 36)])
    vectors *= (angles / np.linalg.norm(vectors, axis=1))[:, None]
    rotations = Rotation.from_rotvec(vectors).as_matrix()
    np.testing.assert_allclose(rotations_by(vectors), rotations, atol=1e-14)
    found = rotation_vectors(rotations)
    np.testing.assert_allclose(found[angles < np.pi], vectors[angles < np.pi], atol=1e-12)
    np.testing.assert_allclose(rotations_by(found), rotations, atol=1e-12)


def test_rotation_angle():
    assert rotation_angle(se3_exp(np.array([0, 0, 0, 0, 0.3, 0]))[:3, :3]) == pytest.approx(0.3)


def test_projection_and_back_projection_are_inverse():
    camera = StereoCamera(640, 480, 320.0, 310.0, 319.5, 239.5, 0.12)
    points = np.array([[0.2, -0.1, 2.0], [-1.0, 0.5, 7.5]])
    uvr = camera.project(points)
    disparity = uvr[:, 0] - uvr[:, 2]
    np.testing.assert_allclose(disparity, 320 * 0.12 / points[:, 2])
    depth = camera.disparity_times_depth / disparity
    np.testing.assert_allclose(camera.back_project(uvr[:, :2], depth), points)


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        ({'fx': 0.0}, 'not calibrated'),
        ({'baseline_m': 0.0}, 'baseline'),
        ({'baseline_m': -0.1}, 'swapped'),
        ({'cx': float('nan')}, 'not finite'),
    ],
)
def test_impossible_cameras_are_refused(change, words):
    values = {'width': 64, 'height': 48, 'fx': 30.0, 'fy': 30.0, 'cx': 32.0, 'cy': 24.0}
    with pytest.raises(CalibrationError, match=words):
        StereoCamera(**{**values, 'baseline_m': 0.1, **change})


def test_a_camera_pitched_down_sees_the_floor_where_trigonometry_says():
    mount = Mount(height_m=0.5, pitch_rad=np.radians(30))
    # The optical axis hits the floor at 0.5 / tan(30 deg) ahead, 1 m along the ray.
    hit = transform_points(mount.T_base_left, np.array([[0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(hit, [[0.5 * np.sqrt(3), 0, 0]], atol=1e-12)
    np.testing.assert_allclose(mount.heights_m(np.array([[0.0, 0.0, 1.0]])), [0], atol=1e-12)


def test_mount_round_trip_through_its_transform():
    mount = Mount(0.4, 0.2, -0.1, 0.15, 0.06, 0.3)
    again = Mount.from_transform(mount.T_base_left)
    for name in ('height_m', 'pitch_rad', 'roll_rad', 'forward_m', 'left_m', 'yaw_rad'):
        assert getattr(again, name) == pytest.approx(getattr(mount, name))


def test_make_transform():
    T = make_transform(np.eye(3), np.array([1.0, 2.0, 3.0]))
    np.testing.assert_array_equal(transform_points(T, np.zeros((1, 3))), [[1, 2, 3]])


def test_the_pose_of_a_mount_is_read_only_and_can_be_sent():
    T_base_left = Mount(height_m=0.3, pitch_rad=0.1).T_base_left
    with pytest.raises(ValueError, match='read-only'):
        T_base_left[0, 3] = 1.0
    quaternion = quaternion_xyzw(T_base_left[:3, :3])
    translation = T_base_left[:3, 3]
    quaternion.flags.writeable = False
    again = transform_from_quaternion(translation, quaternion)
    np.testing.assert_allclose(again, T_base_left, atol=1e-12)
    np.testing.assert_allclose(se3_exp(se3_log(T_base_left)), T_base_left, atol=1e-9)
