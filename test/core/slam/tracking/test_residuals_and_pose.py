"""The measurement model against numeric differentiation; pose refinement against known poses."""

import numpy as np
import pytest

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.geometry import invert, transform_points
from segfloor_ros.core.slam.rig import (
    Observations,
    huber_cost,
    huber_weights,
    residuals,
    weighted_jacobian,
    with_moment,
)
from segfloor_ros.core.slam.tracking.pose import refine_pose, solve_pnp
from segfloor_ros.core.twists import se3_exp, se3_log

CAMERA = StereoCamera(640, 480, 320.0, 310.0, 319.5, 239.5, 0.12)


def cloud(count, seed=0):
    rng = np.random.default_rng(seed)
    z = rng.uniform(1.0, 8.0, count)
    return np.stack([rng.uniform(-0.8, 0.8, count) * z, rng.uniform(-0.6, 0.6, count) * z, z], 1)


def measure(points_camera, sigma=0.0, seed=0):
    uvr = CAMERA.project(points_camera)
    uvd = np.stack([uvr[:, 0], uvr[:, 1], uvr[:, 0] - uvr[:, 2]], axis=1)
    noise = np.random.default_rng(seed).normal(size=uvd.shape) * sigma
    return Observations(uvd + noise, np.full(uvd.shape, max(sigma, 0.1)))


def test_residuals_vanish_at_the_truth_and_ignore_missing_disparities():
    points = cloud(5)
    seen = measure(points)
    seen.uvd_px[2, 2] = np.nan
    np.testing.assert_allclose(residuals(CAMERA, points, seen), 0, atol=1e-9)
    assert seen.information[2, 2] == 0
    assert seen.chi2_limit[2] == pytest.approx(5.991, abs=1e-3)
    assert seen.chi2_limit[0] == pytest.approx(7.815, abs=1e-3)


def test_jacobians_equal_numeric_differentiation():
    points = cloud(6)
    seen = measure(points)
    root = np.random.default_rng(3).uniform(0.5, 2.0, (3, len(points)))
    by_point = weighted_jacobian(CAMERA, points, root)
    by_twist = with_moment(points.T, by_point)
    for k, step in enumerate(1e-6 * np.eye(3)):
        slope = (
            residuals(CAMERA, points + step, seen) - residuals(CAMERA, points - step, seen)
        ) / 2e-6
        np.testing.assert_allclose(by_point[k], root * slope.T, rtol=1e-5, atol=1e-5)
    for k, step in enumerate(1e-6 * np.eye(6)):
        ahead = transform_points(se3_exp(step), points)
        behind = transform_points(se3_exp(-step), points)
        slope = (residuals(CAMERA, ahead, seen) - residuals(CAMERA, behind, seen)) / 2e-6
        np.testing.assert_allclose(by_twist[k], root * slope.T, rtol=1e-5, atol=1e-4)


def test_huber_is_quadratic_inside_and_linear_outside():
    limit = np.array([4.0])
    assert huber_cost(np.array([1.0]), limit) == pytest.approx(1.0)
    assert huber_cost(np.array([16.0]), limit) == pytest.approx(2 * 2 * 4 - 4)
    np.testing.assert_allclose(huber_weights(np.array([1.0, 16.0]), np.array([4.0, 4.0])), [1, 0.5])


def test_refinement_finds_the_pose_in_spite_of_outliers():
    points_world = cloud(200)
    truth = se3_exp(np.array([0.1, -0.05, 0.3, 0.02, 0.1, -0.03]))
    seen = measure(transform_points(truth, points_world), sigma=0.3)
    seen.uvd_px[:40] += np.random.default_rng(5).uniform(10, 60, (40, 3))
    start = se3_exp(np.array([0.05, 0.02, -0.05, 0.01, -0.02, 0.01])) @ truth
    estimate = refine_pose(CAMERA, start, points_world, seen)
    error = se3_log(estimate.T_camera_world @ invert(truth))
    assert np.linalg.norm(error[:3]) < 0.004
    assert np.linalg.norm(error[3:]) < 0.001
    assert not estimate.inliers[:40].any()
    assert estimate.inliers[40:].mean() > 0.9


def test_covariance_predicts_the_spread_of_estimates():
    points_world = cloud(120)
    truth = se3_exp(np.array([0.1, -0.05, 0.3, 0.02, 0.1, -0.03]))
    errors, predicted = [], []
    for seed in range(60):
        seen = measure(transform_points(truth, points_world), sigma=0.4, seed=seed)
        estimate = refine_pose(CAMERA, truth, points_world, seen)
        errors.append(se3_log(estimate.T_camera_world @ invert(truth)))
        predicted.append(np.sqrt(np.diag(estimate.covariance)))
    ratio = np.std(errors, axis=0) / np.mean(predicted, axis=0)
    assert (ratio > 0.6).all() and (ratio < 1.5).all()


def test_noise_factor_shows_that_errors_are_larger_than_announced():
    points_world = cloud(300)
    seen = measure(points_world, sigma=0.3)
    optimistic = Observations(seen.uvd_px, np.full(seen.uvd_px.shape, 0.1))
    estimate = refine_pose(CAMERA, np.eye(4), points_world, optimistic)
    assert estimate.noise_factor == pytest.approx(3.0, rel=0.25)
    assert estimate.inliers.mean() > 0.85


def test_pnp_in_ransac_needs_no_start_and_survives_half_outliers():
    points_world = cloud(100)
    truth = se3_exp(np.array([0.4, -0.1, 0.8, 0.1, 0.5, -0.2]))
    uv = CAMERA.project(transform_points(truth, points_world))[:, :2]
    uv[:50] = np.random.default_rng(2).uniform(0, 480, (50, 2))
    found = solve_pnp(CAMERA, points_world, uv)
    assert found is not None
    pose, inliers = found
    assert np.linalg.norm(se3_log(pose @ invert(truth))) < 0.01
    assert inliers[50:].all()
    again = solve_pnp(CAMERA, points_world, uv)
    np.testing.assert_array_equal(again[0], pose)


def test_pnp_refuses_too_few_points():
    assert solve_pnp(CAMERA, np.zeros((5, 3)), np.zeros((5, 2))) is None
