"""Where the camera is between frames."""

import numpy as np
from stereo_room import MOUNT, planar_pose

from segfloor_ros.camera.model import WheelPose
from segfloor_ros.slam.sensors.body_motion import BodyMotion
from segfloor_ros.slam.tracking.motion import CameraMotion, sigma_m


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
