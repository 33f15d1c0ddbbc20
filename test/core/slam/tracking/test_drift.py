"""How far odometry says that it has gone astray, compared with sampled paths, on a turn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sampled_poses import assert_spread, drawn_errors, uneven_covariance
from stereo_room import MOUNT

from segfloor_ros.core.contracts import FrameResult
from segfloor_ros.core.geometry import invert
from segfloor_ros.core.slam.held_results import in_map
from segfloor_ros.core.slam.optional import NoSensors
from segfloor_ros.core.slam.tracking.drift import (
    AXIS_SIGMA_PX,
    SCALE_SIGMA,
    DriftMeter,
    covariance_at,
    covariance_in_odom,
)
from segfloor_ros.core.slam.tracking.motion import CameraMotion, TrackingState
from segfloor_ros.core.twists import rotations_by, se3_exp, se3_logs

STEP = se3_exp(np.array([0.05, -0.02, 0.3, 0.02, 0.12, -0.03]))
"""A camera that drives and turns by 0.12 rad; of T_before_now."""

STEPS, FOCAL_PX, STEP_NS = 12, 320.0, 100_000_000
EXACT = 1e-12 * np.eye(6)


def driven(steps, covariance=EXACT, keyframes=True):
    """Return a camera and the drift of its odometry after poses (N, 4, 4) in the world."""
    motion, meter = CameraMotion(40.0, NoSensors()), DriftMeter(FOCAL_PX)
    for k, T_world_camera in enumerate(steps):
        motion.take(invert(T_world_camera), covariance, k * STEP_NS)
        meter.see(motion, keyframes and k > 0)
    return motion, meter


def arc():
    """Return poses (N, 4, 4) on a turn."""
    poses = [np.eye(4)]
    for _ in range(STEPS):
        poses.append(poses[-1] @ STEP)
    return poses


def place_and_turn(samples, T):
    """Return by how much poses (N, 4, 4) differ from T (4, 4) in place and turn, (N, 6), in the
    axes of the frame.
    """
    turns = np.tile(np.eye(4), (len(samples), 1, 1))
    turns[:, :3, :3] = samples[:, :3, :3] @ T[:3, :3].T
    return np.concatenate([samples[:, :3, 3] - T[:3, 3], se3_logs(turns)[:, 3:]], axis=1)


def test_each_keyframe_adds_the_error_of_its_pose_and_of_the_points_before_it() -> None:
    rng = np.random.default_rng(1)
    covariance = uneven_covariance(rng)
    motion, meter = driven(arc(), covariance)
    drift = meter.drift.copy()
    drift[:, 6:] = 0.0
    samples = np.tile(np.eye(4), (6000, 1, 1))
    for _ in range(STEPS):
        # The covariance is that of a twist before T_camera_world, whose inverse errs behind.
        of_points, of_pose = (se3_exp(-drawn_errors(rng, covariance)) for _ in range(2))
        samples = samples @ STEP @ of_points @ of_pose
    T = motion.T_odom_camera
    assert_spread(place_and_turn(samples, T), covariance_at(drift, T))


def test_frames_between_keyframes_do_not_add_up() -> None:
    _, meter = driven(arc(), uneven_covariance(np.random.default_rng(1)), keyframes=False)
    assert not meter.drift[:, :6].any()


@pytest.mark.parametrize(('column', 'axis'), [(0, 0), (1, 1)])
def test_an_optical_axis_that_is_off_turns_the_path(column, axis) -> None:
    motion, meter = driven(arc(), keyframes=False)
    off = np.eye(4)
    off[:3, :3] = rotations_by(AXIS_SIGMA_PX / FOCAL_PX * np.eye(3)[axis][None])[0]
    T = motion.T_odom_camera
    seen = se3_logs((off @ T @ invert(off) @ invert(T))[None])[0]
    np.testing.assert_allclose(meter.drift[:, 6 + column], seen, rtol=0.05, atol=2e-5)
    assert np.abs(seen).max() > 1e-3


def test_a_scale_that_is_off_stretches_the_path() -> None:
    motion, meter = driven(arc(), keyframes=False)
    T = motion.T_odom_camera
    stretched = T.copy()
    stretched[:3, 3] *= 1 + np.sqrt(2) * SCALE_SIGMA
    seen = se3_logs((stretched @ invert(T))[None])[0]
    np.testing.assert_allclose(meter.drift[:, 8], seen, rtol=0.02, atol=1e-5)


def test_a_way_back_takes_errors_of_the_calibration_back() -> None:
    way = arc()
    _, there = driven(way, keyframes=False)
    _, back = driven(way + way[-2::-1], keyframes=False)
    assert np.abs(there.drift).max() > 1e-3
    np.testing.assert_allclose(back.drift, 0.0, atol=1e-9)


def test_a_stretch_without_images_stays_in_odom_when_it_is_over() -> None:
    motion, meter = driven(arc(), keyframes=False)
    before, of_stretch = meter.drift, uneven_covariance(np.random.default_rng(3), 20.0)
    motion.state, motion.covariance = TrackingState.ON_WHEELS, of_stretch
    meter.see(motion, is_keyframe=False)
    # While it lasts, it is part of the covariance of the pose.
    np.testing.assert_allclose(meter.drift, before, atol=1e-12)
    motion.state, motion.covariance = TrackingState.TRACKING, EXACT
    meter.see(motion, is_keyframe=False)
    T = motion.T_odom_camera
    grown = covariance_at(meter.drift, T) - covariance_at(before, T)
    axes = np.kron(np.eye(2), T[:3, :3])
    np.testing.assert_allclose(grown, axes @ of_stretch @ axes.T, atol=1e-12)


def test_the_drift_of_the_base_is_that_of_its_camera() -> None:
    rng = np.random.default_rng(4)
    covariance = uneven_covariance(rng)
    motion, meter = driven(arc(), covariance)
    T = motion.T_odom_camera
    result = FrameResult(0, 0, True, T, np.eye(4), EXACT, 50, 'tracking', 0)
    of_base = in_map(replace(result, drift=meter.drift), MOUNT.T_base_left)
    errors = drawn_errors(rng, meter.drift[:, :6] + meter.drift[:, 6:] @ meter.drift[:, 6:].T)
    T_base_left = MOUNT.T_base_left
    samples = T_base_left @ se3_exp(errors) @ T @ invert(T_base_left)
    expected = covariance_in_odom(of_base)
    assert_spread(place_and_turn(samples, of_base.T_odom_base), expected)
