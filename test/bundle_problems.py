"""Bundle adjustments with known answers."""

import numpy as np

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.geometry import transform_points
from segfloor_ros.core.slam.mapping.bundle_adjustment import BundleProblem
from segfloor_ros.core.slam.rig import Observations
from segfloor_ros.core.twists import se3_exp

CAMERA = StereoCamera(640, 480, 320.0, 320.0, 319.5, 239.5, 0.12)


def make_problem(num_keyframes=5, num_points=150, num_free=3, sigma=0.0, seed=0):
    """Return a problem at the truth: cameras along a line, all points seen by all, the last
    ones fixed.
    """
    rng = np.random.default_rng(seed)
    z = rng.uniform(2.0, 8.0, num_points)
    points = np.stack(
        [rng.uniform(-0.7, 0.7, num_points) * z, rng.uniform(-0.5, 0.5, num_points) * z, z], 1
    )
    poses = np.stack(
        [
            se3_exp(np.array([-0.1 * k, 0.01 * k, -0.15 * k, 0, 0.02 * k, 0]))
            for k in range(num_keyframes)
        ]
    )
    keyframe, point = (
        grid.ravel()
        for grid in np.meshgrid(np.arange(num_keyframes), np.arange(num_points), indexing='ij')
    )
    uvr = np.concatenate([CAMERA.project(transform_points(pose, points)) for pose in poses])
    uvd = np.stack([uvr[:, 0], uvr[:, 1], uvr[:, 0] - uvr[:, 2]], axis=1)
    uvd += rng.normal(size=uvd.shape) * sigma
    seen = Observations(uvd, np.full(uvd.shape, max(sigma, 0.1)))
    return BundleProblem(poses, num_free, points, keyframe, point, seen)


def disturbed(problem, seed=1):
    rng = np.random.default_rng(seed)
    poses = problem.T_camera_world.copy()
    free = problem.num_free
    poses[:free] = (
        se3_exp(rng.normal(size=(free, 6)) * [0.03, 0.03, 0.03, 0.01, 0.01, 0.01]) @ poses[:free]
    )
    points = problem.points_world + rng.normal(size=problem.points_world.shape) * 0.05
    return BundleProblem(poses, free, points, problem.keyframe, problem.point, problem.observations)
