"""What is forgotten when a camera is lost, and sensors beside an odometry that is turned."""

import numpy as np
import pytest
from stereo_room import planar_pose

from segfloor_ros.core.contracts import ImuSample, Mount, WheelPose
from segfloor_ros.core.geometry import invert, make_transform
from segfloor_ros.core.plugins.sensors.body_motion import BodyMotion
from segfloor_ros.core.slam.optional import NoSensors
from segfloor_ros.core.slam.tracking.front_end import is_near
from segfloor_ros.core.slam.tracking.motion import CameraMotion
from segfloor_ros.core.twists import se3_exp

STEP_NS = 100_000_000
SURE = 1e-8 * np.eye(6)
MOUNT = Mount(0.45, pitch_rad=0.35, roll_rad=-0.2, forward_m=0.3, left_m=-0.15)
SOMEWHERE = se3_exp(np.array([0.7, -0.4, 1.5, 0.3, -0.9, 0.2]))
TURNED = se3_exp(np.array([0.4, 1.0, -0.3, 0.5, 0.3, -0.8]))
"""The correction of an odometry."""


def test_a_lost_camera_does_not_go_on_as_it_did() -> None:
    motion = CameraMotion(2.0, NoSensors())
    for k in range(3):
        motion.take(se3_exp(0.02 * k * np.arange(1, 7)) @ SOMEWHERE, SURE, k * STEP_NS)
    last = motion.T_camera_world
    assert np.abs(motion.predict(3 * STEP_NS) - last).max() > 0.01
    motion.lose(3 * STEP_NS)
    np.testing.assert_allclose(motion.predict(4 * STEP_NS), last, atol=1e-12)


def on_wheels() -> CameraMotion:
    body = BodyMotion()
    body.T_base_left = MOUNT.T_base_left
    for k in range(60):
        body.add(WheelPose(k * STEP_NS // 5, planar_pose(0.01 * k, 0.0, 0.01 * k)))
    motion = CameraMotion(2.0, body)
    motion.take(SOMEWHERE, SURE, 0)
    motion.since_keyframe.start(motion.T_camera_world, motion.covariance)
    return motion


def test_wheels_tell_nothing_of_a_camera_that_was_lost_since_the_keyframe() -> None:
    """It is found where no wheels brought it."""
    motion = on_wheels()
    assert motion.prior(STEP_NS) is not None
    motion.lose(STEP_NS)
    motion.take(TURNED @ SOMEWHERE, SURE, 2 * STEP_NS)
    assert motion.prior(3 * STEP_NS) is None
    motion.since_keyframe.start(motion.T_camera_world, motion.covariance)
    assert motion.prior(3 * STEP_NS) is not None


def test_wheels_count_since_the_keyframe_through_frames_without_images() -> None:
    motion = on_wheels()
    whole = motion.measured(3 * STEP_NS).T_now_before
    for k in (1, 2):
        assert motion.bridge(k * STEP_NS)
    prior = motion.prior(3 * STEP_NS)
    assert prior is not None
    np.testing.assert_allclose(prior.T_camera_world, whole @ SOMEWHERE, atol=1e-9)


def with_imu(rate_rad_s, up) -> CameraMotion:
    """Return a camera with all that its IMU measures in 10 s."""
    body = BodyMotion()
    for k in range(1001):
        body.add(ImuSample(k * STEP_NS // 10, np.array(rate_rad_s), 9.81 * up))
    return CameraMotion(2.0, body)


def test_a_camera_that_may_be_anywhere_may_face_anywhere() -> None:
    motion = with_imu((0.0, 0.0, 0.0), MOUNT.up_in_camera)
    motion.take(SOMEWHERE, SURE, 0)
    motion.lose(STEP_NS)
    behind = make_transform(np.diag([-1.0, 1.0, -1.0]), np.zeros(3)) @ SOMEWHERE
    assert not is_near(behind, motion.expected(2 * STEP_NS))
    motion.lose()
    assert is_near(behind, motion.expected(2 * STEP_NS))


@pytest.mark.parametrize('T_world_odom', [np.eye(4), TURNED])
def test_an_imu_holds_a_camera_that_stands_whatever_the_axes_of_odom(T_world_odom) -> None:
    motion = with_imu((0.0, 0.0, 0.0), MOUNT.up_in_camera)
    motion.T_world_odom = T_world_odom
    for k in range(50):
        motion.take(SOMEWHERE, SURE, k * STEP_NS, T_seen=SOMEWHERE)
    up = motion._body.up_world
    assert up is not None
    np.testing.assert_allclose(
        up.direction, invert(SOMEWHERE)[:3, :3] @ MOUNT.up_in_camera, atol=1e-3
    )
    for k in range(50, 60):
        assert motion.measured(k * STEP_NS).source == 'IMU'
        assert motion.bridge(k * STEP_NS)
    np.testing.assert_allclose(motion.T_camera_world, SOMEWHERE, atol=5e-3)
    # Up in the camera is that of the mount, in its own axes.
    own = motion._body.up_camera(motion.T_odom_camera)
    assert own is not None
    np.testing.assert_allclose(own.direction, MOUNT.up_in_camera, atol=1e-3)
