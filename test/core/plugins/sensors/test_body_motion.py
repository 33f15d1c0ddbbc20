"""What wheels and gyroscope measure of the motion between frames, in cases worked out by hand."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from segfloor_ros.core.contracts import ImuSample, Mount, WheelPose
from segfloor_ros.core.geometry import invert, make_transform
from segfloor_ros.core.plugins.sensors.body_motion import BodyMotion
from segfloor_ros.core.plugins.sensors.gyroscope import KEPT_NS, STEP_NS, Gyroscope, TimedSeries
from segfloor_ros.core.plugins.sensors.wheel_odometry import (
    MAX_WINDOWS,
    Stretch,
    WheelCalibration,
    WheelCalibrator,
    WheelOdometry,
    Window,
    rotation_2d,
)
from segfloor_ros.core.twists import adjoint, se3_exp

MS = 1_000_000


def base_pose(x, y, yaw):
    return make_transform(Rotation.from_rotvec([0, 0, yaw]).as_matrix(), np.array([x, y, 0.0]))


def test_wheels_are_interpolated_and_late_ones_find_their_place():
    wheels = WheelOdometry()
    # The frame of the wheels is turned: the base looks along y and moves along y.
    for t, y in ((0, 1.0), (40, 1.4), (20, 1.2), (60, 1.6)):
        wheels.add(WheelPose(t * MS, base_pose(5.0, y, np.pi / 2)))
    np.testing.assert_allclose(wheels.motion(10 * MS, 50 * MS), base_pose(0.4, 0, 0), atol=1e-12)
    # 40 ms after the last message the base goes on as it did; after half a second nobody knows.
    np.testing.assert_allclose(wheels.motion(0, 100 * MS), base_pose(1.0, 0, 0), atol=1e-12)
    assert wheels.motion(0, 600 * MS) is None
    assert wheels.motion(-10 * MS, 20 * MS) is None
    wheels.add(WheelPose(700 * MS, base_pose(5.0, 3.0, np.pi / 2)))
    assert wheels.motion(0, 500 * MS) is None


def test_a_steady_circle_speeds_nothing_up():
    wheels, rate, speed = WheelOdometry(), 0.8, 0.5
    for t in range(0, 3001, 20):
        turn = 1e-3 * t * rate
        place = speed / rate * np.array([np.sin(turn), 1 - np.cos(turn)])
        wheels.add(WheelPose(t * MS, base_pose(*place, turn)))
    stretch = wheels.stretch(500 * MS, 2500 * MS)
    # Both ends are measured over a tenth of a second before them.
    np.testing.assert_allclose(stretch.speeding_up_m_s, 0.0, atol=0.05 * speed)
    assert stretch.turning_up_rad_s == pytest.approx(0.0, abs=1e-9)


def test_of_a_long_drive_the_latest_samples_are_kept():
    series = TimedSeries(STEP_NS)
    for k in range(400):
        series.add(WheelPose(k * STEP_NS, np.eye(4)))
        stamps = [pose.stamp_ns for pose in series]
        assert stamps[-1] == k * STEP_NS
        assert min(k * STEP_NS, KEPT_NS) <= stamps[-1] - stamps[0] <= 2 * KEPT_NS


def gyroscope(rate, bias=(0.0, 0.0, 0.0), until=1000):
    gyro = Gyroscope()
    for t in range(0, until + 1, 5):
        gyro.add(ImuSample(t * MS, np.array(rate(t / 1000)) + bias, np.zeros(3)))
    return gyro


def standing_body():
    body = BodyMotion()
    body.T_base_left = Mount(0.3, 0.1, 0.0).T_base_left
    return body


@pytest.mark.parametrize('turn_rad_s', [0.0, 0.3])
def test_the_bias_of_the_gyroscope_is_learnt_while_the_wheels_stand_without_any_image(turn_rad_s):
    body, bias = standing_body(), np.array([0.004, -0.008, 0.003])
    rate = np.array([0.0, -turn_rad_s, 0.0])
    for t in range(0, 1500, 10):
        body.add(ImuSample(t * MS, rate + bias, np.zeros(3)))
        body.add(WheelPose(t * MS, base_pose(2.0, 1.0, 1e-3 * t * turn_rad_s)))
    for t in range(0, 1200, 100):
        for _ in range(3):
            body.between(t * MS, (t + 100) * MS)
    found = bias if not turn_rad_s else np.zeros(3)
    np.testing.assert_allclose(body.gyroscope.bias_rad_s, found, atol=2e-4)


def test_a_robot_that_is_turned_while_its_wheels_stand_has_no_other_bias():
    body = standing_body()
    for t in range(0, 3000, 10):
        turned = 0.2 * (t > 1500)
        body.add(ImuSample(t * MS, np.array([0.0, 0.005 + turned, 0.0]), np.zeros(3)))
        body.add(WheelPose(t * MS, np.eye(4)))
    for t in range(0, 2900, 100):
        body.between(t * MS, (t + 100) * MS)
    np.testing.assert_allclose(body.gyroscope.bias_rad_s, [0.0, 0.005, 0.0], atol=3e-4)


def test_rates_integrate_to_the_turn_between_two_samples():
    # A rate that grows by 2 rad/s each second about x: from 0.2 to 0.7 s it turns by 0.7² - 0.2².
    turn, _ = gyroscope(lambda t: (2 * t, 0, 0)).turn(202 * MS, 698 * MS)
    angle = Rotation.from_matrix(turn).as_rotvec()
    np.testing.assert_allclose(angle, [0.698**2 - 0.202**2, 0, 0], atol=1e-9)


def test_turns_about_changing_axes_are_put_one_after_the_other():
    # Half a second about x, then half a second about the camera's own y.
    gyro = gyroscope(lambda t: (1, 0, 0) if t < 0.5 else (0, 1, 0))
    expected = Rotation.from_rotvec([0.5, 0, 0]) * Rotation.from_rotvec([0, 0.5, 0])
    np.testing.assert_allclose(gyro.turn(0, 1000 * MS)[0], expected.as_matrix(), atol=5e-3)


def test_a_gap_in_the_samples_is_no_turn():
    gyro = gyroscope(lambda t: (0, 0, 1), until=200)
    assert gyro.turn(0, 240 * MS) is not None
    assert gyro.turn(0, 320 * MS) is None
    gyro.add(ImuSample(500 * MS, np.zeros(3), np.zeros(3)))
    assert gyro.turn(0, 450 * MS) is None


def test_the_bias_is_learnt_from_the_images_and_one_wrong_turn_is_not():
    bias = np.array([0.01, -0.02, 0.005])
    gyro = gyroscope(lambda t: (0.0, 0.3, 0.0), bias, until=4000)
    for k in range(40):
        seen = Rotation.from_rotvec([0, 0.03, 0]).as_matrix()
        gyro.learn(seen, k * 100 * MS, (k + 1) * 100 * MS)
    np.testing.assert_allclose(gyro.bias_rad_s, bias, atol=1e-3)
    gyro.learn(np.eye(3), 0, 1000 * MS)
    np.testing.assert_allclose(gyro.bias_rad_s, bias, atol=1e-3)
    np.testing.assert_allclose(
        Rotation.from_matrix(gyro.turn(0, 1000 * MS)[0]).as_rotvec(), [0, 0.3, 0], atol=2e-3
    )


def window(way, turn, measured_way, measured_turn, speeding_up=(0.0, 0.0), turning_up=0.0):
    by_wheels = Stretch(base_pose(*measured_way, measured_turn), np.array(speeding_up), turning_up)
    return Window(np.array(way), turn, 0.0, by_wheels)


def driven(calibration, motions):
    """Return the windows of a drive whose wheels are wrong by `calibration`."""
    scale, yaw, offset, turn_scale = calibration
    T_wheels_base = base_pose(*offset, yaw)
    for way, turn in motions:
        seen = base_pose(*way, turn)
        by_wheels = T_wheels_base @ seen @ invert(T_wheels_base)
        yield window(way, turn, scale * by_wheels[:2, 3], turn_scale * turn)


def some_motions(count):
    rng = np.random.default_rng(1)
    turns = rng.uniform(-0.4, 0.4, count)
    return [((0.2, 0.1 * turn), turn) for turn in turns]


def test_scale_yaw_and_offset_of_the_wheels_are_found():
    calibrator = WheelCalibrator()
    for one in driven((1.05, 0.04, (0.15, -0.05), 0.96), some_motions(120)):
        calibrator.add(one)
    found = calibrator.current
    assert found.scale == pytest.approx(1.05, abs=2e-3)
    assert found.yaw_rad == pytest.approx(0.04, abs=2e-3)
    assert found.offset_m == pytest.approx((0.15, -0.05), abs=5e-3)
    assert found.believed() is found
    assert found.turn_scale == pytest.approx(0.96, abs=2e-3)
    assert set(found.remarks()) == {'scale', 'turn_scale', 'yaw', 'offset'}


def test_the_slip_of_a_first_turn_is_no_offset_of_the_camera():
    """The wheels stop on the spot, the base slides on by 15 mm as it begins to turn."""
    calibrator = WheelCalibrator()
    windows = [*driven((1.0, 0.0, (0.0, 0.0), 1.0), [((0.13, 0.0), 0.1)] * 6)]
    sliding = window((0.015, 0.006), 0.19, (0.0, 0.0), 0.19)
    for one in [*windows, sliding]:
        calibrator.add(one)
    turn = base_pose(0.0, 0.0, 0.19)
    way_m, _ = calibrator.current.believed().base_motion(turn, None)
    assert np.linalg.norm(way_m) < 1e-3
    assert calibrator.current.believed().sigma[2] > np.linalg.norm(calibrator.current.offset_m)


def test_a_base_that_turns_on_the_spot_may_slip_and_its_offset_may_not_be_known():
    body = BodyMotion()
    body.T_base_left = Mount(0.3, 0.2).T_base_left
    for k in range(40):
        body.add(WheelPose(100 * k * MS, base_pose(0.0, 0.0, 0.1 * k)))
    turned = body.between(1000 * MS, 2000 * MS)
    in_base = adjoint(body.T_base_left) @ turned.covariance @ adjoint(body.T_base_left).T
    assert 0.005 < np.sqrt(in_base[0, 0]) < 0.15


def test_wheels_that_wear_are_known_as_they_are_now():
    calibrator, motions = WheelCalibrator(), some_motions(MAX_WINDOWS)
    for scale in (1.0, 1.05):
        for one in driven((scale, 0.0, (0.0, 0.0), 1.0), motions):
            calibrator.add(one)
    assert len(calibrator) == MAX_WINDOWS
    assert calibrator.current.scale == pytest.approx(1.05, abs=2e-3)


def test_stamps_of_an_imu_that_are_late_are_found_out():
    def rate(t):
        return (0.0, 0.8 * np.sin(2 * t), 0.0)

    lag_s, gyro = 0.03, Gyroscope()
    for t in range(0, 20000, 5):
        gyro.add(ImuSample(t * MS, np.array(rate(t / 1000 - lag_s)), np.zeros(3)))
    for k in range(3, 190):
        angle = 0.4 * (np.cos(0.2 * k) - np.cos(0.2 * (k + 1)))
        seen = Rotation.from_rotvec([0, angle, 0]).as_matrix()
        gyro.learn(seen, k * 100 * MS, (k + 1) * 100 * MS)
    assert gyro.lag_s == pytest.approx(lag_s, abs=2e-3)
    assert '30 ms later' in gyro.remarks()['imu lag']


def test_a_lag_is_found_where_the_axis_of_the_turn_moves():
    """The camera turns and nods: the axes of the end are not those of the beginning."""

    def turned(t):
        return Rotation.from_euler('ZX', np.stack([1.5 * t, 1.0 * np.sin(2 * t)], axis=-1))

    lag_s, gyro, h = 0.03, Gyroscope(), 1e-3
    stamps = np.arange(0, 12000, 10)
    late = stamps / 1000 - lag_s
    rates = (turned(late - h).inv() * turned(late + h)).as_rotvec() / (2 * h)
    for t, rate in zip(stamps.tolist(), rates, strict=True):
        gyro.add(ImuSample(t * MS, rate, np.zeros(3)))
    ends = 0.4 * np.arange(1, 29)
    seen = (turned(ends[:-1]).inv() * turned(ends[1:])).as_matrix()
    for k, R in enumerate(seen, 1):
        gyro.learn(R, k * 400 * MS, (k + 1) * 400 * MS)
    assert gyro.lag_s == pytest.approx(lag_s, abs=1e-3)
    np.testing.assert_allclose(gyro.bias_rad_s, 0.0, atol=1e-3)


def test_a_straight_way_tells_nothing_of_the_lag_of_an_imu():
    rng, gyro = np.random.default_rng(1), Gyroscope()
    for t in range(0, 10_000, 5):
        gyro.add(ImuSample(t * MS, rng.normal(0, 2e-3, 3), np.zeros(3)))
    for t in range(0, 9_800, 200):
        seen = Rotation.from_rotvec(rng.normal(0, 1e-3, 3)).as_matrix()
        gyro.learn(seen, t * MS, (t + 200) * MS)
    assert gyro.lag_s == 0.0


def test_stamps_of_wheels_that_are_late_are_found_out():
    def base(t):
        """A drive that speeds up, brakes and turns."""
        yaw = 0.5 * np.sin(1.3 * t)
        return base_pose(0.4 * t + 0.15 * np.sin(1.7 * t), 0.1 * np.cos(0.9 * t), yaw)

    lag_s, wheels, calibrator = 0.04, WheelOdometry(), WheelCalibrator()
    for t in range(0, 30000, 20):
        wheels.add(WheelPose(t * MS, base(t / 1000 - lag_s)))
    for k in range(2, 145):
        seen = invert(base(0.2 * k)) @ base(0.2 * (k + 1))
        by_wheels = wheels.stretch(k * 200 * MS, (k + 1) * 200 * MS)
        turning_up = 0.5 * 1.3 * (np.cos(1.3 * 0.2 * (k + 1)) - np.cos(1.3 * 0.2 * k))
        turn = np.arctan2(seen[1, 0], seen[0, 0])
        calibrator.add(Window(seen[:2, 3], turn, turning_up, by_wheels))
    assert calibrator.current.lag_s == pytest.approx(lag_s, abs=4e-3)
    assert list(calibrator.current.remarks()) == ['lag']


def test_what_was_found_turns_what_wheels_tell_into_the_motion_of_the_base():
    found = WheelCalibration(1.05, 0.04, (0.15, -0.05), 0.96)
    (one,) = driven((1.05, 0.04, (0.15, -0.05), 0.96), [((0.2, 0.03), 0.3)])
    by_wheels = base_pose(*one.measured_m, one.measured_rad)
    way_m, turn_rad = found.base_motion(by_wheels, None)
    assert turn_rad == pytest.approx(0.3)
    # The chord is that of the arc as measured, turned by what the turn was wrong.
    np.testing.assert_allclose(way_m, [0.2, 0.03], atol=2e-3)


def test_the_chord_of_an_arc_points_half_the_turn_to_the_side_that_a_gyroscope_measures():
    """Wheels measure an arc of 0.6 rad, a gyroscope half of that."""
    chord_m = 0.5 * np.array([np.cos(0.3), np.sin(0.3)])
    way_m, turn_rad = WheelCalibration().base_motion(base_pose(*chord_m, 0.6), 0.3)
    assert turn_rad == 0.3
    np.testing.assert_allclose(way_m, 0.5 * np.array([np.cos(0.15), np.sin(0.15)]), atol=1e-12)


def test_wheels_that_are_right_are_not_remarked_upon_and_slip_is_noticed():
    calibrator = WheelCalibrator()
    windows = [*driven((1.0, 0.0, (0.0, 0.0), 1.0), some_motions(60))]
    slipping = window(windows[0].seen_m, windows[0].seen_rad, (0.4, 0.0), 0.0)
    agreed = [calibrator.add(w) for w in [*windows[:40], slipping, slipping, *windows[40:]]]
    assert agreed == [True] * 40 + [False] * 2 + [True] * 20
    assert calibrator.current.remarks() == {}
    assert calibrator.current.scale == pytest.approx(1.0, abs=2e-3)


def test_wheels_that_slipped_are_less_sure_for_a_second():
    body = BodyMotion()
    body.T_base_left = Mount(0.3, 0.2).T_base_left
    for k in range(80):  # 5 cm each 100 ms; the wheels measure twice as much from 4 s on
        body.add(WheelPose(100 * k * MS, base_pose(0.05 * (k + max(k - 40, 0)), 0, 0)))
    sigmas_m = []
    for k in range(60):
        body.learn(100 * k * MS, invert(body.T_base_left) @ base_pose(0.05 * k, 0, 0)
                   @ body.T_base_left, np.eye(3))  # fmt: skip
        ahead = body.between(100 * k * MS, 100 * (k + 1) * MS)
        sigmas_m.append(np.sqrt(np.trace(ahead.covariance[:3, :3])))
    assert body.slips > 3
    assert max(sigmas_m[30:40]) < 0.02 < 0.04 < min(sigmas_m[45:])
    later = body.between(7_500 * MS, 7_600 * MS)
    assert np.sqrt(np.trace(later.covariance[:3, :3])) < 0.02


def test_the_motion_of_the_base_moves_the_camera_on_its_mount():
    body = BodyMotion()
    body.T_base_left = Mount(0.3, 0.2, 0.0, forward_m=0.5).T_base_left
    for t, pose in ((0, base_pose(1, 2, 0.5)), (100, base_pose(1, 2, 0.5) @ base_pose(0, 0, 0.2))):
        body.add(WheelPose(t * MS, pose))
    motion = body.between(0, 100 * MS)
    # The base turns on the spot; the camera, half a metre ahead, goes round it.
    T_base_left = body.T_base_left
    expected = invert(base_pose(0, 0, 0.2) @ T_base_left) @ T_base_left
    np.testing.assert_allclose(motion.T_now_before, expected, atol=1e-9)
    assert np.linalg.norm(motion.T_now_before[:3, 3]) == pytest.approx(2 * 0.5 * np.sin(0.1))
    assert body.messages == {'wheel_odometry': 2, 'imu': 0}


def test_the_gyroscope_corrects_the_turn_that_slipping_wheels_tell():
    body = BodyMotion()
    body.T_base_left = Mount(0.3, 0.2).T_base_left
    body.add(WheelPose(0, np.eye(4)))
    body.add(WheelPose(100 * MS, base_pose(0.1, 0.0, 0.7)))
    for t in range(0, 101, 5):
        up_in_camera = -body.T_base_left[:3, :3].T @ np.array([0, 0, -1.0])
        body.add(ImuSample(t * MS, 2.0 * up_in_camera, np.zeros(3)))
    T_base = body.T_base_left @ invert(body.between(0, 100 * MS).T_now_before)
    T_base = T_base @ invert(body.T_base_left)
    assert Rotation.from_matrix(T_base[:3, :3]).as_rotvec() == pytest.approx([0, 0, 0.2], abs=1e-9)


def test_without_mount_or_wheels_there_is_no_way():
    body = BodyMotion()
    body.add(WheelPose(0, np.eye(4)))
    body.add(WheelPose(100 * MS, np.eye(4)))
    assert body.between(0, 100 * MS) is None
    body.T_base_left = Mount(0.3).T_base_left
    assert body.between(0, 100 * MS) is not None
    assert body.between(200 * MS, 900 * MS) is None


def test_the_adjoint_carries_a_twist_over_a_transform():
    T, twist = se3_exp(np.array([1.0, -2, 0.5, 0.3, -0.2, 0.9])), np.array([1, 2, 3, 4, 5, 6]) * 0.1
    np.testing.assert_allclose(T @ se3_exp(twist), se3_exp(adjoint(T) @ twist) @ T, atol=1e-12)


def test_a_quarter_turn_of_the_chord():
    np.testing.assert_allclose(rotation_2d(np.pi / 2) @ np.array([1.0, 0.0]), [0, 1], atol=1e-12)
