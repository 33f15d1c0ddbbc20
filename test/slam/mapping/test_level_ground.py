"""A base that stays on one plane: the prior, and what it does to poses that rise and tilt."""

from __future__ import annotations

import numpy as np
import pytest
from bundle_problems import CAMERA
from stereo_room import MOUNT, planar_pose

from segfloor_ros.geometry import invert, se3_exp
from segfloor_ros.slam.map.residuals import Observations
from segfloor_ros.slam.mapping.bundle_adjustment import BundleProblem, adjust
from segfloor_ros.slam.mapping.level_ground import SIGMA, LevelGround
from segfloor_ros.slam.places.loop_closing import PoseGraph, optimise

T_BASE_LEFT = MOUNT.T_base_left
GROUND = LevelGround(T_BASE_LEFT)


def on_the_plane(count=12):
    """Cameras T_camera_world (K, 4, 4) of a base that drives on the plane."""
    bases = [planar_pose(0.3 * k, 0.02 * k * k, 0.1 * k) for k in range(count)]
    return np.stack([invert(T_BASE_LEFT) @ invert(base) @ T_BASE_LEFT for base in bases])


def heights_and_tilts(poses):
    T_map_base = T_BASE_LEFT @ invert(poses) @ invert(T_BASE_LEFT)
    return np.abs(T_map_base[:, 2, 3]).max(), np.arccos(np.clip(T_map_base[:, 2, 2], -1, 1)).max()


def test_a_base_on_the_plane_has_no_error_and_others_have_theirs():
    poses = on_the_plane()
    assert GROUND.cost(poses) == pytest.approx(0.0, abs=1e-12)
    up = np.eye(4)
    up[2, 3] = 0.03
    T_map_base = up @ planar_pose(1.0, 2.0, 0.7)
    raised = invert(T_BASE_LEFT) @ invert(T_map_base) @ T_BASE_LEFT
    assert GROUND.cost(raised[None]) == pytest.approx((0.03 / SIGMA[0]) ** 2)


def test_the_derivative_is_that_of_the_errors():
    rng = np.random.default_rng(3)
    poses = se3_exp(0.1 * rng.normal(size=(12, 6))) @ on_the_plane()
    _, J = GROUND.errors(poses)
    for axis, twist in enumerate(1e-6 * np.eye(6)):
        after, before = (GROUND.errors(se3_exp(s * twist) @ poses)[0] for s in (1, -1))
        np.testing.assert_allclose((after - before) / 2e-6, J[:, :, axis], atol=1e-5)


def test_a_pose_graph_comes_back_to_the_plane():
    truth = on_the_plane()
    drift = np.array([0.002, -0.01, 0.001, 0.004, 0.0, -0.003])
    poses = [truth[0]]
    for k in range(1, len(truth)):
        poses.append(se3_exp(drift) @ truth[k] @ invert(truth[k - 1]) @ poses[-1])
    poses = np.stack(poses)
    k = np.arange(1, len(poses))
    fixed = np.arange(len(poses)) == 0
    links = poses[k] @ invert(poses[k - 1])
    sigma = np.tile([0.01] * 3 + [0.005] * 3, (len(k), 1))
    graph = PoseGraph(poses, fixed, k, k - 1, links, sigma, np.zeros(len(k), bool), GROUND)
    after, _ = optimise(graph)
    (up, tilt), (up_after, tilt_after) = heights_and_tilts(poses), heights_and_tilts(after)
    assert up > 0.1 and tilt > 0.04
    assert up_after < 0.1 * up and tilt_after < 0.3 * tilt


def test_a_bundle_adjustment_comes_back_to_the_plane():
    truth, rng = on_the_plane(4), np.random.default_rng(1)
    world = np.column_stack([rng.uniform(-2, 2, 120), rng.uniform(-1, 1, 120), np.full(120, 6.0)])
    keyframe, point = np.repeat(np.arange(4), 120), np.tile(np.arange(120), 4)
    lifted = truth.copy()
    lifted[1:] = se3_exp(np.array([0.0, 0.05, 0.0, 0.01, 0.0, 0.0])) @ truth[1:]
    local = np.einsum('nij,nj->ni', lifted[keyframe][:, :3, :3], world[point])
    local += lifted[keyframe][:, :3, 3]
    uvr = CAMERA.project(local)
    uvd = np.column_stack([uvr[:, :2], uvr[:, 0] - uvr[:, 2]])
    order = [1, 2, 3, 0]
    slot = np.argsort(order)[keyframe]
    # So little is known of each feature that the plane counts.
    observations = Observations(uvd, np.full(uvd.shape, 30.0))
    problem = BundleProblem(lifted[order], 3, world, slot, point, observations, ground=GROUND)
    result = adjust(CAMERA, problem, iterations=10)
    (up, tilt), (up_after, tilt_after) = (
        heights_and_tilts(poses) for poses in (lifted, result.T_camera_world)
    )
    assert up_after < 0.5 * up and tilt_after < 0.5 * tilt
