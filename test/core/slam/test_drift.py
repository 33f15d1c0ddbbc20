"""How far odometry says that it has gone astray, compared with sampled paths, on a turn."""

from itertools import pairwise

import cv2
import numpy as np
import pytest
from sampled_poses import assert_spread, drawn_errors, uneven_covariance

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import (
    FrameResult,
    Keyframe,
    KeyframeFeatures,
    KeyframePath,
    Mount,
    SparseCloud,
)
from segfloor_ros.core.geometry import invert, transform_points
from segfloor_ros.core.slam.drift import (
    AXIS_SIGMA_PX,
    SCALE_SIGMA,
    DriftMeter,
    covariance_at,
    twist_of_place,
)
from segfloor_ros.core.twists import rotations_by, se3_exp, se3_logs

STEP = se3_exp(np.array([0.3, 0.05, -0.02, -0.03, 0.02, 0.12]))
"""A base that drives and turns by 0.12 rad; of T_before_now."""

STEPS, STEP_NS = 12, 100_000_000
CAMERA = StereoCamera(640, 480, 320.0, 320.0, 319.5, 239.5, 0.12)
NOTHING = np.zeros((6, 6))
T_BASE_LEFT = Mount(0.45, 0.35, -0.2, yaw_rad=0.4, forward_m=0.3, left_m=-0.15).T_base_left


def arc():
    """Return poses (N, 4, 4) of a base on a turn."""
    poses = [se3_exp(np.array([1.0, -0.5, 0.1, 0.2, -0.1, 0.7]))]
    for _ in range(STEPS):
        poses.append(poses[-1] @ STEP)
    return poses


def result_at(k, T_odom_base, covariance=NOTHING, **more):
    """Return the outcome of frame k."""
    stamp_ns = (k + 1) * STEP_NS
    return FrameResult(
        k, stamp_ns, True, T_odom_base, np.eye(4), covariance, 50, 'tracking', 0, **more
    )


def keyframe_at(T_map_base, xyz_map, uv_px, offset_px2=NOTHING[:3, :3]):
    """Return a keyframe that sees points (N, 3) at pixels (N, 2)."""
    ids, image = np.arange(len(xyz_map), dtype=np.int32), np.zeros((0, 0), np.uint8)
    features = KeyframeFeatures(uv_px.astype(np.float32), ids, xyz_map)
    path = KeyframePath(np.zeros(1, np.int64), T_map_base[None])
    cloud = SparseCloud(ids, xyz_map)
    return Keyframe(0, 0, T_map_base, image, image, features, path, cloud, offset_px2=offset_px2)


def blind_keyframe(T_map_base):
    """Return a keyframe that sees nothing."""
    return keyframe_at(T_map_base, np.zeros((0, 3)), np.zeros((0, 2)))


def driven(poses, covariance=NOTHING, keyframes=False):
    """Return the drift after poses (N, 4, 4)."""
    meter = DriftMeter(CAMERA)
    meter.T_base_left = T_BASE_LEFT
    for k, T in enumerate(poses):
        meter.see(result_at(k, T, covariance), blind_keyframe(T) if keyframes and k > 0 else None)
    return meter


def place_and_turn(samples, T):
    """Return by how much poses (N, 4, 4) differ from T (4, 4) in place and turn, (N, 6), in the
    axes of the frame.
    """
    turns = np.tile(np.eye(4), (len(samples), 1, 1))
    turns[:, :3, :3] = samples[:, :3, :3] @ T[:3, :3].T
    return np.concatenate([samples[:, :3, 3] - T[:3, 3], se3_logs(turns)[:, 3:]], axis=1)


def test_the_twist_of_a_place_and_a_turn_moves_a_pose_by_these() -> None:
    rng, T = np.random.default_rng(0), arc()[3]
    errors = 1e-6 * rng.normal(size=(20, 6))
    moved = se3_exp(errors @ twist_of_place(T).T) @ T
    np.testing.assert_allclose(place_and_turn(moved, T), errors, atol=1e-10)


def test_each_keyframe_adds_the_error_of_its_pose_and_of_the_points_before_it() -> None:
    rng = np.random.default_rng(1)
    covariance, poses = uneven_covariance(rng), arc()
    meter = driven(poses, covariance, keyframes=True)
    drift = meter.drift.copy()
    drift[:, 6:] = 0.0
    samples = np.tile(poses[0], (6000, 1, 1))
    for before, now in pairwise(poses):
        samples = samples @ invert(before) @ now
        for _ in range(2):
            # Errors of the place and the turn, in the axes of the frame.
            errors = drawn_errors(rng, covariance) @ twist_of_place(now).T
            samples = samples @ invert(now) @ se3_exp(errors) @ now
    T = poses[-1]
    assert_spread(place_and_turn(samples, T), covariance_at(drift, T))


def test_what_is_published_has_the_error_of_the_pose_itself_on_top() -> None:
    covariance, poses = uneven_covariance(np.random.default_rng(2)), arc()
    meter = driven(poses, covariance, keyframes=True)
    last = result_at(STEPS, poses[-1], covariance)
    np.testing.assert_allclose(
        meter.covariance(last), covariance + covariance_at(meter.drift, poses[-1])
    )


def test_frames_between_keyframes_do_not_add_up() -> None:
    meter = driven(arc(), uneven_covariance(np.random.default_rng(1)))
    assert not meter.drift[:, :6].any()


def expected_drift(poses, error):
    """Return the twist (6,) before the last pose of the base that a change of the camera's motions
    makes: error(T) is the motion T of a camera as it is seen.
    """
    seen = [poses[0] @ T_BASE_LEFT]
    for before, now in pairwise(poses):
        motion = invert(before @ T_BASE_LEFT) @ now @ T_BASE_LEFT
        seen.append(seen[-1] @ error(motion))
    return se3_logs((seen[-1] @ invert(poses[-1] @ T_BASE_LEFT))[None])[0]


@pytest.mark.parametrize('axis', [0, 1])
def test_an_optical_axis_that_is_off_turns_the_path(axis) -> None:
    off = np.eye(4)
    off[:3, :3] = rotations_by(AXIS_SIGMA_PX / CAMERA.fx * np.eye(3)[axis][None])[0]
    seen = expected_drift(arc(), lambda T: off @ T @ invert(off))
    np.testing.assert_allclose(driven(arc()).drift[:, 6 + axis], seen, rtol=0.05, atol=5e-5)
    assert np.abs(seen).max() > 1e-3


def test_a_scale_that_is_off_stretches_the_path() -> None:
    def stretched(T):
        T = T.copy()
        T[:3, 3] *= 1 + np.sqrt(2) * SCALE_SIGMA
        return T

    seen = expected_drift(arc(), stretched)
    np.testing.assert_allclose(driven(arc()).drift[:, 8], seen, rtol=0.02, atol=2e-5)


def test_turns_that_are_off_bend_the_path() -> None:
    def bent(T):
        motion = se3_logs(T[None])[0]
        motion[3:] *= 1 + SCALE_SIGMA
        return se3_exp(motion)

    seen = expected_drift(arc(), bent)
    np.testing.assert_allclose(driven(arc()).drift[:, 9], seen, rtol=0.05, atol=5e-5)


def test_a_way_back_takes_errors_of_the_calibration_back() -> None:
    way = arc()
    assert np.abs(driven(way).drift).max() > 1e-3
    np.testing.assert_allclose(driven(way + way[-2::-1]).drift, 0.0, atol=1e-9)


def test_a_stretch_without_images_stays_in_odom_when_it_is_over() -> None:
    meter, T = driven(arc()), arc()[-1]
    before, of_stretch = meter.drift, uneven_covariance(np.random.default_rng(3), 20.0)
    meter.see(result_at(STEPS + 1, T, of_stretch, blind=True), None)
    # While it lasts, it is part of the covariance of the pose.
    np.testing.assert_allclose(meter.drift, before, atol=1e-12)
    meter.see(result_at(STEPS + 2, T), None)
    grown = covariance_at(meter.drift, T) - covariance_at(before, T)
    np.testing.assert_allclose(grown, of_stretch, atol=1e-12)


def test_results_that_come_once_more_change_nothing() -> None:
    covariance, poses = uneven_covariance(np.random.default_rng(4)), arc()
    meter = driven(poses, covariance, keyframes=True)
    before = meter.drift
    for k, T in enumerate(poses):
        meter.see(result_at(k, T, covariance), blind_keyframe(T))
    np.testing.assert_array_equal(meter.drift, before)


def test_a_keyframe_that_comes_after_its_pose_counts_once() -> None:
    """As a node has it: the pose goes out before the map has taken in the keyframe."""
    poses, covariance = arc(), uneven_covariance(np.random.default_rng(1))
    at_once, after = driven(poses, covariance, keyframes=True), driven(poses[:1], covariance)
    for k, T in enumerate(poses[1:], 1):
        after.see(result_at(k, T, covariance), None)
        for _ in range(2):
            after.see(result_at(k, T, covariance), blind_keyframe(T))
    np.testing.assert_allclose(after.drift, at_once.drift, rtol=1e-9, atol=1e-15)


def moved_by_pixels(points, points_seen, moved):
    """Return the motion (4, 4) of a camera that takes points (N, 3) for points_seen (N, 3)."""
    uv_px = CAMERA.project(transform_points(invert(moved), points))[:, :2].copy()
    K = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]])
    start = [part.reshape(3, 1) for part in np.split(se3_logs(invert(moved)[None])[0], 2)]
    _, turn, way = cv2.solvePnP(points_seen, uv_px, K, None, start[1], start[0], True)
    return invert(np.vstack([np.column_stack([cv2.Rodrigues(turn)[0], way]), [0, 0, 0, 1]]))


@pytest.mark.parametrize('farthest_m', [2.0, 20.0])
def test_errors_of_all_disparities_bend_the_path_as_poses_by_such_points_do(farthest_m) -> None:
    """Uneven ones that have errors in common, on a pitched mount, in a turn."""
    rng = np.random.default_rng(3)
    T_map_left = se3_exp(np.array([1.0, -0.5, 0.1, 0.2, -0.1, 0.7])) @ T_BASE_LEFT
    moved = se3_exp(np.array([0.002, -0.0005, 0.006, 0.0, 0.001, 0.0]))
    # Most on one side, and far ones at the top: no two numbers do the same.
    uv_px = np.array([640, 480]) * rng.beta((1.0, 1.5), (2.0, 1.0), (300, 2))
    depth_m = rng.uniform(1.0, farthest_m, 300) * (1.5 - uv_px[:, 1] / 480)
    true, fb = CAMERA.back_project(uv_px, depth_m), CAMERA.disparity_times_depth
    parts = np.column_stack([np.ones(300), (uv_px - (CAMERA.cx, CAMERA.cy)) / 320])
    effects = []
    for part in 0.05 * parts.T:
        more, less = (
            moved_by_pixels(true, CAMERA.back_project(uv_px, fb / (fb / depth_m + off)), moved)
            for off in (part, -part)
        )
        error = T_map_left @ more @ invert(T_map_left @ less)
        effects.append(se3_logs(error[None])[0] / 0.1)
    mixed = np.array([[0.1, 0.0, 0.0], [-0.04, 0.08, 0.0], [0.05, 0.02, 0.03]])
    meter = DriftMeter(CAMERA)
    meter.T_base_left = T_BASE_LEFT
    T_map_base, now = (T @ invert(T_BASE_LEFT) for T in (T_map_left, T_map_left @ moved))
    seen = keyframe_at(T_map_base, transform_points(T_map_left, true), uv_px, mixed @ mixed.T)
    meter.see(result_at(0, T_map_base), seen)
    meter.see(result_at(1, now), None)
    claimed = meter.drift[:, 10:] @ meter.drift[:, 10:].T
    expected = np.transpose(effects) @ mixed @ mixed.T @ effects
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        claimed / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.05
    )
    blind = DriftMeter(CAMERA)
    blind.see(result_at(0, T_map_base), blind_keyframe(T_map_base))
    blind.see(result_at(1, now), None)
    assert not blind.drift[:, 10:].any()
