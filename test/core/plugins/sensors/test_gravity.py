"""Where up is, from what an accelerometer measures on a drive that speeds up, brakes and turns."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from segfloor_ros.core.contracts import ImuSample
from segfloor_ros.core.geometry import make_transform
from segfloor_ros.core.plugins.sensors.gyroscope import Gyroscope
from segfloor_ros.core.plugins.sensors.inertial_odometry import Gravity
from segfloor_ros.core.twists import se3_exp

UP = np.array([0.03, -0.99, -0.12]) / np.linalg.norm([0.03, -0.99, -0.12])
"""Up in the first camera: it looks 7 degrees down and hardly rolls."""

BIAS = np.array([0.06, -0.04, 0.08])
RATE_HZ = 200
BESIDE = (0.2, 0.05, -0.3)
FIRST = np.eye(4)
"""The world is the first camera, and so is odom."""


def pose(t, turns):
    """0.3 m to and fro along the way and, with `turns`, about up."""
    forward = np.cross(np.cross(UP, [0.0, 0.0, 1.0]), UP)
    angle = 0.8 * np.sin(0.7 * t) if turns else 0.0
    R = Rotation.from_rotvec(angle * UP).as_matrix()
    return make_transform(R, 0.3 * (1 - np.cos(1.5 * t)) * forward)


def imu_sample(t, turns, bias=BIAS, place_m=(0.0, 0.0, 0.0)):
    """Return what an IMU at a place on the camera measures."""
    h, beside = 1e-3, make_transform(np.eye(3), np.array(place_m))
    before, now, after = (pose(t + d, turns) @ beside for d in (-h, 0.0, h))
    turn = Rotation.from_matrix(before[:3, :3].T @ after[:3, :3]).as_rotvec() / (2 * h)
    accel = (after[:3, 3] - 2 * now[:3, 3] + before[:3, 3]) / h**2
    lifted = now[:3, :3].T @ (accel + 9.81 * UP) + bias
    return ImuSample(round(t * 1e9), turn, lifted, beside[:3, 3])


def driven(seconds, turns, bias=BIAS, place_m=(0.0, 0.0, 0.0), T_odom_world=FIRST):
    gyroscope = Gyroscope()
    gravity = Gravity(gyroscope)
    for k in range(round(seconds * RATE_HZ) + 1):
        gyroscope.add(imu_sample(k / RATE_HZ, turns, bias, place_m))
        if k % 20 == 0:
            T_odom_camera = T_odom_world @ pose(k / RATE_HZ, turns)
            gravity.see(round(k / RATE_HZ * 1e9), T_odom_camera, T_odom_world[:3, :3].T)
    return gravity


def degrees_between(a, b):
    return np.degrees(np.arccos(np.clip(a @ b, -1, 1)))


def test_speeding_up_is_not_taken_for_gravity():
    up = driven(6.0, turns=False, bias=np.zeros(3)).up_world
    # At 0.3 m * 1.5² / s² = 0.7 m/s² what is measured leans by up to 4 degrees.
    assert degrees_between(up.direction, UP) < 0.1


@pytest.mark.slow
def test_the_bias_is_told_from_gravity_where_the_camera_turns():
    straight, turning = (driven(20.0, turns).up_world for turns in (False, True))
    assert degrees_between(straight.direction, UP) > 0.3
    assert degrees_between(turning.direction, UP) < 0.15
    assert turning.sigma_rad < 0.5 * straight.sigma_rad


@pytest.mark.slow
def test_an_imu_beside_the_camera_feels_its_own_circle_which_is_not_taken_for_gravity():
    beside, at_camera = (
        driven(20.0, True, place_m=place).up_world for place in (BESIDE, (0, 0, 0))
    )
    assert degrees_between(beside.direction, UP) < 0.15
    assert beside.sigma_rad == pytest.approx(at_camera.sigma_rad, rel=0.1)


def test_nothing_is_told_before_enough_was_felt_or_without_an_imu():
    assert driven(1.0, turns=False).up_world is None
    assert Gravity(Gyroscope()).up_world is None


def test_a_measurement_is_given_to_one_keyframe():
    gravity = driven(6.0, turns=False)
    up = gravity.up_camera(pose(6.0, False))
    assert degrees_between(up.direction, UP) < 1.0
    assert gravity.up_camera(pose(6.0, False)) is None


def test_up_is_the_same_in_a_world_that_is_turned_from_odom():
    R = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    T_odom_world = make_transform(R, np.array([1.0, 2.0, -0.5]))
    gravity = driven(6.0, turns=False, bias=np.zeros(3), T_odom_world=T_odom_world)
    assert degrees_between(gravity.up_world.direction, UP) < 0.1
    up = gravity.up_camera(T_odom_world @ pose(6.0, False))
    assert degrees_between(up.direction, UP) < 1.0


LEANING_UP = np.array([0.4, -0.8, 0.45]) / np.linalg.norm([0.4, -0.8, 0.45])
T_WORLD_ODOM = se3_exp(np.array([0.4, 1.0, -0.3, 0.5, 0.3, -0.8]))
LARGE_BIAS = np.array([0.15, -0.1, 0.2])


def turned(t):
    """Return how a camera stands that nods and turns, in a world that is not level."""
    angles = np.stack([0.9 * np.sin(0.5 * t), 0.4 * np.sin(0.8 * t)], -1)
    return Rotation.from_rotvec([0.3, -0.9, 0.2]) * Rotation.from_euler('YX', angles)


def place(t):
    return np.stack([0.3 * (1 - np.cos(1.5 * t)), 0.1 * np.sin(t), 0.4 * np.sin(0.7 * t)], -1)


def test_up_is_known_in_the_axes_of_a_camera_that_nods_and_turns():
    """The bias of the accelerometer is 1.5 degrees, and turns along with the camera."""
    gyroscope, h, t = Gyroscope(), 1e-3, np.arange(2001) / 100
    gravity, T_odom_world = Gravity(gyroscope), np.linalg.inv(T_WORLD_ODOM)
    rates = (turned(t - h).inv() * turned(t + h)).as_rotvec() / (2 * h)
    accel = (place(t + h) - 2 * place(t) + place(t - h)) / h**2
    lifted = turned(t).inv().apply(accel + 9.81 * LEANING_UP) + LARGE_BIAS
    errors_deg, R, p = [], turned(t).as_matrix(), place(t)
    for k in range(len(t)):
        gyroscope.add(ImuSample(k * 10**7, rates[k], lifted[k]))
        if k % 10 == 0:
            T_odom_camera = T_odom_world @ make_transform(R[k], p[k])
            gravity.see(k * 10**7, T_odom_camera, T_WORLD_ODOM[:3, :3])
            up = gravity.up_camera(T_odom_camera)
            if up is not None and k > 1000:
                errors_deg.append(degrees_between(up.direction, R[k].T @ LEANING_UP))
    assert len(errors_deg) > 15
    assert max(errors_deg) < 0.06
    assert degrees_between(gravity.up_world.direction, LEANING_UP) < 0.03


def test_what_was_measured_while_no_frame_came_is_not_taken_for_gravity():
    """The camera stands; something pushes it while no image comes for two seconds."""
    gyroscope = Gyroscope()
    gravity = Gravity(gyroscope)
    for k in range(601):
        push = np.array([3.0, 0.0, 0.0]) if 60 < k < 240 else np.zeros(3)
        gyroscope.add(ImuSample(k * 10**7, np.zeros(3), 9.81 * UP + push))
        if k % 50 == 0 and not 50 < k < 250:
            gravity.see(k * 10**7, FIRST, FIRST[:3, :3])
    assert gravity.up_world is not None
    assert degrees_between(gravity.up_world.direction, UP) < 0.1
