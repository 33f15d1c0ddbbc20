"""A pose by few points and a prior, each sure along other axes than the other."""

import numpy as np
import pytest
from sampled_poses import drawn_poses, uneven_covariance
from stereo_room import CAMERA

from segfloor_ros.core.geometry import Array, invert, transform_points
from segfloor_ros.core.slam.rig import Observations
from segfloor_ros.core.slam.tracking.pose import PoseEstimate, differ, knows_more, refine_pose
from segfloor_ros.core.twists import se3_exp, se3_log

SOMEWHERE = se3_exp(np.array([0.7, -0.4, 1.5, 0.3, -0.9, 0.2]))


def estimate(T: Array, covariance: Array) -> PoseEstimate:
    return PoseEstimate(T, np.zeros(0, bool), covariance, 1.0)


def by_points(start: Array = SOMEWHERE, prior: PoseEstimate | None = None) -> PoseEstimate:
    """Return the pose by points to the right, each seen exactly where it is from SOMEWHERE."""
    rng = np.random.default_rng(1)
    uv_px = rng.uniform([200, 20], [300, 200], (30, 2))
    points = CAMERA.back_project(uv_px, rng.uniform(2.0, 5.0, 30))
    uvr = CAMERA.project(points)
    uvd_px = np.column_stack([uvr[:, :2], uvr[:, 0] - uvr[:, 2]])
    observations = Observations(uvd_px, np.full((30, 3), 0.5))
    in_world = transform_points(invert(SOMEWHERE), points)
    return refine_pose(CAMERA, start, in_world, observations, prior)


@pytest.mark.parametrize('start', ['prior', 'points'])
def test_points_and_prior_are_weighed_by_what_each_knows_of_every_direction(start) -> None:
    rng = np.random.default_rng(2)
    covariance = uneven_covariance(rng, scale=3.0)
    offset = 0.5 * np.linalg.cholesky(covariance) @ rng.normal(size=6)
    prior = estimate(se3_exp(offset) @ SOMEWHERE, covariance)
    fused = by_points(SOMEWHERE if start == 'points' else prior.T_camera_world, prior)
    known, seen = np.linalg.inv(covariance), np.linalg.inv(by_points().covariance)
    # Neither outweighs the other along all axes.
    shares = np.linalg.eigvals(np.linalg.solve(known + seen, known)).real
    assert shares.min() < 0.2 and shares.max() > 0.8
    expected = np.linalg.solve(known + seen, known @ offset)
    found = se3_log(fused.T_camera_world @ invert(SOMEWHERE))
    sigma = np.sqrt(np.diag(fused.covariance))
    np.testing.assert_allclose(found / sigma, expected / sigma, atol=0.03)
    scale = np.outer(sigma, sigma)
    both = np.linalg.inv(known + seen)
    np.testing.assert_allclose(fused.covariance / scale, both / scale, atol=0.03)


def test_sensors_know_more_where_they_are_surer_along_one_direction() -> None:
    seen = by_points().covariance
    values, axes = np.linalg.eigh(seen)
    for factor, is_better in (
        (np.full(6, 4.0), False),
        (np.full(6, 0.25), True),
        (np.array([4.0, 4.0, 4.0, 0.25, 4.0, 4.0]), True),
    ):
        assert knows_more((axes * values * factor) @ axes.T, by_points()) == is_better


def test_poses_differ_that_are_farther_apart_than_both_are_unsure() -> None:
    rng = np.random.default_rng(3)
    one, other = uneven_covariance(rng, 3.0), uneven_covariance(rng, 2.0)
    pairs = zip(
        drawn_poses(rng, SOMEWHERE, one, 500), drawn_poses(rng, SOMEWHERE, other, 500), strict=True
    )
    near, far = [], []
    for a, b in pairs:
        near.append(differ(estimate(a, one), estimate(b, other)))
        moved = se3_exp(3 * se3_log(a @ invert(b))) @ a
        far.append(differ(estimate(moved, one), estimate(b, other)))
    assert np.mean(near) < 0.01
    assert np.mean(far) > 0.95
