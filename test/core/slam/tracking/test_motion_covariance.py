"""The covariance of a pose on its way, compared with poses that are sampled.

The start is uneven, and the camera sits pitched, rolled and off the centre of a base that turns. So
nothing is symmetric: a matrix, its transpose and its inverse give different results.
"""

import numpy as np
import pytest
from sampled_poses import assert_spread, drawn_errors, drawn_poses, twists_from, uneven_covariance
from stereo_room import planar_pose

from segfloor_ros.core.contracts import NO_POINT, LastPose, Mount, RelativeMotion, WheelPose
from segfloor_ros.core.geometry import invert
from segfloor_ros.core.plugins.sensors.body_motion import BodyMotion
from segfloor_ros.core.slam.optional import NoSensors
from segfloor_ros.core.slam.rig import Observations
from segfloor_ros.core.slam.tracking.images import Features
from segfloor_ros.core.slam.tracking.motion import (
    ACCELERATION,
    CameraMotion,
    TrackingState,
    joined_motion,
)
from segfloor_ros.core.slam.tracking.pose import PoseEstimate, differ
from segfloor_ros.core.slam.tracking.track import ObservedFeatures
from segfloor_ros.core.twists import se3_exp

MOUNT = Mount(0.45, pitch_rad=0.35, roll_rad=-0.2, forward_m=0.3, left_m=-0.15, yaw_rad=0.4)
SOMEWHERE = se3_exp(np.array([0.7, -0.4, 1.5, 0.3, -0.9, 0.2]))
STEP_NS, FRAMES = 100_000_000, 30
START = uneven_covariance(np.random.default_rng(5), scale=10.0)
"""The covariance of the first pose; what wheels add on the arc is about as large."""


def arc(k):
    """Return the base after k frames, 3 cm and 0.04 rad each: it turns by 70 degrees."""
    yaw = 0.04 * k
    return planar_pose(0.75 * np.sin(yaw), 0.75 * (1 - np.cos(yaw)), yaw)


def driving_body() -> BodyMotion:
    """Return what wheels measure of a base that drives an arc."""
    body = BodyMotion()
    body.T_base_left = MOUNT.T_base_left
    for k in range(5 * FRAMES + 20):
        body.add(WheelPose(k * STEP_NS // 5, planar_pose(7.0, -3.0, 1.0) @ arc(k / 5)))
    return body


def driving_motion() -> CameraMotion:
    """Return a camera on that base, which begins somewhere."""
    motion = CameraMotion(2.0, driving_body())
    motion.take(SOMEWHERE, START, 0)
    motion.since_keyframe.start(motion.T_camera_world, motion.covariance)
    return motion


def moved_samples(rng, samples, measured):
    """Return poses (N, 4, 4) after a motion, each with an error of its own."""
    steps = drawn_poses(rng, measured.T_now_before, measured.covariance, len(samples))
    return steps @ samples


def test_two_motions_together_are_as_unsure_as_samples_of_them() -> None:
    rng = np.random.default_rng(2)
    parts = [
        RelativeMotion(se3_exp(np.array(twist)), uneven_covariance(rng))
        for twist in ([0.5, -0.2, 0.8, 0.4, 0.9, -0.3], [-0.3, 0.6, 0.4, -0.7, 0.2, 1.1])
    ]
    together = joined_motion(*parts)
    samples = moved_samples(
        rng, drawn_poses(rng, parts[0].T_now_before, parts[0].covariance), parts[1]
    )
    assert_spread(twists_from(together.T_now_before, samples), together.covariance)


def test_a_pose_without_images_is_as_unsure_as_samples_on_the_same_wheels() -> None:
    rng, motion = np.random.default_rng(3), driving_motion()
    samples = drawn_poses(rng, SOMEWHERE, START)
    for k in range(1, FRAMES + 1):
        samples = moved_samples(rng, samples, motion.measured(k * STEP_NS))
        assert motion.bridge(k * STEP_NS)
    assert motion.state is TrackingState.ON_WHEELS
    assert_spread(twists_from(motion.T_camera_world, samples), motion.covariance)


def test_what_wheels_say_since_a_keyframe_is_as_unsure_as_samples_from_it() -> None:
    """Images show the frames between: they count for the poses, not for the prior."""
    rng, motion = np.random.default_rng(4), driving_motion()
    samples = drawn_poses(rng, SOMEWHERE, START)
    for k in range(1, FRAMES + 1):
        stamp_ns = k * STEP_NS
        samples = moved_samples(rng, samples, motion.measured(stamp_ns))
        prior = motion.prior(stamp_ns)
        motion.take(motion.predict(stamp_ns), 1e-8 * np.eye(6), stamp_ns)
    assert_spread(twists_from(prior.T_camera_world, samples), prior.covariance)


def test_a_drive_that_was_broken_off_goes_on_as_unsure_as_samples_of_its_last_pose() -> None:
    rng, motion = np.random.default_rng(6), CameraMotion(2.0, driving_body())
    motion.resume(LastPose(STEP_NS, SOMEWHERE, np.eye(4), START), sigma_per_s=0.5)
    samples = drawn_poses(rng, SOMEWHERE, START)
    for k in range(2, FRAMES + 1):
        samples = moved_samples(rng, samples, motion.measured(k * STEP_NS))
        assert motion.bridge(k * STEP_NS)
    assert_spread(twists_from(motion.T_camera_world, samples), motion.covariance)


def test_a_motion_that_goes_on_leaves_a_pose_as_unsure_as_samples_of_it() -> None:
    """The pose was without images for some time, and turns by 0.6 rad in the next frame."""
    rng, motion = np.random.default_rng(7), CameraMotion(40.0, NoSensors())
    step, covariance = se3_exp(np.array([0.1, 0.05, 0.2, 0.2, -0.5, 0.2])), 6 * START
    motion.lose()
    motion.take(invert(step) @ SOMEWHERE, covariance, 0)
    motion.take(SOMEWHERE, covariance, STEP_NS)
    expected = motion.expected(2 * STEP_NS)
    speeds_up = (ACCELERATION * 0.1**2) ** 2 * np.eye(6)
    samples = drawn_poses(rng, SOMEWHERE, covariance)
    samples = moved_samples(rng, samples, RelativeMotion(step, speeds_up))
    assert_spread(twists_from(expected.T_camera_world, samples), expected.covariance)


@pytest.mark.parametrize('unsure', ['start', 'images'])
def test_poses_that_are_as_unsure_as_they_say_agree_with_the_wheels(unsure) -> None:
    """All but one in a thousand do, and hardly any of those that are four times as far off."""
    rng, motion = np.random.default_rng(8), driving_motion()
    of_start, of_images = (START, 1e-3 * START) if unsure == 'start' else (1e-3 * START, START)
    motion.covariance = of_start
    samples = drawn_poses(rng, SOMEWHERE, of_start, 1500)
    samples = moved_samples(rng, samples, motion.measured(5 * STEP_NS))
    seen = se3_exp(drawn_errors(rng, of_images, len(samples))) @ samples
    expected, none = motion.expected(5 * STEP_NS), np.zeros(0, bool)
    predicted = expected.T_camera_world
    far = se3_exp(4 * twists_from(predicted, seen)) @ predicted
    agree, disagree = (
        np.mean([not differ(PoseEstimate(T, none, of_images, 1.0), expected) for T in poses])
        for poses in (seen, far)
    )
    assert agree > 0.99
    assert disagree < 0.1


def went_on(sigma_m_s2, sigma_rad_s2, frames):
    """Return the motion of a camera that speeds up and brakes at random, frame by frame."""
    rng, motion = np.random.default_rng(9), CameraMotion(40.0, NoSensors())
    sigma = 0.01 * np.repeat([sigma_m_s2, sigma_rad_s2], 3)
    step, pose = np.array([0.0, 0.0, 0.1, 0.0, 0.02, 0.0]), np.eye(4)
    for k in range(frames):
        motion.take(pose, 1e-12 * np.eye(6), k * STEP_NS)
        step += rng.normal(0, sigma)
        pose = se3_exp(step) @ pose
    return motion


@pytest.mark.parametrize(('sigma_m_s2', 'sigma_rad_s2'), [(0.2, 0.5), (6.0, 1.0)])
def test_how_a_motion_goes_on_is_learnt_from_the_drive(sigma_m_s2, sigma_rad_s2) -> None:
    """Steps of a drive differ by its accelerations: what is expected next is as unsure as these."""
    motion = went_on(sigma_m_s2, sigma_rad_s2, 400)
    for step_s in (0.1, 0.4):
        expected = motion.expected(399 * STEP_NS + round(step_s * 1e9))
        sigma = np.sqrt(np.diag(expected.covariance))
        # Motions are compared over a frame: over s seconds they differ by s².
        assert sigma[:3] == pytest.approx(sigma_m_s2 * step_s**2, rel=0.5)
        assert sigma[3:] == pytest.approx(sigma_rad_s2 * step_s**2, rel=0.5)


def test_one_surprise_does_not_undo_what_a_drive_has_shown() -> None:
    motion = went_on(0.2, 0.2, 200)
    before = motion.expected(200 * STEP_NS).covariance.trace()
    jump = se3_exp(np.array([0.5, 0.0, 0.0, 0.0, 0.4, 0.0])) @ motion.T_camera_world
    motion.take(jump, 1e-12 * np.eye(6), 200 * STEP_NS)
    after = motion.expected(201 * STEP_NS).covariance.trace()
    assert before < after < 2 * before


def test_what_is_new_in_a_keyframe_has_its_error() -> None:
    features = Features(np.zeros((5, 2)), np.zeros(5, np.uint8), np.zeros((5, 32), np.uint8))
    uvd = np.full((5, 3), 5.0)
    uvd[4, 2] = np.nan
    observations = Observations(uvd, np.ones((5, 3)))
    ids = np.array([7, NO_POINT, NO_POINT, 9, NO_POINT], np.int32)
    # Two are known, two are new, and one without a disparity is no point.
    assert ObservedFeatures(features, observations, ids).known_share == 0.5
    none = np.full(5, NO_POINT, np.int32)
    assert ObservedFeatures(features, observations, none).known_share == 0.0
