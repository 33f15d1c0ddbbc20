"""A camera that reads its rows out one after the other, and moves meanwhile."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.stats import chi2
from stereo_room import CAMERA, MOUNT, StereoRoom, planar_pose

from segfloor_ros.core.contracts import NO_POINT, FrameResult, StereoFrame
from segfloor_ros.core.geometry import Array, invert, rotation_from_angles, transform_points
from segfloor_ros.core.plugins.assembly import equipped_slam
from segfloor_ros.core.slam.rig import (
    AT_ONCE,
    LOCAL_KEYFRAMES,
    Observations,
    Readout,
    Rig,
    RollingShutter,
    in_view,
    moved_on,
)
from segfloor_ros.core.slam.settings import StereoSlamSettings
from segfloor_ros.core.slam.sparse_map import features_of
from segfloor_ros.core.slam.stereo_slam import StereoSlam
from segfloor_ros.core.slam.tracking.images import Features
from segfloor_ros.core.slam.tracking.pose import PoseEstimate, refine_pose
from segfloor_ros.core.slam.tracking.track import ObservedFeatures
from segfloor_ros.core.twists import se3_exp, se3_log

SIGMA = np.array([0.01, 0.01, 0.01, 0.02, 0.02, 0.02])
"""Of the twist during the readout: a hand that turns by a radian a second has 0.025 rad."""


def scene(rng: np.random.Generator, count: int = 120) -> tuple[Array, Array]:
    """Return points of the camera (N, 3) in view, far above and near below, and their pixels and
    disparities (N, 3).
    """
    uv_px = rng.uniform((5, 5), (CAMERA.width - 5, CAMERA.height - 5), (count, 2))
    points = CAMERA.back_project(uv_px, 4.0 - 3.0 * uv_px[:, 1] / CAMERA.height)
    return points, in_view(CAMERA, points)[0]


def seen_by_rows(points: Array, twist: Array) -> Array:
    """Return pixels and disparities (N, 3) where each row is read out in its own moment."""
    uvd_px = in_view(CAMERA, points)[0]
    for _ in range(20):
        share = (uvd_px[:, 1] - CAMERA.cy) / CAMERA.height
        moved = np.stack(
            [
                transform_points(se3_exp(s * twist), p[None])[0]
                for s, p in zip(share, points, strict=True)
            ]
        )
        uvd_px = in_view(CAMERA, moved)[0]
    return uvd_px


def pose_of(uvd_px: Array, points_world: Array, expected: Readout) -> PoseEstimate:
    observations = Observations(uvd_px, np.full(uvd_px.shape, 0.3))
    return refine_pose(CAMERA, np.eye(4), points_world, observations, readout=expected)


def test_pose_and_covariance_are_those_of_sampled_readouts() -> None:
    rng = np.random.default_rng(5)
    mean = np.array([0.01, -0.02, 0.01, 0.03, -0.02, 0.04])
    squared, of_global, of_no_mean = [], [], []
    for _ in range(150):
        truth = se3_exp(rng.normal(size=6) * (0.03, 0.02, 0.05, 0.01, 0.03, 0.02))
        points, _ = scene(rng)
        uvd_px = seen_by_rows(points, mean + rng.normal(size=6) * SIGMA)
        uvd_px += rng.normal(scale=0.3, size=uvd_px.shape)
        points_world = transform_points(invert(truth), points)
        for errors, expected in (
            (squared, Readout(mean, SIGMA**2)),
            (of_global, AT_ONCE),
            (of_no_mean, Readout(np.zeros(6), (0.1 * SIGMA) ** 2)),
        ):
            found = pose_of(uvd_px, points_world, expected)
            error = se3_log(found.T_camera_world @ invert(truth))
            errors.append(error @ np.linalg.solve(found.covariance, error))
    assert 0.7 < np.median(squared) / chi2.median(6) < 1.4
    assert np.mean(np.array(squared) > chi2.isf(0.0027, 6)) < 0.03
    assert np.median(of_global) > 10 * chi2.median(6)
    assert np.median(of_no_mean) > 3 * chi2.median(6)


def test_the_twist_of_the_readout_is_found_with_its_variance() -> None:
    rng = np.random.default_rng(6)
    points, _ = scene(rng, count=300)
    twist = np.array([0.012, -0.006, 0.009, 0.021, -0.034, 0.015])
    found = pose_of(seen_by_rows(points, twist), points, Readout(np.zeros(6), SIGMA**2))
    np.testing.assert_allclose(found.readout.twist, twist, atol=0.004)
    assert (found.readout.variance > 0).all()
    off = np.abs(found.readout.twist - twist)
    assert (off < 5 * np.sqrt(found.readout.variance) + 0.001).all()
    assert np.linalg.norm(se3_log(found.T_camera_world)) < 0.004
    assert found.inliers.all()


def test_a_keyframe_measures_what_a_camera_with_a_global_shutter_does() -> None:
    rng = np.random.default_rng(7)
    points, at_once = scene(rng)
    twist = np.array([0.008, -0.006, 0.009, 0.021, -0.034, 0.015])
    uvd_px = seen_by_rows(points, twist)
    assert np.abs(uvd_px - at_once).max() > 4
    nowhere = np.full(len(points), NO_POINT, np.int32)
    none = Features(
        uvd_px[:, :2], np.zeros(len(points), np.int32), np.zeros((len(points), 32), np.uint8)
    )
    seen = Observations(uvd_px, np.ones(uvd_px.shape))
    rig = Rig(CAMERA)
    moved = ObservedFeatures(none, seen, nowhere, twist).at_once(rig).uvd_px
    np.testing.assert_allclose(moved, at_once, atol=0.15)
    far = uvd_px.copy()
    far[:, 2] = np.nan
    seen = Observations(far, np.ones(far.shape))
    turned = np.append(np.zeros(3), twist[3:])
    moved = ObservedFeatures(none, seen, nowhere, turned).at_once(rig).uvd_px
    assert np.isnan(moved[:, 2]).all()
    share = (far[:, 1] - CAMERA.cy) / CAMERA.height
    back = in_view(
        CAMERA, moved_on(CAMERA.back_project(far[:, :2], np.ones(len(far))).T, -share, turned).T
    )
    np.testing.assert_allclose(moved[:, :2], back[0][:, :2], atol=1e-6)


def learnt(
    seconds: float, way: float = 0.2, turn: float = 1.0, bend: float = 0.0, frames: int = 300
) -> float:
    """Return the readout in s that is found in frames of a camera that moves to and fro, by its map
    of keyframes, every third frame. bend: of each image, constant.
    """
    shutter, rng = RollingShutter(), np.random.default_rng(8)
    sigma = np.repeat([way, turn], 3)
    left_in_map: list[Array] = []
    for k in range(frames):
        velocity = rng.normal(size=6) * sigma
        shutter.expect(velocity + rng.normal(size=6) * 0.1 * sigma, (0.1 * sigma) ** 2)
        twist = seconds * velocity - np.mean(left_in_map[-LOCAL_KEYFRAMES:] or [np.zeros(6)], 0)
        measured, known = twist + bend + rng.normal(size=6) * 0.002, shutter.expected
        variance = 1 / (1 / 0.002**2 + 1 / known.variance)
        mean = variance * (measured / 0.002**2 + known.twist / known.variance)
        if k % 3 == 0:
            shutter.see_keyframe(velocity)
            left_in_map.append((seconds - shutter.seconds) * velocity)
        shutter.learn(Readout(mean, variance), velocity)
    return shutter.seconds


def test_the_readout_is_found_by_turns_and_by_ways_alone() -> None:
    assert learnt(0.02) == pytest.approx(0.02, abs=0.003)
    assert learnt(-0.015) == pytest.approx(-0.015, abs=0.003)
    assert learnt(0.02, turn=0.0) == pytest.approx(0.02, abs=0.008)


def test_what_no_readout_explains_is_taken_for_none() -> None:
    assert learnt(0.0) == 0.0
    assert learnt(0.0, bend=0.01) == 0.0
    assert learnt(-0.2) == 0.0  # something else that follows turns: no camera takes so long
    assert learnt(0.02, frames=2) == 0.0


def test_the_next_image_is_expected_to_be_bent_by_the_velocity() -> None:
    shutter = RollingShutter()
    shutter.seconds = 0.02
    velocity = np.array([0.1, 0.0, 0.4, 0.0, 1.0, 0.2])
    shutter.expect(velocity, np.full(6, 0.01))
    np.testing.assert_allclose(shutter.expected.twist, 0.02 * velocity)
    np.testing.assert_allclose(shutter.expected.variance, 0.02**2 * 0.01, rtol=1e-3)


READOUT = 0.6
"""Of the time between two images: 20 ms of 33."""

BANDS, FRAMES = 12, 40
"""Bands in which a picture is drawn, each from where the camera is meanwhile; and pictures."""


def shaken(frame: float) -> Array:
    """Return the pose of a base in a hand that drives on and shakes."""
    T = planar_pose(0.02 * frame, 0.01 * frame, 0.0)
    yaw, pitch = 0.16 * np.sin(0.5 * frame), 0.08 * np.sin(0.7 * frame + 0.5)
    T[:3, :3] = rotation_from_angles(yaw, pitch, 0.05 * np.sin(0.4 * frame))
    return T


def pictures(room: StereoRoom, frame: int) -> StereoFrame:
    edges = np.linspace(0, CAMERA.height, BANDS + 1).astype(int)
    whole = room.frame(frame, shaken(frame), 30.0)
    left, right = whole.left.copy(), whole.right.copy()
    for a, b in pairwise(edges):
        later = READOUT * ((a + b) / 2 - CAMERA.cy) / CAMERA.height
        part = room.frame(frame, shaken(frame + later), 30.0)
        left[a:b], right[a:b] = part.left[a:b], part.right[a:b]
    return StereoFrame(frame, whole.stamp_ns, left, right)


def drive(room: StereoRoom) -> tuple[StereoSlam, list[FrameResult]]:
    slam = equipped_slam(CAMERA, StereoSlamSettings(), MOUNT)
    results = [result for k in range(FRAMES) for result in slam.process(pictures(room, k))]
    assert all(result.tracked for result in results)
    slam.close()
    return slam, results


@pytest.fixture(scope='module')
def driven() -> tuple[StereoSlam, list[FrameResult]]:
    return drive(StereoRoom())


def errors_of_steps(results: list[FrameResult]) -> Array:
    """Return by how much the ways between later frames err, in m."""
    found = np.array([result.T_odom_base for result in results])[14:]
    true = np.array([shaken(k) for k in range(FRAMES)])[14:]
    steps, true_steps = (invert(T[:-1]) @ T[1:] for T in (found, true))
    return np.linalg.norm(steps[:, :3, 3] - true_steps[:, :3, 3], axis=1)


def test_a_shaken_camera_with_a_rolling_shutter_is_tracked_as_well_as_one_without(
    driven: tuple[StereoSlam, list[FrameResult]], monkeypatch: pytest.MonkeyPatch
) -> None:
    slam, results = driven
    monkeypatch.setattr(RollingShutter, 'learn', lambda self, *seen: None)
    without = errors_of_steps(drive(StereoRoom())[1])
    assert np.median(errors_of_steps(results)) < 0.5 * np.median(without)
    assert slam.rig.shutter.seconds == pytest.approx(READOUT / 30, rel=0.5)


def test_published_features_are_where_the_image_shows_them(
    driven: tuple[StereoSlam, list[FrameResult]],
) -> None:
    slam, results = driven
    published = [result.keyframe for result in results if result.keyframe is not None]
    records = {keyframe.stamp_ns: keyframe for keyframe in slam.map.keyframes}
    moved_px = []
    for keyframe in published[-3:]:
        record, shown_px = records[keyframe.stamp_ns], keyframe.features.uv_px
        np.testing.assert_allclose(shown_px, record.features.uv_px, atol=3.0)
        off_px = np.linalg.norm(record.observations.uvd_px[:, :2] - shown_px, axis=1)
        moved_px.append(np.median(off_px))
    # One that was made where the camera turned back hardly moves.
    assert max(moved_px) > 1.0


def test_a_keyframe_is_found_again_by_what_was_measured_in_it_whatever_the_camera_does(
    driven: tuple[StereoSlam, list[FrameResult]], monkeypatch: pytest.MonkeyPatch
) -> None:
    slam, _ = driven
    keyframe = slam.map.keyframes[-1]
    turning = Readout(np.array([0.0, 0.0, 0.0, 0.02, 0.05, 0.0]), np.full(6, 1e-8))
    monkeypatch.setattr(slam.rig.shutter, 'expected', turning)
    seen = keyframe.observations.exact()
    features, pose = features_of(slam.map, keyframe), keyframe.T_camera_world
    found = slam.front_end.tracker.track_at(seen, features, keyframe.seen_ids, pose)
    assert found is not None
    assert np.linalg.norm(se3_log(found.T_camera_world @ invert(pose))) < 0.005
