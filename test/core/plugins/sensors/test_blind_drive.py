"""A drive through a rendered room that the camera does not see for a while."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from stereo_room import CAMERA, MOUNT, StereoRoom, planar_pose

from segfloor_ros.core.contracts import ImuSample, StereoFrame, WheelPose
from segfloor_ros.core.geometry import invert, make_transform, transform_points
from segfloor_ros.core.plugins.assembly import equipped_slam
from segfloor_ros.core.slam.rig import Observations
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.slam.tracking.front_end import FrontEnd
from segfloor_ros.core.slam.tracking.images import Images
from segfloor_ros.core.slam.tracking.patch_alignment import align_patches, sample_patches
from segfloor_ros.core.slam.tracking.pose import refine_pose
from segfloor_ros.core.slam.tracking.track import Track

SETTINGS = StereoSlamSettings(num_features=800)
FRAMES = 34
BLIND = range(10, 24)
START = planar_pose(7.0, -3.0, 1.0)
"""Where the wheels begin, in a frame of their own."""

GYRO_BIAS = np.array([0.01, -0.01, 0.02])


def base_at(k):
    """4 cm a frame, and two degrees to the left: at the end the robot looks at other walls."""
    yaw = np.radians(2.0) * k
    radius = 0.04 / np.radians(2.0)
    return planar_pose(radius * np.sin(yaw), radius * (1 - np.cos(yaw)), yaw)


@pytest.fixture(scope='module')
def frames():
    room = StereoRoom()
    grey = np.full((CAMERA.height, CAMERA.width), 90, np.uint8)
    return [
        StereoFrame(k, round(k * 1e8), grey, grey) if k in BLIND else room.frame(k, base_at(k))
        for k in range(FRAMES)
    ]


def wheel_poses(scale=1.0, slip=()):
    """Return poses 20 ms apart, of `scale` metres for each metre, and twice that in `slip`."""
    measured = [START]
    for k in range(1, 5 * FRAMES + 2):
        step = invert(base_at((k - 1) / 5)) @ base_at(k / 5)
        step[:2, 3] *= scale * (2 if k // 5 in slip else 1)
        measured.append(measured[-1] @ step)
    return [WheelPose(round(k * 2e7), pose) for k, pose in enumerate(measured)]


def imu_samples():
    turn = MOUNT.T_base_left[:3, :3].T @ np.array([0, 0, np.radians(20.0)])
    return [ImuSample(round(k * 5e6), turn + GYRO_BIAS, np.zeros(3)) for k in range(20 * FRAMES)]


def drive(frames, *measurements):
    slam = equipped_slam(CAMERA, SETTINGS, MOUNT)
    waiting = sorted((m for one in measurements for m in one), key=lambda m: m.stamp_ns)
    results = []
    for frame in frames:
        while waiting and waiting[0].stamp_ns <= frame.stamp_ns:
            slam.add(waiting.pop(0))
        results += slam.process(frame)
    return slam, results


def errors_m(results):
    errors = [invert(base_at(r.index)) @ r.T_map_odom @ r.T_odom_base for r in results]
    return np.array([np.linalg.norm(error[:3, 3]) for error in errors])


@pytest.fixture(scope='module')
def on_wheels(frames):
    return drive(frames, wheel_poses(), imu_samples())


def test_without_sensors_the_camera_is_lost(frames):
    _, results = drive(frames)
    assert [r.index for r in results if not r.tracked][: len(BLIND)] == list(BLIND)


def test_with_wheels_and_gyroscope_every_frame_has_a_pose(on_wheels):
    _, results = on_wheels
    assert all(result.tracked for result in results)
    # 56 cm and 28 degrees without a picture.
    assert errors_m(results).max() < 0.012
    states = {k: results[k].state for k in (9, 10, 23, 30)}
    assert states[9] == states[30] == 'tracking'
    assert states[10].startswith('on wheels: left image without contrast')
    assert states[23].startswith('on wheels')


def test_the_covariance_grows_while_blind_and_odom_does_not_jump(on_wheels):
    _, results = on_wheels
    sigma_m = [np.sqrt(np.trace(r.covariance[:2, :2])) for r in results]
    assert np.diff(sigma_m[9:23]).min() > 0
    assert sigma_m[22] > errors_m(results)[22]
    assert sigma_m[30] < 0.2 * sigma_m[22]
    odom = np.array([r.T_odom_base[:3, 3] for r in results])
    steps_m = np.linalg.norm(np.diff(odom, axis=0), axis=1)
    np.testing.assert_allclose(steps_m, 0.04, atol=0.004)


def test_the_gyroscope_bias_was_learnt_before_it_was_needed(on_wheels):
    slam, _ = on_wheels
    assert np.abs(slam.sensors.gyroscope.bias_rad_s - GYRO_BIAS).max() < 0.004
    assert slam.sensors.messages == {'wheel_odometry': 5 * FRAMES - 4, 'imu': 20 * FRAMES - 19}


@pytest.mark.slow
def test_wheels_alone_bridge_as_well(frames):
    _, results = drive(frames, wheel_poses())
    assert all(result.tracked for result in results)
    assert errors_m(results).max() < 0.03


@pytest.mark.slow
def test_a_gyroscope_alone_bridges_a_second(frames):
    _, results = drive(frames, imu_samples())
    assert results[19].tracked and results[19].state.startswith('on gyroscope')
    sigma_m = np.sqrt(np.diag(results[19].covariance)[:3].max())
    assert sigma_m > 2 * errors_m(results)[19] and sigma_m > 0.1


@pytest.mark.slow
def test_wheels_that_slip_while_the_camera_sees_are_found_out_and_cost_nothing(frames):
    room = StereoRoom()
    seen = [room.frame(k, base_at(k)) for k in range(FRAMES)]
    slam, results = drive(seen, wheel_poses(slip=range(12, 22)), imu_samples())
    assert all(result.state == 'tracking' for result in results)
    assert errors_m(results).max() < 0.01
    assert slam.sensors.slips >= 2


@pytest.mark.slow
def test_a_wrong_scale_is_said_and_taken_into_account():
    # Left and right in turn: on a single arc the scale looks like a camera beside the middle.
    path = [planar_pose(0, 0, 0)]
    for k in range(450):
        step = planar_pose(0.008, 0, np.radians(0.4) * np.cos(k / 40))
        path.append(path[-1] @ step)
    room, measured = StereoRoom(), [START]
    seen = [room.frame(k, path[5 * k]) for k in range(90)]
    for before, now in pairwise(path):
        step = invert(before) @ now
        step[:2, 3] *= 1.08
        measured.append(measured[-1] @ step)
    slam, _ = drive(seen, [WheelPose(round(k * 2e7), pose) for k, pose in enumerate(measured)])
    assert '1.08' in slam.sensors.remarks['scale'] or '1.07' in slam.sensors.remarks['scale']
    motion = slam.sensors.between(round(4e9), round(5e9))
    expected = invert(path[250] @ MOUNT.T_base_left) @ path[200] @ MOUNT.T_base_left
    np.testing.assert_allclose(motion.T_now_before, expected, atol=0.005)


def picture_and_pixels(shows):
    """Return a picture of an edge or of a texture, and pixels (N, 2) on the edge, or anywhere."""
    rng, u = np.random.default_rng(1), np.arange(CAMERA.width, dtype=np.float64)
    if shows == 'an edge':
        rows = np.arange(20, CAMERA.height - 20, 10)
        uv_px = np.stack([np.full(len(rows), CAMERA.width / 2), rows], axis=1)
        image = np.tile(np.where(u > CAMERA.width / 2, 150.0, 90.0), (CAMERA.height, 1))
    else:
        uv_px = rng.uniform(12, [CAMERA.width - 12, CAMERA.height - 12], (150, 2))
        image = rng.uniform(60, 160, (CAMERA.height, CAMERA.width))
    return (image + rng.normal(0, 1.5, image.shape)).clip(0, 255).astype(np.float32), uv_px


def seen_from(slam, T_camera_world, image, uv_px):
    """Return the track of points of the map, which an image shows just so from a pose (4, 4)."""
    points = CAMERA.back_project(uv_px, np.full(len(uv_px), 2.0))
    disparity = np.full(len(uv_px), CAMERA.disparity_times_depth / 2.0)
    patches, zoom = sample_patches(image, uv_px), np.ones(len(uv_px))
    sigma_px = np.column_stack([align_patches(patches, image, uv_px, zoom).sigma_px, zoom])
    measured = Observations(np.column_stack([uv_px, disparity]), np.maximum(sigma_px, 0.15))
    ids = np.arange(len(uv_px), dtype=np.int32)
    slam.map.xyz_world[ids] = transform_points(invert(T_camera_world), points)
    estimate = refine_pose(CAMERA, T_camera_world, slam.map.xyz_world[ids], measured)
    return Track(estimate, ids, measured, ids)


@pytest.mark.parametrize(
    ('shows', 'slides_m'), [('an edge', 0.03), ('an edge', 0.1), ('a texture', 0.2)]
)
def test_points_that_slide_along_an_edge_do_not_outweigh_wheels(
    frames, monkeypatch, shows, slides_m
):
    """On an edge the pose is where the wheels have it, and what has texture finds wheels out."""
    slam, _ = drive(frames[:9], wheel_poses())
    for pose in wheel_poses()[5 * 8 + 1 : 5 * 9 + 1]:
        slam.add(pose)
    front_end, frame = slam.front_end, frames[9]
    predicted = front_end.motion.predict(frame.stamp_ns)
    slid = make_transform(np.eye(3), np.array([0.0, slides_m, 0.0]))
    seen = seen_from(slam, slid @ predicted, *picture_and_pixels(shows))
    monkeypatch.setattr(FrontEnd, '_followed', lambda *_: seen)
    track = front_end.track(frame, Images.of(frame, CAMERA))
    if track is None:
        front_end.bridge(frame, '')
    off_m = np.linalg.norm((front_end.motion.T_camera_world @ invert(predicted))[:3, 3])
    if shows == 'an edge':
        assert off_m < 0.2 * slides_m
    else:
        assert off_m == pytest.approx(slides_m, rel=0.1)


@pytest.mark.slow
def test_a_turn_without_a_picture_is_as_the_gyroscope_measures_it(frames):
    _, results = drive(frames, imu_samples())
    turned = invert(results[9].T_odom_base) @ results[19].T_odom_base
    yaw = Rotation.from_matrix(turned[:3, :3]).as_rotvec()[2]
    assert yaw == pytest.approx(np.radians(20.0), abs=0.01)
