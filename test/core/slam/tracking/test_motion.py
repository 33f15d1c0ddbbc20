"""Where the camera is between frames."""

import numpy as np
from stereo_room import MOUNT, planar_pose

from segfloor_ros.core.contracts import ImuSample, WheelPose
from segfloor_ros.core.geometry import invert
from segfloor_ros.core.plugins.sensors.body_motion import BodyMotion
from segfloor_ros.core.slam.tracking.motion import CameraMotion, sigma_m
from segfloor_ros.core.twists import se3_exp

SOMEWHERE = se3_exp(np.array([0.7, -0.4, 1.5, 0.3, -0.9, 0.2]))
"""A camera that is neither at the origin nor level."""

STEP_NS = 100_000_000


def body_on_wheels(poses):
    body = BodyMotion()
    body.T_base_left = MOUNT.T_base_left
    for k, pose in enumerate(poses):
        body.add(WheelPose(k * STEP_NS // 5, pose))
    return body


def test_a_camera_goes_on_as_it_did_from_wherever_it_is():
    twist = np.array([0.05, -0.02, 0.1, 0.02, 0.05, -0.03])
    motion = CameraMotion(2.0, BodyMotion())
    motion.take(SOMEWHERE, np.zeros((6, 6)), 0)
    motion.take(se3_exp(twist) @ SOMEWHERE, np.zeros((6, 6)), STEP_NS)
    found = motion.steady(2 * STEP_NS)
    np.testing.assert_allclose(found, se3_exp(2 * twist) @ SOMEWHERE, atol=1e-9)


def test_what_wheels_measure_moves_the_camera_from_wherever_it_is():
    body = body_on_wheels([planar_pose(0.01 * k, 0.0, 0.01 * k) for k in range(40)])
    motion = CameraMotion(2.0, body)
    motion.take(SOMEWHERE, 1e-8 * np.eye(6), 0)
    motion.since_keyframe.start(motion.T_camera_world, motion.covariance)
    expected = body.between(0, STEP_NS).T_now_before @ SOMEWHERE
    np.testing.assert_allclose(motion.measured_pose(STEP_NS), expected, atol=1e-9)
    np.testing.assert_allclose(motion.prior(STEP_NS).T_camera_world, expected, atol=1e-9)
    assert motion.bridge(STEP_NS)
    np.testing.assert_allclose(motion.T_camera_world, expected, atol=1e-9)


def test_the_map_moves_the_camera_with_its_keyframe_and_not_in_odom():
    motion = CameraMotion(2.0, BodyMotion())
    motion.take(SOMEWHERE, np.zeros((6, 6)), 0)
    motion.T_world_odom = se3_exp(np.array([0.1, 0.2, -0.1, 0.05, -0.1, 0.2]))
    T_odom_camera = motion.T_odom_camera
    keyframe = se3_exp(np.array([-0.2, 0.1, 0.4, 0.2, 0.1, -0.3]))
    moved = se3_exp(np.array([0.03, -0.01, 0.02, 0.01, 0.02, -0.01])) @ keyframe
    motion.move_map(keyframe, moved)
    T_camera_keyframe = SOMEWHERE @ invert(keyframe)
    np.testing.assert_allclose(motion.T_camera_world @ invert(moved), T_camera_keyframe, atol=1e-9)
    np.testing.assert_allclose(motion.T_odom_camera, T_odom_camera, atol=1e-9)


def test_what_wheels_measure_since_a_keyframe_counts_from_where_the_map_has_moved_it():
    body = body_on_wheels([planar_pose(0.01 * k, 0.0, 0.01 * k) for k in range(40)])
    motion = CameraMotion(2.0, body)
    motion.take(SOMEWHERE, 1e-8 * np.eye(6), 0)
    motion.since_keyframe.start(motion.T_camera_world, motion.covariance)
    before = motion.prior(STEP_NS).T_camera_world
    T = se3_exp(np.array([0.03, -0.01, 0.02, 0.01, 0.02, -0.01]))
    motion.move_map(SOMEWHERE, SOMEWHERE @ T)
    np.testing.assert_allclose(motion.prior(STEP_NS).T_camera_world, before @ T, atol=1e-9)


def test_a_lost_camera_turns_where_it_stands():
    body, rate = BodyMotion(), np.array([0.0, 0.4, 0.0])
    for k in range(60):
        body.add(ImuSample(k * STEP_NS // 5, rate, np.array([0.0, -9.81, 0.0])))
    motion = CameraMotion(2.0, body)
    motion.take(SOMEWHERE, np.zeros((6, 6)), 0)
    motion.lose(STEP_NS)
    found = motion.measured_pose(10 * STEP_NS)
    np.testing.assert_allclose(invert(found)[:3, 3], invert(SOMEWHERE)[:3, 3], atol=1e-9)
    turned = found[:3, :3] @ SOMEWHERE[:3, :3].T
    np.testing.assert_allclose(turned, se3_exp(np.append(np.zeros(3), -rate))[:3, :3], atol=1e-6)


def test_without_wheels_nothing_holds_the_pose_also_right_after_a_keyframe():
    motion = CameraMotion(2.0, BodyMotion())
    motion.take(np.eye(4), 1e-6 * np.eye(6), 0)
    motion.since_keyframe.start(motion.T_camera_world, motion.covariance)
    assert motion.prior(100_000_000) is None


def test_the_prior_of_a_frame_counts_from_the_last_keyframe():
    body = BodyMotion()
    body.T_base_left = MOUNT.T_base_left
    motion = CameraMotion(2.0, body)
    for k in range(40):
        body.add(WheelPose(k * 20_000_000, planar_pose(0.01 * k, 0, 0)))
    sure = 1e-8 * np.eye(6)
    motion.take(np.eye(4), sure, 0)
    motion.since_keyframe.start(motion.T_camera_world, motion.covariance)
    for k in range(1, 4):
        motion.take(motion.predict(k * 100_000_000), sure, k * 100_000_000)
    prior = motion.prior(400_000_000)
    whole = body.between(0, 400_000_000)
    np.testing.assert_allclose(prior.T_camera_world, whole.T_now_before, atol=1e-9)
    since_last = body.between(300_000_000, 400_000_000)
    assert sigma_m(prior.covariance) > 0.9 * sigma_m(whole.covariance)
    assert sigma_m(prior.covariance) > 1.5 * sigma_m(since_last.covariance)
    assert motion.prior(100_000_000_000) is None
