"""A camera that was lost is found somewhere else: the way there is no measurement of any sensor."""

from collections.abc import Iterable

import numpy as np
import pytest
from stereo_room import planar_pose

from segfloor_ros.core.contracts import ImuSample, Mount, WheelPose
from segfloor_ros.core.geometry import invert, make_transform
from segfloor_ros.core.plugins.sensors.body_motion import BodyMotion
from segfloor_ros.core.slam.tracking.motion import CameraMotion, TrackingState

MS = 1_000_000
MOUNT = Mount(0.45, pitch_rad=0.35, roll_rad=-0.2, forward_m=0.3, left_m=-0.15)
UP = MOUNT.up_in_camera
ASIDE = make_transform(np.eye(3), np.array([1.2, 0.5, -0.8]))
"""Where the camera is found again, seen from where it was."""

SURE = 1e-8 * np.eye(6)


def standing_with_imu(until_ms: int) -> CameraMotion:
    """Return a camera that stands at the origin, with all that its IMU measures."""
    body = BodyMotion()
    body.T_base_left = MOUNT.T_base_left
    for t in range(0, until_ms + 1, 10):
        body.add(ImuSample(t * MS, np.zeros(3), 9.81 * UP))
    return CameraMotion(2.0, body)


def see(motion: CameraMotion, milliseconds: Iterable[int], T_world_camera: np.ndarray) -> None:
    """Let the images show a camera that stands."""
    for t in milliseconds:
        motion.take(invert(T_world_camera), SURE, t * MS, T_seen=invert(T_world_camera))


@pytest.mark.parametrize('source', ['IMU', 'gyroscope'])
def test_the_way_to_where_a_camera_is_found_is_no_speed(source) -> None:
    motion = standing_with_imu(5000)
    if source == 'gyroscope':  # nothing is known of gravity
        motion._body.reset_world()
        see(motion, range(3600, 4001, 100), np.eye(4))
    else:
        see(motion, range(0, 4001, 100), np.eye(4))
    motion.lose(4100 * MS)
    see(motion, range(4200, 4201), ASIDE)
    measured = motion.measured(4300 * MS)
    assert measured.source == source
    np.testing.assert_allclose(measured.T_now_before, np.eye(4), atol=1e-3)
    assert motion.bridge(4300 * MS)
    assert motion.state is TrackingState(f'on {source}')


def test_a_lost_camera_has_no_pose_that_an_imu_could_carry_on() -> None:
    motion = standing_with_imu(5000)
    see(motion, range(0, 4001, 100), np.eye(4))
    assert motion.measured(4100 * MS) is not None
    motion.lose()
    assert motion.measured(4100 * MS) is None
    assert motion.measured(4200 * MS) is None


def test_the_way_to_where_a_camera_is_found_is_not_taken_for_gravity() -> None:
    """It is lost before anything is known of gravity: what would disagree with it comes first."""
    motion = standing_with_imu(6000)
    see(motion, range(0, 501, 100), np.eye(4))
    motion.lose(600 * MS)
    see(motion, range(700, 6001, 100), ASIDE)
    up = motion._body.up_world
    assert up is not None
    assert np.degrees(np.arccos(min(1.0, up.direction @ UP))) < 0.1


def base(t_s: float) -> np.ndarray:
    """Return a base that speeds up, brakes, and turns to either side."""
    yaw = 0.5 * np.sin(1.3 * t_s)
    return planar_pose(0.4 * t_s + 0.15 * np.sin(1.7 * t_s), 0.1 * np.cos(0.9 * t_s), yaw)


def driven_and_lost(lag_s: float, is_found_turned: bool) -> BodyMotion:
    """Return what is known of wheels after a drive on which the camera is lost every 2 s, and found
    turned, or else aside, in odom. lag_s: of the stamps of the wheels.
    """
    body = BodyMotion()
    body.T_base_left = MOUNT.T_base_left
    motion, T_odom_first = CameraMotion(2.0, body), np.eye(4)
    elsewhere = planar_pose(0.1, 0.0, 0.8) if is_found_turned else planar_pose(0.2, -0.4, 0.0)
    for k in range(200):
        for j in range(5):
            t_ms = 100 * k + 20 * j
            body.add(WheelPose(t_ms * MS, base(1e-3 * t_ms - lag_s)))
        if k % 20 == 19:
            motion.lose(100 * k * MS)
            T_odom_first = elsewhere @ T_odom_first
            continue
        see(motion, [100 * k], T_odom_first @ base(0.1 * k) @ MOUNT.T_base_left)
    return body


def test_the_way_to_where_a_camera_is_found_is_no_slip() -> None:
    assert driven_and_lost(0.0, is_found_turned=False).slips == 0


def test_the_turn_to_where_a_camera_is_found_hides_no_lag() -> None:
    body = driven_and_lost(0.04, is_found_turned=True)
    assert body.lag_ns == pytest.approx(40 * MS, abs=6 * MS)
    # What is measured with stamps that are late is the motion of the images' time.
    for t in (2200, 3400, 4600):
        measured = body.between(t * MS, (t + 400) * MS)
        true = invert(base(1e-3 * t)) @ base(1e-3 * t + 0.4)
        found = MOUNT.T_base_left @ invert(measured.T_now_before) @ invert(MOUNT.T_base_left)
        np.testing.assert_allclose(found, true, atol=0.012)


def test_in_another_world_neither_up_nor_a_speed_is_known() -> None:
    motion = standing_with_imu(5000)
    see(motion, range(0, 4001, 100), np.eye(4))
    body, R = motion._body, np.eye(3)
    assert body.up_world is not None
    assert body.by_inertia(4000 * MS, 4100 * MS, np.eye(4), R) is not None
    body.reset_world()
    assert body.up_world is None
    assert body.by_inertia(4000 * MS, 4100 * MS, np.eye(4), R) is None
    # Neither does what was measured before the change count for the filter that begins.
    body.learn(4100 * MS, np.eye(4), R)
    assert body.by_inertia(4100 * MS, 4200 * MS, np.eye(4), R).source == 'gyroscope'
