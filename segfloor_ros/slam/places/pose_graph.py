"""Pose-graph optimisation: keyframes move until their relative poses fit best.

Minimises the sum of e^T W e with e_ij = log(T_i_j Z_i_j^-1) over T_i_j = T_i T_j^-1 by
Levenberg-Marquardt (Grisetti et al., A Tutorial on Graph-Based SLAM, 2010). Edges can be robust:
one that contradicts the others loses its weight (Agarwal et al., Robust Map Optimization
using Dynamic Covariance Scaling, ICRA 2013).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from segfloor_ros.geometry import Array, adjoint, invert, se3_exp, se3_logs
from segfloor_ros.slam.mapping.level_ground import LevelGround

STEPS = 20
CONVERGED = 1e-4
LOOP_KERNEL = 12.6
"""Squared error of a loop at which it begins to lose weight: the 95 % quantile of chi-squared with
six degrees of freedom."""


@dataclass(frozen=True)
class PoseGraph:
    """T_camera_world: (K, 4, 4). Edge m (M in total) says that camera i[m] sees camera j[m] at
    T_i_j[m] (M, 4, 4), to sigma (M, 6) in metres and radians. is_robust: (M,) which edges
    may be wrong. fixed: (K,) which cameras stay. ground: what the base is known to stay on.
    """

    T_camera_world: Array
    fixed: NDArray[np.bool_]
    i: NDArray[np.intp]
    j: NDArray[np.intp]
    T_i_j: Array
    sigma: Array
    is_robust: NDArray[np.bool_]
    ground: LevelGround | None = None


def optimise(graph: PoseGraph) -> tuple[Array, Array]:
    """Return the poses T_camera_world (K, 4, 4) that fit best, and the weights (M,) that the edges
    have there, in [0, 1].
    """
    poses = graph.T_camera_world
    error = _errors(graph, poses)
    weight, cost = _robust(graph, error, poses)
    damping = 1e-6
    for _ in range(STEPS):
        step = _solve(graph, poses, error, weight, damping)
        candidate = se3_exp(step) @ poses
        trial = _errors(graph, candidate)
        trial_weight, trial_cost = _robust(graph, trial, candidate)
        if trial_cost > cost:
            damping *= 10.0
            continue
        converged = cost - trial_cost < CONVERGED * cost + 1e-12
        poses, error, weight, cost = candidate, trial, trial_weight, trial_cost
        damping = max(damping * 0.1, 1e-9)
        if converged:
            break
    return poses, weight


def _errors(graph: PoseGraph, poses: Array) -> Array:
    """Return the errors (M, 6) of the edges in units of their sigma."""
    T_i_j = poses[graph.i] @ invert(poses[graph.j])
    return se3_logs(T_i_j @ invert(graph.T_i_j)) / graph.sigma


def _robust(graph: PoseGraph, error: Array, poses: Array) -> tuple[Array, float]:
    """Return the weights (M,) of the edges and the cost (Geman-McClure for the robust ones)."""
    chi2 = (error**2).sum(axis=1)
    share = LOOP_KERNEL / (LOOP_KERNEL + chi2)
    weight = np.where(graph.is_robust, share**2, 1.0)
    cost = float(np.where(graph.is_robust, share * chi2, chi2).sum())
    return weight, cost if graph.ground is None else cost + graph.ground.cost(poses)


def _solve(graph: PoseGraph, poses: Array, error: Array, weight: Array, damping: float) -> Array:
    """Return the twists (K, 6) of the next step; a small error's derivative is that of the twists
    themselves: e changes by xi_i - Ad(T_i_j) xi_j.
    """
    count, edges = len(poses), len(graph.i)
    scale = (np.sqrt(weight)[:, None] / graph.sigma)[:, :, None]
    J_i = scale * np.eye(6)
    J_j = -scale * adjoint(poses[graph.i] @ invert(poses[graph.j]))
    blocks = np.stack([J_i, J_j], axis=1).reshape(-1, 6, 6)
    columns = np.stack([graph.i, graph.j], axis=1).ravel()
    J = sparse.bsr_array(
        (blocks, columns, 2 * np.arange(edges + 1)), shape=(6 * edges, 6 * count)
    ).tocsr()
    residual = (np.sqrt(weight)[:, None] * error).ravel()
    if graph.ground is not None:
        of_ground, J_ground = graph.ground.errors(poses)
        rows = sparse.bsr_array(
            (J_ground, np.arange(count), np.arange(count + 1)), shape=(3 * count, 6 * count)
        )
        J = sparse.csr_array(sparse.vstack([J, rows]))
        residual = np.append(residual, of_ground)
    moving = np.flatnonzero(np.repeat(~graph.fixed, 6))
    J = J[:, moving]
    H = (J.T @ J).tocsc()
    diagonal = H.diagonal()
    g = J.T @ residual
    step = np.zeros(6 * count)
    added = (damping * diagonal + 1e-12)[None]
    damped = H + sparse.dia_array((added, [0]), shape=H.shape).tocsc()
    step[moving] = -splu(damped.tocsc()).solve(g)
    return step.reshape(-1, 6)
