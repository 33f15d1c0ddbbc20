"""What simulated wheels, IMU and depth camera tell, against the drive they were made from."""

from dataclasses import replace

import numpy as np
import pytest

from segfloor_ros.apps.simulation.camera import depth_reading_mm
from segfloor_ros.apps.simulation.motion import (
    RigMotion,
    imu_readings,
    plan_drive,
    smooth_motion,
    wheel_readings,
)
from segfloor_ros.apps.simulation.scene import (
    CameraRig,
    DepthSensor,
    Imu,
    Route,
    Scene,
    Sensors,
    Wheels,
)

STRAIGHT = Route(((0.0, 0.0), (3.0, 0.0)), speed_m_s=0.5)
CORNER = Route(((0.0, 0.0), (2.0, 0.0), (2.0, 2.0)))
EXACT_WHEELS = Wheels(rate_hz=50.0, noise_m=0.0)
GREY = np.full((60, 80), 100, np.float32)
EXACT_IMU = Imu(200.0, 0.0, 0.0, 0.0, 0.0)


def motion_of(route, **sensors):
    scene = Scene('test', route, camera=CameraRig(pitch_deg=0.0), sensors=Sensors(**sensors))
    return scene, smooth_motion(RigMotion(scene, plan_drive(route, 10.0), []))


def way_m(readings):
    return np.linalg.norm(np.diff(readings.T_odom_base[:, :3, 3], axis=0), axis=1).sum()


def test_exact_wheels_tell_the_motion_of_the_base():
    scene, motion = motion_of(CORNER, wheel_odometry=EXACT_WHEELS)
    readings = wheel_readings(scene, motion)
    told = np.linalg.inv(readings.T_odom_base[0]) @ readings.T_odom_base[-1]
    end_s = readings.times_s[-1]
    true = np.linalg.inv(motion.T_world_base(0.0)) @ motion.T_world_base(end_s)
    np.testing.assert_allclose(told, true, atol=0.01)
    # In a frame of their own, in which the drive begins neither at the origin nor ahead.
    begin = readings.T_odom_base[0]
    assert np.hypot(*begin[:2, 3]) > 1 and begin[0, 0] < 0.9


def test_wheels_of_a_wrong_scale_tell_more_metres():
    scene, motion = motion_of(STRAIGHT, wheel_odometry=replace(EXACT_WHEELS, scale=1.05))
    length_m = motion.drive.length_m
    assert way_m(wheel_readings(scene, motion)) == pytest.approx(1.05 * length_m, rel=1e-3)


def test_a_slipping_right_wheel_turns_the_odometry_to_the_left():
    # For 2 s at 0.5 m/s the right wheel tells twice its metre: 1 m more over a track of 0.3 m.
    wheels = replace(EXACT_WHEELS, slips=((3.0, 5.0, 1.0, 2.0),))
    scene, motion = motion_of(STRAIGHT, wheel_odometry=wheels)
    readings = wheel_readings(scene, motion)
    steps = np.swapaxes(readings.T_odom_base[:-1], 1, 2) @ readings.T_odom_base[1:]
    turn_rad = np.arctan2(steps[:, 1, 0], steps[:, 0, 0]).sum()
    assert turn_rad == pytest.approx(1.0 / 0.3, abs=0.05)


def test_an_exact_gyroscope_integrates_to_the_turn():
    scene, motion = motion_of(CORNER, imu=EXACT_IMU)
    readings = imu_readings(scene, motion)
    # The base turns left, about -y of the optical frame.
    assert -readings.gyro_rad_s[:, 1].sum() / 200.0 == pytest.approx(np.pi / 2, abs=0.01)


def test_an_accelerometer_feels_the_floor_push_upwards_and_the_robot_speed_up():
    scene, motion = motion_of(STRAIGHT, imu=EXACT_IMU)
    readings = imu_readings(scene, motion)
    np.testing.assert_allclose(readings.accel_m_s2[:, :2], [[0, -9.81]] * len(readings.times_s))
    speeding_up = (readings.times_s > 0.2) & (readings.times_s < 1.2)
    assert readings.accel_m_s2[speeding_up, 2].mean() == pytest.approx(0.3, abs=0.05)


def test_an_imu_ahead_of_the_camera_feels_its_circle():
    imus = [replace(EXACT_IMU, place_m=place) for place in ((0.0, 0.0, 0.0), (0.0, 0.0, 0.3))]
    at_camera, ahead = (imu_readings(*motion_of(CORNER, imu=imu)) for imu in imus)
    rate = at_camera.gyro_rad_s[:, 1]
    turning = np.abs(rate) > 0.3
    felt = (ahead.accel_m_s2 - at_camera.accel_m_s2)[turning, 2]
    np.testing.assert_allclose(felt, -0.3 * rate[turning] ** 2, atol=0.01)
    np.testing.assert_allclose(ahead.T_left_imu[:3, 3], [0.0, 0.0, 0.3])


def test_noise_and_bias_have_the_declared_size():
    scene, motion = motion_of(STRAIGHT, imu=replace(EXACT_IMU, gyro_bias_deg_s=0.5))
    gyro = imu_readings(scene, motion).gyro_rad_s
    assert np.degrees(np.linalg.norm(gyro.mean(axis=0))) == pytest.approx(0.5, rel=1e-3)
    scene, motion = motion_of(STRAIGHT, imu=replace(EXACT_IMU, gyro_noise_deg_s=0.2))
    gyro = imu_readings(scene, motion).gyro_rad_s
    assert np.degrees(gyro.std()) == pytest.approx(0.2, rel=0.05)


def depth_scene(covered=(), **depth):
    camera = CameraRig(covered=covered)
    return Scene('test', STRAIGHT, camera=camera, sensors=Sensors(depth=DepthSensor(**depth)))


def test_depth_is_measured_as_a_disparity_in_steps():
    # 320 px times 0.05 m over 2 m is a disparity of 8 px; the next step is 8.0625 px: 1.984 m.
    true_m = np.full((60, 80), 2.0, np.float32)
    scene = depth_scene(max_m=5.0, noise_px=1e-4, hole_share=0.0)
    assert (depth_reading_mm(scene, 320.0, true_m, GREY, 0, 0.0) == 2000).all()
    scene = depth_scene(max_m=5.0, noise_px=0.06, hole_share=0.0)
    told = depth_reading_mm(scene, 320.0, true_m, GREY, 0, 0.0)
    assert {1984, 2000, 2016} <= set(np.unique(told).tolist())
    assert 16 / (told / 1000).mean() == pytest.approx(8.0, abs=0.02)


def test_depth_has_holes_at_edges_beyond_its_range_and_under_a_cover():
    true_m = np.full((60, 80), 2.0, np.float32)
    true_m[:, 40:], true_m[:, 70:] = 3.0, 9.0
    told = depth_reading_mm(depth_scene(max_m=5.0, hole_share=0.0), 320.0, true_m, GREY, 0, 1.0)
    assert (told[:, 39:41] == 0).all() and (told[:, 70:] == 0).all()
    assert (told[:, :38] > 0).all() and (told[:, 42:68] > 0).all()
    told = depth_reading_mm(depth_scene(max_m=5.0, hole_share=0.1), 320.0, true_m, GREY, 0, 1.0)
    assert (told[:, :38] == 0).mean() == pytest.approx(0.1, abs=0.08)
    covered = depth_scene(covered=((0.5, 2.0),), max_m=5.0)
    assert not depth_reading_mm(covered, 320.0, true_m, GREY, 0, 1.0).any()
