"""The drive of the base and the calibration and motion of the stereo rig."""

import cv2
import numpy as np
import pytest

from segfloor_ros.apps.simulation.camera import (
    brightness,
    develop,
    plan_imaging,
    raw_cameras,
    rectified_camera,
    undistort,
)
from segfloor_ros.apps.simulation.motion import RigMotion, plan_drive, shake
from segfloor_ros.apps.simulation.scene import CameraRig, Lighting, Route, Scene, Slope, Vibration
from segfloor_ros.apps.simulation.solids import floors
from segfloor_ros.core.contracts import Mount
from segfloor_ros.core.errors import InputError

DISTORTION = (-0.12, 0.016, 0.0004, -0.0003, 0.0)


def test_straight_drive_speeds_up_and_brakes():
    route = Route(((0.0, 0.0), (4.0, 0.0)), speed_m_s=0.5, acceleration_m_s2=0.25)
    drive = plan_drive(route, 20.0)
    # Two seconds and half a metre to speed up, the same to brake, three metres at speed.
    assert drive.times_s[-1] == pytest.approx(2 + 2 + 3 / 0.5, abs=0.2)
    speed = np.diff(drive.xy_yaw[:, 0]) * 20
    assert speed.max() == pytest.approx(0.5, abs=1e-3)
    assert np.abs(np.diff(speed)).max() * 20 < 0.6
    np.testing.assert_allclose(drive.xy_yaw[:, 1:], 0.0, atol=1e-9)
    assert drive.xy_yaw[-1, 0] == pytest.approx(4.0, abs=0.03)


def test_corners_are_rounded_and_driven_no_faster_than_the_turn_rate():
    route = Route(((0.0, 0.0), (3.0, 0.0), (3.0, 3.0)), turn_rate_deg_s=30.0)
    drive = plan_drive(route, 10.0)
    turn = np.degrees(np.diff(drive.xy_yaw[:, 2]))
    assert np.abs(turn).max() <= 3.0 + 1e-6
    assert turn.sum() == pytest.approx(90.0, abs=1.0)
    assert np.abs(np.diff(turn)).max() < 1.0
    np.testing.assert_allclose(drive.xy_yaw[0], [0, 0, 0], atol=1e-6)
    np.testing.assert_allclose(drive.xy_yaw[-1], [3, 3, np.pi / 2], atol=0.05)


def test_turning_back_happens_on_the_spot():
    route = Route(((0.0, 0.0), (2.0, 0.0), (0.5, 0.0)), turn_rate_deg_s=45.0)
    drive = plan_drive(route, 10.0)
    turn = np.abs(np.degrees(np.diff(drive.xy_yaw[:, 2])))
    assert turn.max() <= 4.5 + 1e-6
    assert turn.sum() == pytest.approx(180.0, abs=1e-6)
    assert drive.xy_yaw[-1, 0] == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize('waypoints', [(), ((1.0, 1.0),), ((1.0, 1.0), (1.0, 1.0))])
def test_a_path_needs_two_places(waypoints):
    with pytest.raises(InputError, match='two different waypoints'):
        plan_drive(Route(waypoints), 10.0)


def test_undistorting_inverts_the_lens():
    rng = np.random.default_rng(0)
    points = np.column_stack(
        [rng.uniform(-1.1, 1.1, 200), rng.uniform(-0.8, 0.8, 200), np.ones(200)]
    )
    D = np.array(DISTORTION)
    distorted = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), D)[0].reshape(-1, 2)
    x, y = undistort(distorted[:, 0], distorted[:, 1], D)
    np.testing.assert_allclose(np.column_stack([x, y]), points[:, :2], atol=1e-7)


def test_raw_cameras_rectify_to_the_ideal_pair():
    rig = CameraRig(distortion=DISTORTION, misalignment_deg=0.8)
    camera = rectified_camera(rig)
    points = np.array([[0.3, -0.2, 1.5], [-1.0, 0.5, 3.0], [0.1, 0.1, 0.8]])
    expected = camera.project(points)
    for index, side in enumerate(raw_cameras(rig, seed=4)):
        seen_from = points - [rig.baseline_m * index, 0, 0]
        raw = cv2.projectPoints(seen_from @ side.R, np.zeros(3), np.zeros(3), side.K, side.D)[0]
        back = cv2.undistortPoints(raw, side.K, side.D, R=side.R, P=side.P).reshape(-1, 2)
        np.testing.assert_allclose(back[:, 0], expected[:, 2 * index], atol=0.05)
        np.testing.assert_allclose(back[:, 1], expected[:, 1], atol=0.05)
        assert side.P[0, 3] == pytest.approx(-index * camera.fx * rig.baseline_m)
        assert np.degrees(np.arccos((np.trace(side.R) - 1) / 2)) == pytest.approx(0.8)


@pytest.mark.parametrize('fisheye', [False, True])
def test_raw_picture_shows_what_the_ideal_one_shows(fisheye):
    lens = {'distortion': (0.02, -0.005, 0.003, -0.001) if fisheye else DISTORTION}
    scene = Scene('', Route(((0, 0), (1, 0))), camera=CameraRig(
        width=160, height=120, misalignment_deg=0.8, noise_sigma=0.0, fisheye=fisheye, **lens
    ))  # fmt: skip
    plan = plan_imaging(scene)
    # A picture whose brightness tells the position: bilinear in the ideal picture's column.
    ideal = np.tile(np.linspace(20, 220, plan.width, dtype=np.float32), (plan.height, 1))
    camera, side = rectified_camera(scene.camera), plan.raw[0]
    raw = develop(ideal, plan, scene, 0, 0, 0.0)
    assert side.distortion_model == ('equidistant' if fisheye else 'plumb_bob')
    straight = cv2.fisheye.initUndistortRectifyMap if fisheye else cv2.initUndistortRectifyMap
    maps = straight(side.K, side.D, side.R, side.P[:, :3], (160, 120), cv2.CV_32FC1)
    rectified = cv2.remap(raw, maps[0], maps[1], cv2.INTER_LINEAR, borderValue=0)
    column = (np.arange(160) - camera.cx) + (plan.width - 1) / 2
    expected = 20 + 200 * column / (plan.width - 1)
    inner = (slice(20, 100), slice(20, 140))
    assert np.abs(rectified.astype(float) - expected[None])[inner].max() < 1.5


def test_noise_depends_on_seed_frame_and_side_alone():
    scene = Scene('', Route(((0, 0), (1, 0))), camera=CameraRig(width=64, height=48))
    plan = plan_imaging(scene)
    ideal = np.full((48, 64), 100, np.float32)
    first, again = (develop(ideal, plan, scene, 0, 7, 0.0) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    for side, frame in ((1, 7), (0, 8)):
        assert (develop(ideal, plan, scene, side, frame, 0.0) != first).any()
    assert first.std() == pytest.approx(1.5, abs=0.2)
    assert first.mean() == pytest.approx(100, abs=0.2)


def test_light_changes_and_gain():
    lights = Lighting(levels=((1.0, 1.0), (2.0, 0.5)))
    camera = CameraRig(width=64, height=48, noise_sigma=0.0, right_gain=0.8)
    scene = Scene('', Route(((0, 0), (1, 0))), lighting=lights, camera=camera)
    assert [brightness(scene, t) for t in (0.0, 1.5, 9.0)] == [1.0, 0.75, 0.5]
    ideal = np.full((48, 64), 100, np.float32)
    plan = plan_imaging(scene)
    assert develop(ideal, plan, scene, 0, 0, 9.0).mean() == 50
    assert develop(ideal, plan, scene, 1, 0, 9.0).mean() == 40


def test_base_follows_the_ramp():
    scene = Scene(
        '',
        Route(((0.0, 0.0), (4.0, 0.0)), smoothing_m=0.0),
        slopes=(Slope((1.0, 0.0, 0.0), (3.0, 0.0, 0.2), 2.0),),
        camera=CameraRig(height_m=0.3, pitch_deg=0.0),
    )
    drive = plan_drive(scene.path, 10.0)
    motion = RigMotion(scene, drive, floors(scene))
    time_s = float(np.interp(2.0, drive.xy_yaw[:, 0], drive.times_s))
    T_world_base = motion.T_world_base(time_s)
    np.testing.assert_allclose(T_world_base[:3, 3], [2.0, 0.0, 0.1], atol=1e-3)
    # Its x axis points up the slope of one in ten.
    assert T_world_base[2, 0] == pytest.approx(np.sin(np.arctan(0.1)), abs=1e-3)
    assert motion.T_world_left(0.0)[2, 3] == pytest.approx(0.3)


def test_shaking_is_bounded_and_repeats():
    vibration = Vibration(roll_deg=2.0, pitch_deg=1.0, bounce_m=0.01)
    motion = np.array([shake(vibration, 5, t) for t in np.arange(0, 20, 0.05)])
    assert (np.abs(motion).max(axis=0) <= [np.radians(2.0), np.radians(1.0), 0.01]).all()
    assert (motion.std(axis=0) > 0).all()
    np.testing.assert_array_equal(motion[100], shake(vibration, 5, 5.0))
    assert shake(Vibration(), 5, 1.0) == (0.0, 0.0, 0.0)
    rig = CameraRig(height_m=0.3, pitch_deg=10.0, vibration=vibration, forward_m=0.2)
    scene = Scene('', Route(((1.0, 2.0), (1.0, 6.0))), camera=rig, seed=5)
    drive = plan_drive(scene.path, 10.0)
    T_world_left = RigMotion(scene, drive, []).T_world_left(5.0)
    roll, pitch, bounce_m = shake(vibration, 5, 5.0)
    assert T_world_left[2, 3] == pytest.approx(0.3 + bounce_m)
    mount = Mount(0.3 + bounce_m, np.radians(10) + pitch, roll, rig.forward_m)
    # The drive is along y, and so is what is ahead of the base.
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(T_world_left[:3, :3], turn @ mount.T_base_left[:3, :3], atol=1e-12)
    np.testing.assert_allclose(T_world_left[:2, 3], drive.at([5.0])[0, :2] + (0.0, 0.2))
