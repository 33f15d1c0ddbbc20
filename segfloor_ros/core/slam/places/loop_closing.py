"""Closing a loop: keyframes and points move so that both ends meet, and become one map.

Pose-graph optimisation: keyframes move until their relative poses fit best.

Minimises the sum of e^T W e with e_ij = log(T_i_j Z_i_j^-1) over T_i_j = T_i T_j^-1 by
Levenberg-Marquardt (Grisetti et al., A Tutorial on Graph-Based SLAM, 2010). Edges can be robust:
one that contradicts the others loses its weight (Agarwal et al., Robust Map Optimization
using Dynamic Covariance Scaling, ICRA 2013).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from segfloor_ros.core.contracts import NO_POINT
from segfloor_ros.core.geometry import Array, invert
from segfloor_ros.core.least_squares import minimise
from segfloor_ros.core.slam.mapping.bundle_adjustment import move_keyframes
from segfloor_ros.core.slam.mapping.keyframe_mapping import fuse_duplicates
from segfloor_ros.core.slam.mapping.normal_equations import solve_symmetric
from segfloor_ros.core.slam.rig import LOCAL_KEYFRAMES, chi2_limit, is_gated
from segfloor_ros.core.slam.sparse_map import LINK_SIGMA, LoopEdge, Match, SparseMap
from segfloor_ros.core.slam.tracking.pose import CONVERGED
from segfloor_ros.core.twists import adjoint, se3_exp, se3_log, se3_logs

STEPS, FIRST_DAMPING = 20, 1e-6


@dataclass(frozen=True)
class Closing:
    """A loop to be closed, copied out of the map."""

    matches: list[Match]
    edges: list[LoopEdge]
    graph: PoseGraph

    @property
    def is_far(self) -> bool:
        """Whether the latest keyframe that sees the place is off by more than what loops err."""
        loop, poses = self.edges[-1], self.graph.T_camera_world
        off = poses[loop.i] @ invert(poses[loop.j]) @ invert(loop.T_i_j)
        return not is_gated(se3_log(off), np.diag(loop.sigma**2))


def plan_closing(sparse_map: SparseMap, matches: list[Match]) -> Closing:
    """Copy the pose graph out of the map, with a loop from each keyframe that sees the place."""
    keyframes = sparse_map.keyframes
    poses = np.stack([k.T_camera_world for k in keyframes])
    i, j = sparse_map.links()
    new = [loop_edge(sparse_map, match) for match in matches]
    loops = [*sparse_map.loops, *new]
    T_loops = np.stack([loop.T_i_j for loop in loops])
    of_links = np.tile(np.repeat(LINK_SIGMA, 3), (len(i), 1))
    sigma = np.concatenate([of_links, [loop.sigma for loop in loops]])
    graph = PoseGraph(
        poses,
        np.append(i, [loop.i for loop in loops]).astype(np.intp),
        np.append(j, [loop.j for loop in loops]).astype(np.intp),
        np.concatenate([poses[i] @ invert(poses[j]), T_loops]),
        sigma,
        # What is new is expected to pull; what was found before must go on to fit.
        (np.arange(len(sigma)) >= len(i)) & (np.arange(len(sigma)) < len(sigma) - len(new)),
    )
    return Closing(matches, new, graph)


def loop_edge(sparse_map: SparseMap, match: Match) -> LoopEdge:
    """Return the loop that a match makes."""
    place = sparse_map.keyframes[match.place]
    T_i_j = match.T_camera_world @ place.T_world_camera
    return LoopEdge(match.keyframe, match.place, T_i_j, by_floor=len(match.rows) == 0)


def apply_closing(sparse_map: SparseMap, closing: Closing, result: tuple[Array, Array]) -> bool:
    """Bring a closed loop into the map, which has had no new keyframe since. False, and nothing
    moves, where the loop contradicts the rest of the map: it switches an earlier one off that was
    on so far.
    """
    poses, weight = result
    graph, least = closing.graph, _robust_share(chi2_limit(6)) ** 2
    so_far = _State.at(graph, graph.T_camera_world).weight
    if ((weight < least) & (so_far >= least)).any():
        return False
    move_keyframes(sparse_map, poses)
    sparse_map.loops += closing.edges
    for match in closing.matches:
        _merge(sparse_map, match)
    fuse_latest(sparse_map, closing.matches[-1].keyframe)
    return True


def fuse_latest(sparse_map: SparseMap, latest: int) -> None:
    """Merge what the keyframes up to the latest know twice, now that both ends are one map."""
    for keyframe in sparse_map.keyframes[max(0, latest - LOCAL_KEYFRAMES) : latest + 1]:
        if keyframe.retired is None:
            fuse_duplicates(sparse_map, keyframe)


def _merge(sparse_map: SparseMap, match: Match) -> None:
    """Make one point of what a keyframe knows as its own and the place as another."""
    keyframe = sparse_map.keyframes[match.keyframe]
    if keyframe.is_thin:
        return
    same = sparse_map.alive[match.ids] & (sparse_map.stable_id[match.ids] == match.stable_ids)
    own = np.where(same, keyframe.point_id[match.rows], NO_POINT)
    merge_pairs(sparse_map, own, match.ids)


def merge_pairs(sparse_map: SparseMap, own: NDArray[np.integer], old: NDArray[np.integer]) -> None:
    """Make one of each pair (own[i], old[i]), (N,), of point rows; -1 is no point."""
    pairs = (own >= 0) & (old >= 0) & (own != old)
    own, old = own[pairs], old[pairs]
    _, first = np.unique(own, return_index=True)
    own, old = own[first], old[first]
    once = ~np.isin(own, old)
    sparse_map.merge(own[once], old[once])


@dataclass(frozen=True)
class PoseGraph:
    """T_camera_world: (K, 4, 4). Edge m (M in total) says that camera i[m] sees camera j[m] at
    T_i_j[m] (M, 4, 4), to sigma (M, 6) in metres and radians. is_robust: (M,) which edges
    may be wrong. The first camera stays.
    """

    T_camera_world: Array
    i: NDArray[np.intp]
    j: NDArray[np.intp]
    T_i_j: Array
    sigma: Array
    is_robust: NDArray[np.bool_]


def optimise(graph: PoseGraph) -> tuple[Array, Array]:
    """Return the poses T_camera_world (K, 4, 4) that fit best, and the weights (M,) that the edges
    have there, in [0, 1].
    """
    best = minimise(_State.at(graph, graph.T_camera_world), STEPS, CONVERGED, FIRST_DAMPING)
    return best.poses, best.weight


@dataclass(frozen=True)
class _State:
    """Poses on trial, (K, 4, 4), with errors (M, 6) in units of sigma, weights (M,) and cost of the
    edges.
    """

    graph: PoseGraph
    poses: Array
    error: Array
    weight: Array
    cost: float

    @staticmethod
    def at(graph: PoseGraph, poses: Array) -> _State:
        """Evaluate the edges; Geman-McClure cost for the robust ones."""
        T_i_j = poses[graph.i] @ invert(poses[graph.j])
        error = se3_logs(T_i_j @ invert(graph.T_i_j)) / graph.sigma
        chi2 = (error**2).sum(axis=1)
        share = np.where(graph.is_robust, _robust_share(chi2), 1.0)
        return _State(graph, poses, error, share**2, float((share * chi2).sum()))

    def linearised(self) -> Callable[[float], tuple[_State, float]]:
        """Return what solves the normal equations for a damping. A small error's derivative is that
        of the twists themselves: e changes by xi_i - Ad(T_i_j) xi_j.
        """
        graph, poses, count = self.graph, self.poses, len(self.poses)
        scale = (np.sqrt(self.weight)[:, None] / graph.sigma)[:, :, None]
        J_j = -scale * adjoint(poses[graph.i] @ invert(poses[graph.j]))
        blocks = np.stack([scale * np.eye(6), J_j], axis=1).reshape(-1, 6, 6)
        columns = np.stack([graph.i, graph.j], axis=1).ravel()
        rows = 2 * np.arange(len(graph.i) + 1)
        shape = (6 * len(graph.i), 6 * count)
        J = sparse.bsr_array((blocks, columns, rows), shape=shape).tocsr()
        J = J[:, 6:]
        H, gradient = (J.T @ J).tocsc(), -J.T @ (np.sqrt(self.weight)[:, None] * self.error).ravel()

        def stepped(damping: float) -> tuple[_State, float]:
            added = (damping * H.diagonal() + 1e-12)[None]
            damped = H + sparse.dia_array((added, [0]), shape=H.shape).tocsc()
            step = np.append(np.zeros(6), solve_symmetric(damped.tocsc(), gradient))
            return _State.at(graph, se3_exp(step.reshape(-1, 6)) @ poses), 0.1

        return stepped


def _robust_share(chi2: Array | float) -> Array:
    """Return the root (...) of the weight of edges with a squared error."""
    return np.asarray(chi2_limit(6) / (chi2_limit(6) + chi2))
