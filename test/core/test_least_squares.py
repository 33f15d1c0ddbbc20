"""Levenberg-Marquardt and Gauss-Newton: small problems, and bundle adjustment and pose compared
with other solvers (SciPy, and gtsam where that is installed).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from bundle_problems import CAMERA, disturbed, make_problem
from scipy.optimize import least_squares

from segfloor_ros.core.gauss_newton import gauss_newton
from segfloor_ros.core.geometry import invert, transform_points
from segfloor_ros.core.least_squares import SHRINK, minimise
from segfloor_ros.core.slam.mapping.bundle_adjustment import adjust
from segfloor_ros.core.slam.mapping.normal_equations import Links
from segfloor_ros.core.slam.rig import residuals
from segfloor_ros.core.slam.tracking.pose import refine_pose
from segfloor_ros.core.twists import se3_exp, se3_log


class Rosenbrock:
    """Rosenbrock's valley (1960) as a sum of two squares; its least is 0 at (1, 1)."""

    dampings: list[float]

    def __init__(self, x: np.ndarray, dampings: list[float] | None = None) -> None:
        self.x, self.dampings = x, [] if dampings is None else dampings
        self.residual = np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])
        self.cost = float(self.residual @ self.residual)

    def linearised(self) -> Callable[[float], tuple[Rosenbrock, float]]:
        J = np.array([[-20 * self.x[0], 10.0], [-1.0, 0.0]])
        H, g = J.T @ J, J.T @ self.residual

        def stepped(damping: float) -> tuple[Rosenbrock, float]:
            self.dampings.append(damping)
            step = np.linalg.solve(H + damping * np.diag(np.diag(H)), -g)
            return Rosenbrock(self.x + step, self.dampings), SHRINK

        return stepped


def test_the_least_of_a_valley_is_found_and_damping_follows_success() -> None:
    start = Rosenbrock(np.array([-1.2, 1.0]))
    end = minimise(start, 200, 1e-9)
    np.testing.assert_allclose(end.x, 1.0, atol=1e-6)
    factors = np.divide(start.dampings[1:], start.dampings[:-1])
    assert {round(float(factor), 3) for factor in factors} == {0.2, 10.0}


def test_no_step_raises_the_cost() -> None:
    costs = [minimise(Rosenbrock(np.array([-1.2, 1.0])), steps, 0.0).cost for steps in range(12)]
    assert costs == sorted(costs, reverse=True)


def test_what_is_no_longer_wanted_ends() -> None:
    start = Rosenbrock(np.array([-1.2, 1.0]))
    assert minimise(start, 10, 0.0, is_wanted=lambda: False) is start


def test_a_step_to_where_the_cost_is_no_number_is_not_taken() -> None:
    class Hole(Rosenbrock):
        def linearised(self) -> Callable[[float], tuple[Rosenbrock, float]]:
            return lambda damping: (Rosenbrock(np.full(2, np.nan)), SHRINK)

    start = Hole(np.array([-1.2, 1.0]))
    assert minimise(start, 3, 1e-3) is start


def test_derivatives_of_a_measured_motion_are_those_of_differences() -> None:
    rng = np.random.default_rng(0)
    poses = se3_exp(0.3 * rng.normal(size=(2, 6)))
    moved = poses[1] @ invert(poses[0])
    links = Links(np.array([[0, 1]]), moved[None], np.eye(6)[None])
    for which in range(2):
        for k, step in enumerate(1e-6 * np.eye(6)):
            ahead, behind = poses.copy(), poses.copy()
            ahead[which], behind[which] = (
                se3_exp(step) @ poses[which],
                se3_exp(-step) @ poses[which],
            )
            slope = (links.errors(ahead) - links.errors(behind))[0] / 2e-6
            np.testing.assert_allclose(
                links.jacobians(poses)[0, which, :, k], slope, rtol=1e-6, atol=1e-6
            )


def by_scipy(problem, are_points_free):
    """Return poses and points of a bundle adjustment without outliers, by SciPy."""
    free = problem.num_free

    def unpacked(x):
        poses, points = problem.T_camera_world.copy(), problem.points_world
        poses[:free] = se3_exp(x[: 6 * free].reshape(-1, 6)) @ poses[:free]
        return poses, points + x[6 * free :].reshape(-1, 3) if are_points_free else points

    def errors(x):
        poses, points = unpacked(x)
        seen = np.concatenate(
            [
                residuals(CAMERA, transform_points(T, points), problem.observations.take(mine))
                for T, mine in zip(poses, views, strict=True)
            ]
        )
        return (seen / problem.observations.sigma_px).ravel()

    count = len(problem.points_world)
    views = [np.arange(k * count, (k + 1) * count) for k in range(len(problem.T_camera_world))]
    unknowns = 6 * free + (3 * count if are_points_free else 0)
    return unpacked(least_squares(errors, np.zeros(unknowns), xtol=1e-12, ftol=1e-12).x)


def by_gtsam(problem, are_points_free):
    """Return poses and points of a bundle adjustment without outliers, by gtsam."""
    gtsam = pytest.importorskip('gtsam')
    camera, seen = CAMERA, problem.observations
    K = gtsam.Cal3_S2Stereo(camera.fx, camera.fy, 0.0, camera.cx, camera.cy, camera.baseline_m)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    pose, point = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.L
    for k, T in enumerate(problem.T_camera_world):
        values.insert(pose(k), gtsam.Pose3(invert(T)))
        if k >= problem.num_free:
            graph.add(gtsam.NonlinearEqualityPose3(pose(k), gtsam.Pose3(invert(T))))
    for p, xyz in enumerate(problem.points_world):
        values.insert(point(p), xyz)
        if not are_points_free:
            graph.add(gtsam.NonlinearEqualityPoint3(point(p), xyz))
    for k, p, (u, v, d), sigma in zip(
        problem.keyframe, problem.point, seen.uvd_px, seen.sigma_px, strict=True
    ):
        # (u, v, d) with independent errors; gtsam measures (u, u - d, v).
        A = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
        noise = gtsam.noiseModel.Gaussian.Covariance(A @ np.diag(sigma**2) @ A.T)
        graph.add(
            gtsam.GenericStereoFactor3D(
                gtsam.StereoPoint2(u, u - d, v), noise, pose(int(k)), point(int(p)), K
            )
        )
    settings = gtsam.LevenbergMarquardtParams()
    settings.setRelativeErrorTol(1e-14)
    found = gtsam.LevenbergMarquardtOptimizer(graph, values, settings).optimize()
    poses = [invert(found.atPose3(pose(k)).matrix()) for k in range(len(problem.T_camera_world))]
    points = [found.atPoint3(point(p)) for p in range(len(problem.points_world))]
    return np.stack(poses), np.stack(points)


ORACLES = pytest.mark.parametrize('oracle', [by_scipy, by_gtsam])


@ORACLES
def test_a_bundle_adjustment_is_that_of_another_solver(oracle) -> None:
    problem = disturbed(make_problem(num_keyframes=4, num_points=25, num_free=2, sigma=0.1))
    # Nothing is an outlier: the cost is that of plain least squares.
    seen = replace(problem.observations, sigma_px=np.full_like(problem.observations.sigma_px, 0.2))
    problem = replace(problem, observations=seen)
    ours = problem
    for _ in range(6):  # from where the last one ended: each ends when it gains little
        result = adjust(CAMERA, ours, iterations=15)
        ours = replace(ours, T_camera_world=result.T_camera_world, points_world=result.points_world)
    poses, points = oracle(problem, are_points_free=True)
    off = [se3_log(a @ invert(b)) for a, b in zip(ours.T_camera_world, poses, strict=True)]
    assert np.abs(off).max() < 2e-5  # metres and radians
    np.testing.assert_allclose(ours.points_world, points, atol=1e-3)


@ORACLES
def test_a_pose_is_that_of_another_solver(oracle) -> None:
    truth = make_problem(num_keyframes=1, num_points=60, num_free=1, sigma=0.1)
    seen = replace(truth.observations, sigma_px=np.full_like(truth.observations.sigma_px, 0.2))
    start = se3_exp(np.array([0.03, -0.02, 0.04, 0.01, -0.02, 0.01]))
    found = refine_pose(CAMERA, start, truth.points_world, seen)
    assert found.inliers.all()
    problem = replace(truth, T_camera_world=start[None], observations=seen)
    poses, _ = oracle(problem, are_points_free=False)
    assert np.abs(se3_log(found.T_camera_world @ invert(poses[0]))).max() < 1e-5


def curve(count=60, seed=0):
    """Return times and values of an exponential fall with noise and outliers."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 3.0, count)
    y = 2.0 * np.exp(-0.7 * t) + 0.02 * rng.normal(size=count)
    y[::9] += 1.0
    return t, y


def test_a_robust_fit_by_a_schedule_is_that_of_another_solver() -> None:
    t, y = curve()
    scale = 0.05

    def linearise(x: np.ndarray, stage_scale: float) -> tuple[np.ndarray, np.ndarray, float]:
        J = np.stack([np.exp(-x[1] * t), -x[0] * t * np.exp(-x[1] * t)], axis=1)
        error = y - x[0] * np.exp(-x[1] * t)
        weighted = J.T / (1 + (error / stage_scale) ** 2)
        return weighted @ J, weighted @ error, stage_scale

    found, information, last = gauss_newton(
        np.array([1.5, 0.5]), linearise, (1.0, 0.3, *[scale] * 20), np.add
    )
    expected = least_squares(
        lambda x: y - x[0] * np.exp(-x[1] * t), (2.0, 0.7), loss='cauchy', f_scale=scale, xtol=1e-12
    )
    np.testing.assert_allclose(found, expected.x, atol=1e-5)
    np.testing.assert_allclose(found, (2.0, 0.7), atol=0.02)
    assert information.shape == (2, 2)
    assert last == scale


def test_unknowns_that_are_not_free_or_not_determined_stay() -> None:
    def linearise(x: np.ndarray, _: int) -> tuple[np.ndarray, np.ndarray, None]:
        J = np.array([[1.0, 1.0, 0.0]])
        return J.T @ J, J.T @ (6.0 - J @ x), None

    free = np.array([True, False, True])
    found, *_ = gauss_newton(np.zeros(3), linearise, range(2), np.add, free)
    np.testing.assert_allclose(found, (6.0, 0.0, 0.0), atol=1e-6)
