"""A camera that sees nothing is carried on by what an accelerometer measures."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_gravity import BESIDE, RATE_HZ, imu_sample, pose

from segfloor_ros.core.contracts import ImuSample
from segfloor_ros.core.geometry import invert, make_transform
from segfloor_ros.core.plugins.sensors.body_motion import BodyMotion
from segfloor_ros.core.slam.thresholds import SAME
from segfloor_ros.core.slam.tracking.front_end import is_near
from segfloor_ros.core.slam.tracking.motion import CameraMotion, TrackingState, sigma_m

SEEN_S = 8.0
"""So long the images show the pose; then they fail."""


def take(motion, T_camera_world, stamp_ns):
    """Let the images show a pose (4, 4)."""
    motion.take(T_camera_world, 1e-6 * np.eye(6), stamp_ns, T_seen=T_camera_world)


def blind_drive(until_s, has_accel, place_m=(0.0, 0.0, 0.0), given_m=None):
    """Return the motion after a drive that turns and speeds up, and the errors while blind.
    given_m: where the IMU is said to be, other than at place_m.
    """
    body = BodyMotion()
    motion = CameraMotion(40.0, body)
    rng = np.random.default_rng(3)
    errors_m = []
    for k in range(1, round(until_s * RATE_HZ) + 1):
        sample = imu_sample(k / RATE_HZ, turns=True, place_m=place_m)
        place = sample.place_m if given_m is None else np.array(given_m)
        accel = sample.accel_m_s2 + rng.normal(0, 0.03, 3) if has_accel else np.zeros(3)
        body.add(ImuSample(sample.stamp_ns, sample.gyro_rad_s, accel, place))
        if k % 20:
            continue
        true = invert(pose(0, True)) @ pose(k / RATE_HZ, True)
        if k / RATE_HZ <= SEEN_S:
            shaken = make_transform(true[:3, :3], true[:3, 3] + rng.normal(0, 0.001, 3))
            take(motion, invert(shaken), sample.stamp_ns)
        elif motion.bridge(sample.stamp_ns):
            errors_m.append(np.linalg.norm((true @ motion.T_camera_world)[:3, 3]))
        else:
            motion.lose(sample.stamp_ns)
    return motion, np.array(errors_m)


@pytest.mark.slow
def test_an_imu_carries_the_camera_through_seconds_without_images():
    # It drives to and fro by 0.6 m, speeds up by 0.7 m/s², and turns by 45 degrees to either side.
    motion, errors_m = blind_drive(SEEN_S + 3.0, has_accel=True)
    assert len(errors_m) == 30 and motion.state is TrackingState.ON_IMU
    assert errors_m.max() < 0.1
    assert errors_m[-1] < 3 * sigma_m(motion.covariance) < 3 * SAME[0]


@pytest.mark.slow
def test_the_circle_of_an_imu_beside_the_camera_is_taken_off():
    _, errors_m = blind_drive(SEEN_S + 3.0, has_accel=True, place_m=BESIDE)
    assert len(errors_m) == 30
    assert errors_m.max() < 0.1
    _, wrong_m = blind_drive(SEEN_S + 3.0, has_accel=True, place_m=BESIDE, given_m=(0.0, 0.0, 0.0))
    assert wrong_m.max() > 2 * errors_m.max()


@pytest.mark.slow
def test_a_blind_stretch_is_in_the_axes_of_the_camera_that_has_turned():
    """One look after 0.6 s, in which the camera turns by a good part of a right angle."""
    body = BodyMotion()
    motion = CameraMotion(40.0, body)
    start, seen_s, blind_s = invert(pose(0, True)), 8.8, 0.6
    for k in range(1, round((seen_s + blind_s) * RATE_HZ) + 1):
        sample = imu_sample(k / RATE_HZ, turns=True, place_m=(0.0, 0.0, 0.0))
        body.add(ImuSample(sample.stamp_ns, sample.gyro_rad_s, sample.accel_m_s2, sample.place_m))
        true = start @ pose(k / RATE_HZ, True)
        if k % 20 == 0 and k / RATE_HZ <= seen_s:
            take(motion, invert(true), sample.stamp_ns)
    before = invert(motion.T_camera_world)
    assert motion.bridge(sample.stamp_ns)
    turned = Rotation.from_matrix(before[:3, :3]).inv() * Rotation.from_matrix(true[:3, :3])
    assert turned.magnitude() > 0.2
    assert np.linalg.norm(before[:3, 3] - true[:3, 3]) > 0.15
    assert np.linalg.norm((true @ motion.T_camera_world)[:3, 3]) < 0.02


@pytest.mark.slow
def test_without_an_accelerometer_the_speed_is_constant_for_a_second():
    _, errors_m = blind_drive(SEEN_S + 3.0, has_accel=False)
    assert 10 <= len(errors_m) < 20
    assert errors_m[9] > 0.1


@pytest.mark.slow
def test_a_camera_that_was_lost_is_found_where_it_may_look_only():
    motion, _ = blind_drive(SEEN_S + 9.0, has_accel=False)
    assert motion.state.is_lost
    until_ns = round((SEEN_S + 9.0) * 1e9)
    true = invert(pose(0, True)) @ pose(SEEN_S + 9.0, True)
    for degrees, expected in ((0, True), (10, True), (60, False), (180, False)):
        turn = make_transform(
            Rotation.from_rotvec([0, np.radians(degrees), 0]).as_matrix(), np.array([4.0, 0, 1.0])
        )
        assert is_near(turn @ invert(true), motion.expected(until_ns)) == expected
    # A second later the gyroscope has not measured all of the turn.
    behind = make_transform(np.diag([-1.0, 1, -1]), np.zeros(3))
    assert is_near(behind, motion.expected(until_ns + 10**9))


@pytest.mark.slow
def test_a_prediction_for_a_camera_that_was_lost_has_turned_on():
    motion, _ = blind_drive(SEEN_S + 9.0, has_accel=False)
    true = invert(pose(0, True)) @ pose(SEEN_S + 9.0, True)
    predicted = motion.predict(round((SEEN_S + 9.0) * 1e9))
    off = Rotation.from_matrix((predicted @ true)[:3, :3]).magnitude()
    assert off == pytest.approx(0.0, abs=np.radians(2.0))
