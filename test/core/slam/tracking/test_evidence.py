"""What matches say for a pose, against chance."""

import math
from dataclasses import replace

import numpy as np
import pytest
from sampled_poses import twists_from
from stereo_room import CAMERA

from segfloor_ros.core.geometry import Array, transform_points
from segfloor_ros.core.slam.rig import Observations
from segfloor_ros.core.slam.tracking.evidence import (
    ENOUGH_EVIDENCE,
    LARGEST_FACTOR,
    Mixture,
    is_proof,
)
from segfloor_ros.core.slam.tracking.pose import (
    WHOLE,
    PoseEstimate,
    Searched,
    refine_pose,
    solve_pnp,
)
from segfloor_ros.core.twists import se3_exp

TRUTH = se3_exp(np.array([0.02, -0.01, 0.05, 0.004, 0.02, -0.006]))


def anywhere(rng: np.random.Generator, count: int) -> Array:
    """Return pixels and disparities (N, 3) that have to do with nothing."""
    uvd_px: Array = rng.uniform([0, 0, 3], [CAMERA.width, CAMERA.height, 13], (count, 3))
    return uvd_px


def points_and_pixels(rng: np.random.Generator, count: int, noise_px: float) -> tuple[Array, Array]:
    """Return points (N, 3), and (N, 3) where they are seen from TRUTH."""
    uvd = anywhere(rng, count)
    points = CAMERA.back_project(uvd[:, :2], CAMERA.disparity_times_depth / uvd[:, 2])
    uvr = CAMERA.project(transform_points(TRUTH, points))
    seen = np.column_stack([uvr[:, :2], uvr[:, 0] - uvr[:, 2]])
    return points, seen + rng.normal(0, noise_px, seen.shape)


def pose_of(points: Array, uvd_px: Array, searched: Searched = WHOLE) -> PoseEstimate:
    """Return the pose by points (N, 3), as RANSAC finds it first."""
    observations = Observations(uvd_px, np.ones_like(uvd_px))
    start = solve_pnp(CAMERA, points, uvd_px[:, :2])
    T_start, first = (np.eye(4), None) if start is None else start
    return refine_pose(CAMERA, T_start, points, observations, searched=searched, first=first)


@pytest.mark.slow
@pytest.mark.parametrize('has_disparity', [True, False])
def test_matches_that_have_to_do_with_nothing_prove_no_pose(has_disparity: bool) -> None:
    rng = np.random.default_rng(1)
    for _ in range(500):
        points, _ = points_and_pixels(rng, 60, 1.0)
        uvd_px = anywhere(rng, 60)
        if not has_disparity:
            uvd_px[:, 2] = np.nan
        assert not is_proof(pose_of(points, uvd_px).evidence())


def test_matches_around_a_prediction_prove_no_pose_by_chance() -> None:
    """One in twenty is found within 15 pixels of where its point should be, by chance."""
    rng, radius_px = np.random.default_rng(2), 15.0
    searched = Searched(math.pi * radius_px**2, 2 * radius_px, 0, 0.05)
    for _ in range(1000):
        points, seen = points_and_pixels(rng, 60, 0.0)
        off = rng.normal(size=(60, 2))
        off *= radius_px * np.sqrt(rng.uniform(size=(60, 1))) / np.linalg.norm(off, axis=1)[:, None]
        seen[:, :2] += off
        seen[:, 2] = np.nan
        observations = Observations(seen, np.ones_like(seen))
        found = refine_pose(
            CAMERA, TRUTH, points, observations, searched=replace(searched, missed=60 * 19)
        )
        assert not is_proof(found.evidence())


def test_a_pose_with_twelve_right_of_sixty_matches_is_proven() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        points, seen = points_and_pixels(rng, 60, 1.0)
        seen[12:] = anywhere(rng, 48)
        found = pose_of(points, seen)
        assert is_proof(found.evidence())
        assert found.inliers[:12].sum() >= 10 and found.inliers[12:].sum() <= 2
        off = twists_from(TRUTH, found.T_camera_world[None])[0]
        assert off @ np.linalg.solve(found.covariance, off) < 40


def test_what_was_looked_for_and_not_found_speaks_against_a_pose() -> None:
    rng = np.random.default_rng(4)
    points, seen = points_and_pixels(rng, 12, 1.0)
    found = [
        pose_of(points, seen, Searched(100.0, 4.0, missed, 0.1)).evidence()
        for missed in (0, 10, 100, 1000)
    ]
    assert np.diff(found).max() < -5.0
    assert is_proof(found[0]) and not is_proof(found[-1])


def test_a_pose_far_from_where_the_camera_was_expected_has_less_evidence() -> None:
    rng = np.random.default_rng(5)
    points, seen = points_and_pixels(rng, 12, 1.0)
    found = pose_of(points, seen)
    near, far = (
        PoseEstimate(se3_exp(np.full(6, off)) @ TRUTH, found.inliers, 1e-4 * np.eye(6), 1.0)
        for off in (0.0, 1.0)
    )
    assert found.evidence(near) > found.evidence() > found.evidence(far)


@pytest.mark.parametrize('factor', [1.0, 1.5, 3.0])
def test_the_factor_of_the_noise_and_the_share_of_right_ones_are_found(factor: float) -> None:
    rng, right, wrong = np.random.default_rng(6), 400, 200
    area = 300.0
    errors = np.vstack(
        [rng.normal(0, factor, (right, 2)), rng.uniform(-area / 2, area / 2, (wrong, 2))]
    )
    log_chance = np.full(right + wrong, math.log(area**2 / (2 * math.pi)))
    chi2, dimensions = (errors**2).sum(axis=1), np.full(right + wrong, 2.0)
    found = Mixture.fit(chi2, dimensions, log_chance, factor=1.0)
    assert found.factor == pytest.approx(factor, rel=0.1)
    assert found.share == pytest.approx(right / (right + wrong), abs=0.05)
    assert (found.probability[:right] > 0.5).mean() > 0.98
    assert (found.probability[right:] > 0.5).mean() < 0.05


def test_what_errs_by_more_than_any_image_does_is_something_else() -> None:
    chi2, dimensions = np.full(100, 60.0**2), np.full(100, 2.0)
    found = Mixture.fit(chi2, dimensions, np.full(100, 8.0), factor=60.0)
    assert found.factor <= LARGEST_FACTOR and found.share < 0.1
    assert found.log_ratio < ENOUGH_EVIDENCE


@pytest.mark.parametrize('noise_px', [1.0, pytest.param(2.0, marks=pytest.mark.slow)])
def test_poses_are_as_unsure_as_their_mixture_says(noise_px: float) -> None:
    """A third of the matches is wrong, and the noise may be twice what it is announced to be."""
    rng, errors = np.random.default_rng(7), []
    points, exact = points_and_pixels(rng, 90, 0.0)
    for _ in range(400):
        seen = exact + rng.normal(0, noise_px, exact.shape)
        seen[60:] = anywhere(rng, 30)
        found = pose_of(points, seen)
        off = twists_from(TRUTH, found.T_camera_world[None])[0]
        errors.append(np.linalg.solve(np.linalg.cholesky(found.covariance), off))
    squared = (np.stack(errors) ** 2).sum(axis=1)
    # Twenty measurements' worth of what is announced, and Huber's bound, make it 1.4 for the noise
    # that is twice as large.
    assert 0.8 < squared.mean() / 6 < (1.2 if noise_px == 1.0 else 1.5)
