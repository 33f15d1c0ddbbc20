"""Local bundle adjustment: keyframes and points move together until the features fit best.
 Levenberg-Marquardt on the normal equations, reduced to the cameras by the Schur complement
(Triggs et al., Bundle Adjustment: A Modern Synthesis, 2000, section 6.1), Huber cost. One pose
per stereo pair: the baseline is fixed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.geometry import Array, se3_exp
from segfloor_ros.slam.disparity_offset import NO_OFFSET, OffsetEstimate
from segfloor_ros.slam.residuals import (
    MIN_DEPTH_M,
    Observations,
    huber_cost,
    huber_weights,
    point_jacobians,
    pose_jacobians,
    residuals,
    squared_norms,
)

SMALLEST_PIVOT = 1e-12

CONVERGED = 1e-3
"""Stop at this relative decrease of the cost; the next keyframe goes on from there."""


@dataclass(frozen=True)
class BundleProblem:
    """A bundle adjustment problem.

    T_camera_world: (K, 4, 4), the first `num_free` of them move. points_world: (P, 3).
    Observation i (N in total) is of point `point[i]` in keyframe `keyframe[i]`; a pair occurs at
    most once. offset: what was known before of the error that all disparities share.
    """

    T_camera_world: Array
    num_free: int
    points_world: Array
    keyframe: NDArray[np.intp]
    point: NDArray[np.intp]
    observations: Observations
    offset: OffsetEstimate = NO_OFFSET


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


def adjust(camera: StereoCamera, problem: BundleProblem, iterations: int) -> BundleResult:
    """Minimise the Huber cost over free poses and points; damping by the gain ratio (Madsen et
    al., Methods for Non-Linear Least Squares Problems, 2004, algorithm 3.16).
    """
    prior = problem.offset
    state = _evaluate(camera, problem, prior)
    cost_before = state.cost
    damping, growth = 1e-4, 2.0
    for _ in range(iterations):
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
    inliers = state.front & (state.chi2 <= problem.observations.chi2_limit)
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


def _evaluate(camera: StereoCamera, problem: BundleProblem, prior: OffsetEstimate) -> _State:
    poses = problem.T_camera_world[problem.keyframe]
    points = np.einsum('nij,nj->ni', poses[:, :3, :3], problem.points_world[problem.point])
    points += poses[:, :3, 3]
    front = points[:, 2] > MIN_DEPTH_M
    points[:, 2] = np.maximum(points[:, 2], MIN_DEPTH_M)
    residual = residuals(camera, points, problem.observations)
    residual[:, 2] += problem.offset.value_px * problem.observations.has_disparity
    chi2 = squared_norms(residual, problem.observations.information)
    cost = huber_cost(chi2, problem.observations.chi2_limit)
    cost += prior.information * (problem.offset.value_px - prior.value_px) ** 2
    return _State(points, residual, chi2, front, cost)


@dataclass(frozen=True)
class _Step:
    twists: Array
    shifts: Array
    offset_px: float
    offset_information: float


@dataclass(frozen=True)
class _System:
    """The normal equations by blocks: cameras U (K, 6, 6), points V (P, 3, 3), and W (M, 6, 3) of
    each pair (keyframe[m], point[m]) that an observation ties together; right-hand sides. The
    disparity offset is one more unknown: its products with cameras (K, 6), points (P, 3), itself.
    """

    U: Array
    V: Array
    W: Array
    keyframe: NDArray[np.intp]
    point: NDArray[np.intp]
    camera_rhs: Array
    point_rhs: Array
    offset_camera: Array
    offset_point: Array
    offset_offset: float
    offset_rhs: float

    def solve(self, damping: float) -> _Step:
        """Solve the damped system by the Schur complement on the cameras.

        With V = L L^T by blocks and Y = L^-1 W^T, the complement is U - Y^T Y: one dense matrix,
        which is multiplied with itself.
        """
        L_inverse = _inverse_cholesky(_damped(self.V, damping))
        Y = self._dense(L_inverse[self.point] @ np.swapaxes(self.W, 1, 2))
        y_offset = _times(L_inverse, self.offset_point).ravel()
        y_rhs = _times(L_inverse, self.point_rhs).ravel()
        size = Y.shape[1]
        S = np.empty((size + 1, size + 1))
        S[:-1, :-1] = -(Y.T @ Y)
        diagonal = _damped(self.U, damping)
        for k in range(len(self.U)):
            S[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += diagonal[k]
        S[-1, :-1] = S[:-1, -1] = self.offset_camera.ravel() - Y.T @ y_offset
        S[-1, -1] = self.offset_offset - y_offset @ y_offset
        rhs = np.append(self.camera_rhs.ravel() - Y.T @ y_rhs, self.offset_rhs - y_offset @ y_rhs)
        unit = np.append(np.zeros(size), 1.0)
        solution, variances = np.linalg.solve(S, np.stack([rhs, unit], axis=1)).T
        back = (y_rhs - Y @ solution[:-1] - y_offset * solution[-1]).reshape(-1, 3)
        shifts = _times(np.swapaxes(L_inverse, 1, 2), back)
        twists = solution[:-1].reshape(-1, 6)
        return _Step(twists, shifts, float(solution[-1]), 1.0 / float(variances[-1]))

    def _dense(self, blocks: Array) -> Array:
        """Return the matrix (3 P, 6 K) that the blocks (M, 3, 6) are part of."""
        free, points = len(self.U), len(self.V)
        dense = np.zeros((points, 3, free, 6))
        dense[self.point, :, self.keyframe, :] = blocks
        return dense.reshape(3 * points, 6 * free)

    def predicted_decrease(self, step: _Step, damping: float) -> float:
        """Return how much the cost falls by the quadratic model."""
        diagonal_U = np.einsum('kaa->ka', self.U)
        diagonal_V = np.einsum('paa->pa', self.V)
        return float(
            (step.twists * (damping * diagonal_U * step.twists + self.camera_rhs)).sum()
            + (step.shifts * (damping * diagonal_V * step.shifts + self.point_rhs)).sum()
            + step.offset_px * self.offset_rhs
        )


def _inverse_cholesky(A: Array) -> Array:
    """Return the inverses of the lower Cholesky factors of symmetric positive matrices (N, 3, 3),
    row by row; far faster than LAPACK's for so small ones.
    """
    inverse = np.zeros_like(A)
    a = 1.0 / np.sqrt(np.maximum(A[:, 0, 0], SMALLEST_PIVOT))
    l10, l20 = A[:, 1, 0] * a, A[:, 2, 0] * a
    b = 1.0 / np.sqrt(np.maximum(A[:, 1, 1] - l10**2, SMALLEST_PIVOT))
    l21 = (A[:, 2, 1] - l20 * l10) * b
    c = 1.0 / np.sqrt(np.maximum(A[:, 2, 2] - l20**2 - l21**2, SMALLEST_PIVOT))
    inverse[:, 0, 0], inverse[:, 1, 1], inverse[:, 2, 2] = a, b, c
    inverse[:, 1, 0] = -l10 * a * b
    inverse[:, 2, 1] = -l21 * b * c
    inverse[:, 2, 0] = (l21 * l10 * b - l20) * a * c
    return inverse


def _times(A: Array, v: Array) -> Array:
    """Return the products (N, a) of stacks (N, a, b) and (N, b)."""
    return (A @ v[..., None])[..., 0]


def _damped(blocks: Array, damping: float) -> Array:
    size = blocks.shape[1]
    diagonal = np.einsum('kaa->ka', blocks)
    return blocks + np.eye(size) * (damping * diagonal + 1e-9)[:, None, :]


def _linearise(
    camera: StereoCamera, problem: BundleProblem, state: _State, prior: OffsetEstimate
) -> _System:
    observations = problem.observations
    weight = observations.information * huber_weights(state.chi2, observations.chi2_limit)[:, None]
    weight = weight * state.front[:, None]
    by_camera_point = point_jacobians(camera, state.points_camera)
    J_point = by_camera_point @ problem.T_camera_world[problem.keyframe][:, :3, :3]
    WJ_point = J_point * weight[:, :, None]
    num_points = len(problem.points_world)
    V = _sum_by(problem.point, _products(J_point, WJ_point), num_points)
    point_rhs = -_sum_by(
        problem.point, _products(WJ_point, state.residual[..., None])[..., 0], num_points
    )

    free = problem.keyframe < problem.num_free
    k, p = problem.keyframe[free], problem.point[free]
    J_pose = pose_jacobians(by_camera_point[free], state.points_camera[free])
    WJ_pose = J_pose * weight[free][:, :, None]
    U, camera_rhs = _sum_by_camera(k, J_pose, WJ_pose, state.residual[free], problem.num_free)
    W = _products(WJ_pose, J_point[free])
    weight_d = weight[:, 2] * observations.has_disparity
    offset_point = _sum_by(problem.point, weight_d[:, None] * J_point[:, 2], num_points)
    offset_camera = _sum_by(k, weight_d[free][:, None] * J_pose[:, 2], problem.num_free)
    offset_rhs = -float(weight_d @ state.residual[:, 2])
    offset_rhs -= prior.information * (problem.offset.value_px - prior.value_px)
    return _System(
        U,
        V,
        W,
        k,
        p,
        camera_rhs,
        point_rhs,
        offset_camera,
        offset_point,
        float(weight_d.sum()) + prior.information,
        offset_rhs,
    )


def _products(A: Array, B: Array) -> Array:
    """Return A^T B for stacks (N, 3, a) and (N, 3, b)."""
    return np.swapaxes(A, 1, 2) @ B


def _sum_by_camera(
    keyframe: NDArray[np.intp], J: Array, WJ: Array, residual: Array, size: int
) -> tuple[Array, Array]:
    """Return J^T W J (size, 6, 6) and -J^T W r (size, 6), summed by keyframe: one product of tall
    matrices for each.
    """
    U, rhs = np.zeros((size, 6, 6)), np.zeros((size, 6))
    order = np.argsort(keyframe, kind='stable')
    starts = np.searchsorted(keyframe[order], np.arange(size + 1))
    for k in range(size):
        mine = order[starts[k] : starts[k + 1]]
        weighted = WJ[mine].reshape(-1, 6)
        U[k] = weighted.T @ J[mine].reshape(-1, 6)
        rhs[k] = -weighted.T @ residual[mine].ravel()
    return U, rhs


def _sum_by(index: NDArray[np.intp], values: Array, size: int) -> Array:
    """Sum values (N, ...) into `size` groups."""
    flat = values.reshape(len(values), -1)
    sums = np.stack([np.bincount(index, column, size) for column in flat.T], axis=1)
    return np.asarray(sums, np.float64).reshape(size, *values.shape[1:])


def _apply(problem: BundleProblem, step: _Step) -> BundleProblem:
    poses = problem.T_camera_world.copy()
    poses[: problem.num_free] = se3_exp(step.twists) @ poses[: problem.num_free]
    return replace(
        problem,
        T_camera_world=poses,
        points_world=problem.points_world + step.shifts,
        offset=OffsetEstimate(problem.offset.value_px + step.offset_px, step.offset_information),
    )
