"""How unsure the measured motion of a camera is that sits pitched, rolled and off the centre."""

import numpy as np
import pytest
from sampled_poses import assert_spread, drawn_errors, drawn_poses, twists_from
from scipy.spatial.transform import Rotation
from stereo_room import planar_pose

from segfloor_ros.core.contracts import ImuSample, Mount, WheelPose
from segfloor_ros.core.geometry import invert
from segfloor_ros.core.plugins.sensors.body_motion import BodyMotion
from segfloor_ros.core.twists import rotations_by, se3_exp

MS = 1_000_000
MOUNT = Mount(0.45, pitch_rad=0.35, roll_rad=-0.2, forward_m=0.3, left_m=-0.15, yaw_rad=0.4)
T_BASE_LEFT = MOUNT.T_base_left


def on_wheels(T_base_left: np.ndarray, has_gyroscope: bool) -> BodyMotion:
    """Return what measures a base that drives an arc and turns to the left by 1 rad in a second."""
    body = BodyMotion()
    body.T_base_left = T_base_left
    for t in range(0, 1001, 50):
        yaw = 1e-3 * t
        body.add(WheelPose(t * MS, planar_pose(0.6 * np.sin(yaw), 0.6 * (1 - np.cos(yaw)), yaw)))
    for t in range(0, 1001, 10) if has_gyroscope else ():
        body.add(ImuSample(t * MS, T_base_left[2, :3], np.zeros(3)))
    return body


@pytest.mark.parametrize('has_gyroscope', [False, True])
def test_a_camera_on_wheels_is_as_unsure_as_samples_of_its_base(has_gyroscope) -> None:
    """A camera with the axes of the base, at its origin, moves as the base does."""
    base, camera = (
        on_wheels(T, has_gyroscope).between(200 * MS, 900 * MS) for T in (np.eye(4), T_BASE_LEFT)
    )
    rng = np.random.default_rng(1)
    bases = drawn_poses(rng, base.T_now_before, base.covariance)
    cameras = invert(T_BASE_LEFT) @ bases @ T_BASE_LEFT
    assert_spread(twists_from(camera.T_now_before, cameras), camera.covariance)
    # The way on the floor, the way up, tilt and turn are not equally unsure.
    sigma = np.sqrt(np.diag(base.covariance))
    assert sigma[0] > 1.5 * sigma[2]
    assert has_gyroscope or sigma[5] > 1.5 * sigma[3]


def test_a_camera_on_a_gyroscope_is_as_unsure_as_samples_of_turn_and_way() -> None:
    body, rate = BodyMotion(), np.array([0.3, -0.9, 0.4])
    T_odom_camera = se3_exp(np.array([0.7, -0.4, 1.5, 0.3, -0.9, 0.2]))
    velocity = np.array([0.5, -0.2, 0.3])
    for t in range(0, 1401, 10):
        body.add(ImuSample(t * MS, rate, np.zeros(3)))
    for t in range(0, 1001, 100):
        pose = T_odom_camera.copy()
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(1e-3 * t * rate).as_matrix()
        pose[:3, 3] += 1e-3 * t * velocity
        body.learn(t * MS, pose, np.eye(3))
    motion = body.by_inertia(1000 * MS, 1400 * MS, pose, np.eye(3))
    assert motion.source == 'gyroscope'
    T_now_before = motion.T_now_before
    np.testing.assert_allclose(-T_now_before[:3, :3].T @ T_now_before[:3, 3],
                               pose[:3, :3].T @ velocity * 0.4, atol=0.02)  # fmt: skip
    _, turn_rad = body.turn(1000 * MS, 1400 * MS)
    way_m = np.sqrt(motion.covariance[0, 0])
    errors = drawn_errors(np.random.default_rng(2), np.eye(6))
    turned = rotations_by(turn_rad * errors[:, 3:]) @ T_now_before[:3, :3]
    samples = np.tile(np.eye(4), (len(errors), 1, 1))
    samples[:, :3, :3] = turned
    moved = -T_now_before[:3, :3].T @ T_now_before[:3, 3] + way_m * errors[:, :3]
    samples[:, :3, 3] = -np.einsum('nij,nj->ni', turned, moved)
    assert_spread(twists_from(T_now_before, samples), motion.covariance)
