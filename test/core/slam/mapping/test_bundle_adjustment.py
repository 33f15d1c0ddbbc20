"""Bundle adjustment on synthetic problems with known answers."""

from dataclasses import replace

import numpy as np
from bundle_problems import CAMERA, disturbed, make_problem

from segfloor_ros.core.contracts import RelativeMotion
from segfloor_ros.core.geometry import transform_points
from segfloor_ros.core.slam.mapping.bundle_adjustment import BundleProblem, adjust
from segfloor_ros.core.slam.mapping.normal_equations import (
    Linearisation,
    Links,
    inverse_cholesky,
    normal_equations,
    with_factors,
)
from segfloor_ros.core.slam.rig import DisparityOffset, Observations, OffsetEstimate, residuals
from segfloor_ros.core.twists import se3_exp


def test_returns_to_the_truth_from_a_disturbed_start():
    truth = make_problem()
    result = adjust(CAMERA, disturbed(truth), iterations=15)
    np.testing.assert_allclose(result.T_camera_world, truth.T_camera_world, atol=1e-4)
    np.testing.assert_allclose(result.points_world, truth.points_world, atol=2e-3)
    assert result.cost_after < 1e-3 * result.cost_before
    assert result.inliers.all()


def test_fixed_keyframes_do_not_move():
    truth = make_problem(sigma=0.3)
    result = adjust(CAMERA, disturbed(truth), iterations=5)
    np.testing.assert_array_equal(result.T_camera_world[3:], truth.T_camera_world[3:])


def test_a_far_point_whose_step_leads_through_the_cameras_keeps_no_other_from_moving():
    truth = make_problem()
    start = disturbed(truth)
    start.points_world[0] *= 77.0 / start.points_world[0, 2]
    result = adjust(CAMERA, start, iterations=2)
    before, after = (
        np.linalg.norm(problem.T_camera_world[:3, :3, 3] - truth.T_camera_world[:3, :3, 3], axis=1)
        for problem in (start, result)
    )
    assert (after < 0.1 * before).all()
    np.testing.assert_array_equal(result.points_world[0], start.points_world[0])
    others = np.linalg.norm(result.points_world[1:] - truth.points_world[1:], axis=1)
    assert np.median(others) < 0.01


def test_noise_is_averaged_and_outliers_are_named():
    truth = make_problem(sigma=0.3)
    spoiled = truth.observations.uvd_px.copy()
    bad = np.arange(0, len(spoiled), 37)
    spoiled[bad, 0] += 25.0
    problem = BundleProblem(
        truth.T_camera_world,
        truth.num_free,
        truth.points_world,
        truth.keyframe,
        truth.point,
        Observations(spoiled, truth.observations.sigma_px),
    )
    result = adjust(CAMERA, disturbed(problem), iterations=20)
    assert not result.inliers[bad].any()
    good = np.setdiff1d(np.arange(len(spoiled)), bad)
    assert result.inliers[good].mean() > 0.9
    errors = np.linalg.norm(
        result.T_camera_world[:3, :3, 3] - truth.T_camera_world[:3, :3, 3], axis=1
    )
    assert errors.max() < 0.01


def test_a_step_equals_the_solution_of_the_full_normal_equations():
    # The Schur complement is an exact elimination: compare with a dense solve by numeric Jacobians.
    problem = disturbed(make_problem(num_keyframes=2, num_points=6, num_free=1))
    damping = 1e-4

    def residual(parameters):
        pose = se3_exp(parameters[:6]) @ problem.T_camera_world[0]
        points = problem.points_world + parameters[6:].reshape(-1, 3)
        predicted = []
        for T in (pose, problem.T_camera_world[1]):
            uvr = CAMERA.project(transform_points(T, points))
            predicted.append(np.stack([uvr[:, 0], uvr[:, 1], uvr[:, 0] - uvr[:, 2]], axis=1))
        errors = np.concatenate(predicted) - problem.observations.uvd_px
        return errors.ravel() / 0.1

    size = 6 + 18
    J = np.stack(
        [(residual(step) - residual(-step)) / 2e-6 for step in 1e-6 * np.eye(size)], axis=1
    )
    r = residual(np.zeros(size))
    chi2 = (r.reshape(-1, 3) ** 2).sum(axis=1)
    weight = np.repeat(np.sqrt(np.minimum(1, 7.815 / chi2)), 3)
    H = J.T @ (J * weight[:, None])
    step = np.linalg.solve(H + damping * np.diag(np.diag(H)), -J.T @ (weight * r))
    result = adjust(CAMERA, problem, iterations=1)
    if result.cost_after < result.cost_before:
        np.testing.assert_allclose(
            result.points_world - problem.points_world,
            step[6:].reshape(-1, 3),
            rtol=1e-3,
            atol=1e-6,
        )
        np.testing.assert_allclose(
            result.T_camera_world[0], se3_exp(step[:6]) @ problem.T_camera_world[0], atol=1e-6
        )
    else:
        raise AssertionError('the first step must lower the cost')


def solved_at_once(system, damping):
    """Return the solution for cameras and points, and the offset of all disparities where that is
    unknown, too, with its information.
    """
    cameras, points = len(system.U), system.V.shape[2]
    size = 6 * cameras + 3 * points + 3
    H = np.zeros((size, size))
    for k, U in enumerate(system.U):
        H[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = U
        for m in range(system.starts[k], system.starts[k + 1]):
            column = 6 * cameras + 3 * system.point[m]
            H[6 * k : 6 * k + 6, column : column + 3] = system.W[:, :, m]
    for p in range(points):
        at = 6 * cameras + 3 * p
        H[at : at + 3, at : at + 3] = system.V[:, :, p]
    for j, k, block in system.between:
        H[6 * min(j, k) : 6 * min(j, k) + 6, 6 * max(j, k) : 6 * max(j, k) + 6] += (
            block if j < k else block.T
        )
    H[: 6 * cameras, -3:] = system.shared_camera.reshape(-1, 3)
    H[6 * cameras : -3, -3:] = system.shared_point.transpose(2, 1, 0).reshape(-1, 3)
    H = np.triu(H) + np.triu(H, 1).T
    H[:-3, :-3] += np.diag(damping * np.diag(H)[:-3])
    H[-3:, -3:] = system.shared_shared
    rhs = [system.camera_rhs.ravel(), system.point_rhs.T.ravel(), system.shared_rhs]
    inverse, rhs = np.linalg.inv(H), np.concatenate(rhs)
    step = np.linalg.solve(H[:-3, :-3], rhs[:-3])
    return step, OffsetEstimate(inverse[-3:] @ rhs, np.linalg.inv(inverse[-3:, -3:]))


def test_a_solution_by_the_complement_is_that_of_all_unknowns_at_once():
    problem = disturbed(make_problem(num_keyframes=8, num_points=40, num_free=6, sigma=0.2))
    poses, free = problem.T_camera_world, problem.num_free
    points = np.concatenate([transform_points(T, problem.points_world) for T in poses])
    at = Linearisation(
        poses, free, len(problem.points_world), problem.keyframe, problem.point, points,
        residuals(CAMERA, points, problem.observations), problem.observations.information,
        DisparityOffset(CAMERA).parts_of(problem.observations.uvd_px).T,
    )  # fmt: skip
    untied = normal_equations(CAMERA, at)
    not_wanted = normal_equations(CAMERA, replace(at, offset_parts=at.offset_parts[:0]))
    motion = RelativeMotion(np.eye(4), 1e-3 * np.eye(6))
    links = Links.of([(1, 2, motion), (4, 3, motion), (5, 6, motion)])
    for system, without in (
        (untied, not_wanted),
        (with_factors(untied, poses, links), with_factors(not_wanted, poses, links)),
    ):
        step = system.solve(1e-3)
        expected, offset = solved_at_once(system, 1e-3)
        found = [step.twists.ravel(), step.shifts.ravel()]
        np.testing.assert_allclose(np.concatenate(found), expected, atol=1e-7)
        np.testing.assert_allclose(step.offset.value_px, offset.value_px, atol=1e-7)
        np.testing.assert_allclose(step.offset.information, offset.information, rtol=1e-6)
        alone = without.solve(1e-3)
        np.testing.assert_allclose(alone.twists, step.twists, atol=1e-9)
        np.testing.assert_allclose(alone.shifts, step.shifts, atol=1e-9)
        assert len(alone.offset.value_px) == 0


def test_the_inverse_factor_makes_the_inverse_also_where_a_direction_is_hardly_known():
    A = np.random.default_rng(4).normal(size=(50, 3, 3))
    A = np.swapaxes(A, 1, 2) @ A + 1e-3 * np.eye(3)
    A[0] = np.diag([1e4, 1e4, 1e-6])
    L_inverse = np.moveaxis(inverse_cholesky(np.moveaxis(A, 0, -1)), -1, 0)
    assert not np.triu(L_inverse, 1).any()
    np.testing.assert_allclose(
        np.swapaxes(L_inverse, 1, 2) @ L_inverse @ A, [np.eye(3)] * 50, atol=1e-9
    )
