"""A camera that reads its rows out one after the other, and moves meanwhile."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.stats import chi2
from stereo_room import CAMERA, MOUNT, StereoRoom, planar_pose

from segfloor_ros.core.contracts import NO_POINT, StereoFrame
from segfloor_ros.core.geometry import Array, invert, rotation_from_angles, transform_points
from segfloor_ros.core.plugins.assembly import equipped_slam
from segfloor_ros.core.slam.rig import (
    GLOBAL_SHUTTER,
    Observations,
    Rig,
    RollingShutter,
    in_view,
    rolled,
)
from segfloor_ros.core.slam.settings import StereoSlamSettings
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


def pose_of(uvd_px: Array, points_world: Array, variance: Array) -> PoseEstimate:
    observations = Observations(uvd_px, np.full(uvd_px.shape, 0.3))
    return refine_pose(CAMERA, np.eye(4), points_world, observations, roll_variance=variance)


def test_pose_and_covariance_are_those_of_sampled_readouts() -> None:
    rng = np.random.default_rng(5)
    squared, of_global = [], []
    for _ in range(150):
        truth = se3_exp(rng.normal(size=6) * (0.03, 0.02, 0.05, 0.01, 0.03, 0.02))
        points, _ = scene(rng)
        uvd_px = seen_by_rows(points, rng.normal(size=6) * SIGMA)
        uvd_px += rng.normal(scale=0.3, size=uvd_px.shape)
        points_world = transform_points(invert(truth), points)
        found = pose_of(uvd_px, points_world, SIGMA**2)
        error = se3_log(found.T_camera_world @ invert(truth))
        squared.append(error @ np.linalg.solve(found.covariance, error))
        found = pose_of(uvd_px, points_world, GLOBAL_SHUTTER)
        error = se3_log(found.T_camera_world @ invert(truth))
        of_global.append(error @ np.linalg.solve(found.covariance, error))
    assert 0.7 < np.median(squared) / chi2.median(6) < 1.4
    assert np.mean(np.array(squared) > chi2.isf(0.0027, 6)) < 0.03
    assert np.median(of_global) > 10 * chi2.median(6)


def test_the_twist_of_the_readout_is_found_with_its_variance() -> None:
    rng = np.random.default_rng(6)
    points, _ = scene(rng, count=300)
    twist = np.array([0.012, -0.006, 0.009, 0.021, -0.034, 0.015])
    found = pose_of(seen_by_rows(points, twist), points, SIGMA**2)
    np.testing.assert_allclose(found.roll, twist, atol=0.004)
    assert (found.roll_variance > 0).all()
    assert (np.abs(found.roll - twist) < 5 * np.sqrt(found.roll_variance) + 0.001).all()
    assert np.linalg.norm(se3_log(found.T_camera_world)) < 0.004
    assert found.inliers.all()


def test_what_is_unrolled_is_what_a_camera_with_a_global_shutter_sees() -> None:
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
    unrolled = ObservedFeatures(none, seen, nowhere, twist).unrolled(rig).uvd_px
    np.testing.assert_allclose(unrolled, at_once, atol=0.15)
    far = uvd_px.copy()
    far[:, 2] = np.nan
    seen = Observations(far, np.ones(far.shape))
    turned = np.append(np.zeros(3), twist[3:])
    unrolled = ObservedFeatures(none, seen, nowhere, turned).unrolled(rig).uvd_px
    assert np.isnan(unrolled[:, 2]).all()
    share = (far[:, 1] - CAMERA.cy) / CAMERA.height
    back = in_view(
        CAMERA, rolled(CAMERA.back_project(far[:, :2], np.ones(len(far))).T, -share, turned).T
    )
    np.testing.assert_allclose(unrolled[:, :2], back[0][:, :2], atol=1e-6)


def learnt(seconds: float, is_bent: bool = False, frames: int = 300) -> Array:
    """Return the standard deviations (6,) after frames of a camera that turns to and fro, whose
    rolls follow its turns by so many seconds, or are the same in each.
    """
    shutter, rng = RollingShutter(), np.random.default_rng(8)
    for _ in range(frames):
        velocity = np.append(rng.normal(size=3) * 0.2, rng.normal(size=3))
        roll = np.full(6, 0.01) if is_bent else seconds * velocity
        roll = roll + rng.normal(size=6) * 0.003
        known = 1e-6 / shutter.variance
        left = 1 / (1 / 1e-6 + 1 / shutter.variance)
        shutter.learn(roll / (1 + known), left, velocity)
    return np.sqrt(shutter.variance)


def test_a_shutter_is_rolling_where_rolls_follow_the_turns_of_the_camera() -> None:
    expected = np.repeat([0.02 * 0.2, 0.02], 3)
    np.testing.assert_allclose(learnt(0.02), np.hypot(expected, 0.003), rtol=0.5)
    np.testing.assert_array_equal(learnt(0.0) ** 2, GLOBAL_SHUTTER)
    np.testing.assert_array_equal(learnt(0.0, is_bent=True) ** 2, GLOBAL_SHUTTER)


READOUT = 0.6
"""Of the time between two images: 20 ms of 33."""

BANDS, FRAMES = 12, 26
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


def errors_of_steps(is_rolling: bool, monkeypatch: pytest.MonkeyPatch) -> tuple[Array, Array]:
    """Return by how much the ways between frames err, in m, and the last variance (6,)."""
    if not is_rolling:
        monkeypatch.setattr(RollingShutter, 'learn', lambda self, *seen: None)
    slam, room = equipped_slam(CAMERA, StereoSlamSettings(), MOUNT), StereoRoom()
    results = [r for k in range(FRAMES) for r in slam.process(pictures(room, k))]
    assert all(result.tracked for result in results)
    found = np.array([result.T_odom_base for result in results])[14:]
    true = np.array([shaken(k) for k in range(FRAMES)])[14:]
    slam.close()
    steps, true_steps = (invert(T[:-1]) @ T[1:] for T in (found, true))
    error_m = np.linalg.norm(steps[:, :3, 3] - true_steps[:, :3, 3], axis=1)
    return error_m, slam.rig.shutter.variance


def test_a_shaken_camera_with_a_rolling_shutter_is_tracked_as_well_as_one_without(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    error, variance = errors_of_steps(True, monkeypatch)
    without, _ = errors_of_steps(False, monkeypatch)
    assert np.median(error) < 0.5 * np.median(without)
    assert 0.005 < np.sqrt(variance[3]) < 0.08
