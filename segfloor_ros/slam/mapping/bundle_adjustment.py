"""Local bundle adjustment: keyframes and points move together until the features fit best.

Levenberg-Marquardt, Huber cost. One pose per stereo pair: the baseline is fixed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.geometry import Array, se3_exp, transform_points
from segfloor_ros.slam.map.residuals import (
    MIN_DEPTH_M,
    Observations,
    huber_cost,
    huber_weights,
    residuals,
    squared_norms,
)
from segfloor_ros.slam.mapping.disparity_offset import NO_OFFSET, OffsetEstimate
from segfloor_ros.slam.mapping.level_ground import LevelGround
from segfloor_ros.slam.mapping.normal_equations import Linearisation, Step, System, normal_equations
from segfloor_ros.slam.sensors.motion_links import Factor, cost, with_factors

CONVERGED = 2e-3
"""Stop at this relative decrease of the cost; the next keyframe goes on from there."""


@dataclass(frozen=True)
class BundleProblem:
    """A bundle adjustment problem.

    T_camera_world: (K, 4, 4), the first `num_free` of them move. points_world: (P, 3).
    Observation i (N in total) is of point `point[i]` in keyframe `keyframe[i]`; a pair occurs at
    most once. offset: what was known before of the error that all disparities share. factors: what
    wheels and an accelerometer measured of keyframes. ground: what the base is known to stay on.
    """

    T_camera_world: Array
    num_free: int
    points_world: Array
    keyframe: NDArray[np.intp]
    point: NDArray[np.intp]
    observations: Observations
    offset: OffsetEstimate = NO_OFFSET
    factors: tuple[Factor, ...] = ()
    ground: LevelGround | None = None


@dataclass(frozen=True)
class BundleResult:
    """Adjusted poses (K, 4, 4) and points (P, 3), which observations (N,) fit, and the cost
    before and after.
    """

    T_camera_world: Array
    points_world: Array
    inliers: NDArray[np.bool_]
    cost_before: float
    cost_after: float
    offset: OffsetEstimate


def adjust(
    camera: StereoCamera,
    problem: BundleProblem,
    iterations: int,
    is_wanted: Callable[[], bool] = lambda: True,
) -> BundleResult:
    """Minimise the Huber cost over free poses and points; damping by the gain ratio (Madsen et
    al., Methods for Non-Linear Least Squares Problems, 2004, algorithm 3.16). It ends early when
    the result is no longer wanted.
    """
    prior, order = problem.offset, np.argsort(problem.keyframe, kind='stable')
    problem = _take_observations(problem, order)
    state = _evaluate(camera, problem, prior)
    cost_before = state.cost
    damping, growth = 1e-4, 2.0
    for _ in range(iterations):
        if not is_wanted():
            break
        system = _linearise(camera, problem, state, prior)
        step = system.solve(damping)
        candidate = _apply(problem, step)
        trial = _evaluate(camera, candidate, prior)
        predicted = system.predicted_decrease(step, damping)
        gain = (state.cost - trial.cost) / max(predicted, 1e-12)
        if gain > 0:
            converged = state.cost - trial.cost < CONVERGED * state.cost
            problem, state = candidate, trial
            damping *= max(1 / 3, 1 - (2 * gain - 1) ** 3)
            growth = 2.0
            if converged:
                break
        else:
            damping *= growth
            growth *= 2.0
    inliers = np.empty(len(order), bool)
    inliers[order] = state.front & (state.chi2 <= problem.observations.chi2_limit)
    return BundleResult(
        problem.T_camera_world,
        problem.points_world,
        inliers,
        cost_before,
        state.cost,
        problem.offset,
    )


@dataclass(frozen=True)
class _State:
    points_camera: Array
    residual: Array
    chi2: Array
    front: NDArray[np.bool_]
    cost: float


def _take_observations(problem: BundleProblem, rows: NDArray[np.intp]) -> BundleProblem:
    return replace(
        problem,
        keyframe=problem.keyframe[rows],
        point=problem.point[rows],
        observations=problem.observations.take(rows),
    )


def _evaluate(camera: StereoCamera, problem: BundleProblem, prior: OffsetEstimate) -> _State:
    """Return residuals and cost; observations are in the order of their keyframes."""
    points = problem.points_world[problem.point]
    starts = np.searchsorted(problem.keyframe, np.arange(len(problem.T_camera_world) + 1))
    for k, T in enumerate(problem.T_camera_world):
        mine = slice(starts[k], starts[k + 1])
        points[mine] = transform_points(T, points[mine])
    front = points[:, 2] > MIN_DEPTH_M
    points[:, 2] = np.maximum(points[:, 2], MIN_DEPTH_M)
    residual = residuals(camera, points, problem.observations)
    residual[:, 2] += problem.offset.value_px * problem.observations.has_disparity
    chi2 = squared_norms(residual, problem.observations.information)
    total = huber_cost(chi2, problem.observations.chi2_limit)
    total += prior.information * (problem.offset.value_px - prior.value_px) ** 2
    total += sum(cost(factor, problem.T_camera_world) for factor in problem.factors)
    if problem.ground is not None:
        total += problem.ground.cost(problem.T_camera_world)
    return _State(points, residual, chi2, front, total)


def _linearise(
    camera: StereoCamera, problem: BundleProblem, state: _State, prior: OffsetEstimate
) -> System:
    observations = problem.observations
    weight = observations.information * huber_weights(state.chi2, observations.chi2_limit)[:, None]
    at = Linearisation(
        problem.T_camera_world,
        problem.num_free,
        len(problem.points_world),
        problem.keyframe,
        problem.point,
        state.points_camera,
        state.residual,
        weight * state.front[:, None],
    )
    system = normal_equations(camera, at).with_prior(
        prior.information, problem.offset.value_px - prior.value_px
    )
    if problem.ground is not None:
        system = problem.ground.added_to(system, problem.T_camera_world)
    return with_factors(system, problem.T_camera_world, problem.factors)


def _apply(problem: BundleProblem, step: Step) -> BundleProblem:
    poses = problem.T_camera_world.copy()
    poses[: problem.num_free] = se3_exp(step.twists) @ poses[: problem.num_free]
    return replace(
        problem,
        T_camera_world=poses,
        points_world=problem.points_world + step.shifts,
        offset=OffsetEstimate(problem.offset.value_px + step.offset_px, step.offset_information),
    )
