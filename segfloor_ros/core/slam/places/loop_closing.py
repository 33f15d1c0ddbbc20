"""Closing a loop: keyframes and points move so that both ends meet, and become one map.

A known map that was saved by another drive, or made by this one before it got lost, stays beside
the drive's own. Once several keyframes in a row see it and agree on where it lies, the drive's own
map is brought into it (Campos et al., ORB-SLAM3, IEEE T-RO 2021, section VI: map merging).

Pose-graph optimisation: keyframes move until their relative poses fit best.

Minimises the sum of e^T W e with e_ij = log(T_i_j Z_i_j^-1) over T_i_j = T_i T_j^-1 by
Levenberg-Marquardt (Grisetti et al., A Tutorial on Graph-Based SLAM, 2010). Edges can be robust:
one that contradicts the others loses its weight (Agarwal et al., Robust Map Optimization
using Dynamic Covariance Scaling, ICRA 2013).

Two saved maps, of several robots or of days that were mapped apart, become one in the same way: the
keyframes of the second are looked for in the first by what they observed, one after the other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import NO_POINT
from segfloor_ros.core.files.results import Arrays
from segfloor_ros.core.geometry import Array, adjoint, invert, se3_exp, se3_log, se3_logs
from segfloor_ros.core.plugins.saved_slam import fill_map, map_to_arrays, moved
from segfloor_ros.core.slam.mapping.bundle_adjustment import (
    apply_global,
    copy_map,
    move_keyframes,
    solve_global,
)
from segfloor_ros.core.slam.mapping.keyframe_mapping import fuse_duplicates
from segfloor_ros.core.slam.mapping.normal_equations import solve_symmetric
from segfloor_ros.core.slam.places.loops import LoopDetector, PlaceMatcher, drift
from segfloor_ros.core.slam.places.place_recognition import (
    FloorIndex,
    PlaceRecognition,
    Relocaliser,
)
from segfloor_ros.core.slam.rig import LOCAL_KEYFRAMES, OffsetEstimate, Rig, chi2_limit, is_gated
from segfloor_ros.core.slam.sparse_map import LINK_SIGMA, KeyframeRecord, LoopEdge, Match, SparseMap
from segfloor_ros.core.slam.thresholds import PROOF
from segfloor_ros.core.slam.tracking.images import Features
from segfloor_ros.core.slam.tracking.map_tracking import Pixels
from segfloor_ros.core.slam.tracking.pose import CONVERGED
from segfloor_ros.core.slam.tracking.track import Track

STEPS = 20

TIMES_SURE = 2
"""Where nothing limits where a place can be, so many times the evidence of a loop is asked for:
walls with the same paper, and shelves that stand twice in a building, are taken for one now and
then."""

OFFSET = 'disparity_offset'
"""What a map knows of the disparity offset, by name."""


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
    new = [_edge(sparse_map, match) for match in matches]
    loops = [*sparse_map.loops, *new]
    T_loops = np.stack([loop.T_i_j for loop in loops])
    of_links = np.tile(np.repeat(LINK_SIGMA, 3), (len(i), 1))
    sigma = np.concatenate([of_links, [loop.sigma for loop in loops]])
    fixed = np.zeros(len(keyframes), bool)
    fixed[0] = True
    graph = PoseGraph(
        poses,
        fixed,
        np.append(i, [loop.i for loop in loops]).astype(np.intp),
        np.append(j, [loop.j for loop in loops]).astype(np.intp),
        np.concatenate([poses[i] @ invert(poses[j]), T_loops]),
        sigma,
        # What is new is expected to pull; what was found before must go on to fit.
        (np.arange(len(sigma)) >= len(i)) & (np.arange(len(sigma)) < len(sigma) - len(new)),
    )
    return Closing(matches, new, graph)


def _edge(sparse_map: SparseMap, match: Match) -> LoopEdge:
    place = sparse_map.keyframes[match.place]
    T_i_j = match.T_camera_world @ place.T_world_camera
    return LoopEdge(match.keyframe, match.place, T_i_j, by_floor=len(match.rows) == 0)


def solve_closing(closing: Closing) -> tuple[Array, Array]:
    """Optimise the copy; safe on another thread."""
    return optimise(closing.graph)


def apply_closing(sparse_map: SparseMap, closing: Closing, result: tuple[Array, Array]) -> bool:
    """Bring a closed loop into the map, which has had no new keyframe since. False, and nothing
    moves, where the loop contradicts the rest of the map: it switches an earlier one off that was
    on so far.
    """
    poses, weight = result
    graph, least = closing.graph, _robust_share(chi2_limit(6)) ** 2
    so_far, _ = _robust(graph, _errors(graph, graph.T_camera_world), graph.T_camera_world)
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
    may be wrong. fixed: (K,) which cameras stay.
    """

    T_camera_world: Array
    fixed: NDArray[np.bool_]
    i: NDArray[np.intp]
    j: NDArray[np.intp]
    T_i_j: Array
    sigma: Array
    is_robust: NDArray[np.bool_]


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
        if not trial_cost <= cost:  # nor where it is no number
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
    share = _robust_share(chi2)
    weight = np.where(graph.is_robust, share**2, 1.0)
    cost = float(np.where(graph.is_robust, share * chi2, chi2).sum())
    return weight, cost


def _robust_share(chi2: Array | float) -> Array:
    """Return the root (...) of the weight of edges with a squared error."""
    return np.asarray(chi2_limit(6) / (chi2_limit(6) + chi2))


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
    moving = np.flatnonzero(np.repeat(~graph.fixed, 6))
    J = J[:, moving]
    H = (J.T @ J).tocsc()
    diagonal = H.diagonal()
    g = J.T @ residual
    step = np.zeros(6 * count)
    added = (damping * diagonal + 1e-12)[None]
    damped = H + sparse.dia_array((added, [0]), shape=H.shape).tocsc()
    step[moving] = -solve_symmetric(damped.tocsc(), g)
    return step.reshape(-1, 6)


class KnownMap:
    """The known map, beside the drive's own. of_drive: whether this drive made it, and got lost."""

    def __init__(self, own: SparseMap, arrays: Arrays, of_drive: bool) -> None:
        self._own = own
        self.of_drive = of_drive
        self._map = SparseMap(own.rig)
        fill_map(self._map, arrays)
        self._places = PlaceRecognition(self._map)
        self._places.from_arrays(arrays)
        self._relocaliser = Relocaliser(self._map, self._places)
        self._matcher = PlaceMatcher(own, self._map, self._places, TIMES_SURE * PROOF)
        self._floors = FloorIndex(self._map.keyframes)

    @property
    def num_keyframes(self) -> int:
        """How large the known map is."""
        return len(self._map.keyframes)

    def recognise(self, keyframe: KeyframeRecord, images: Pixels) -> bool:
        """Whether enough keyframes in a row see the known map, this one the last of them. One whose
        floor is seen elsewhere than its look says nothing: shelves and pictures are all over a
        building, and so are floors.
        """
        anywhere = np.ones(len(self._map.keyframes), bool)
        by_look = self._matcher.look(keyframe, images, anywhere, ~anywhere)
        by_floor = self._matcher.look_at_floor(keyframe, self._floors.like(keyframe.ground))
        match = by_look or by_floor
        is_possible = match is not None and self._is_possible(keyframe, match)
        if by_look and by_floor and not self._matcher.agree(by_look, by_floor):
            is_possible = False
        return self._matcher.add(match if is_possible else None)

    def _is_possible(self, keyframe: KeyframeRecord, match: Match) -> bool:
        if self.of_drive and not self._matcher.is_within_reach(match):
            return False
        return not self._matcher.objection(keyframe, match)

    def find(
        self, images: Pixels, features: Features, stamp_ns: int
    ) -> tuple[Track | None, dict[int, Track]]:
        """Return a frame with its pose in the known map, once several in a row were found there,
        and those, by stamp.
        """
        found = self._relocaliser.find(images, features, stamp_ns)
        return found, self._relocaliser.take_proof()

    def _own_ids(self, match: Match) -> NDArray[np.int32]:
        """Return the stable ids (N,) that the points of a match have in the drive's own map, -1
        where it has none.
        """
        keyframe = self._own.keyframes[match.keyframe]
        own = np.full(len(match.rows), NO_POINT, np.int32)
        if not keyframe.is_thin:
            own = keyframe.point_id[match.rows]
        return np.where(own != NO_POINT, self._own.stable_id[own], np.int32(NO_POINT))

    def merge(self, own_words: Arrays) -> Arrays:
        """Merge the drive's own map into the known one, with the same ids and stamps. Returns the
        words of all keyframes.
        """
        matches = self._matcher.matches
        latest, own_ids = matches[-1], [self._own_ids(match) for match in matches]
        T_known_own = invert(drift(self._own, latest))
        before = len(self._map.keyframes)
        arrays = moved(map_to_arrays(self._own), T_known_own)
        known = self.to_arrays()
        self.restore(known)
        fill_map(self._own, arrays)
        for match, ids in zip(matches, own_ids, strict=True):
            edge = _edge(self._own, match)
            self._own.loops.append(replace(edge, i=before + match.keyframe))
            merge_pairs(self._own, self._rows(ids), self._rows(match.stable_ids))
        fuse_latest(self._own, before + latest.keyframe)
        return {name: np.concatenate([known[name], own_words[name]]) for name in own_words}

    def to_arrays(self) -> Arrays:
        """Return the known map and the words of its keyframes."""
        return map_to_arrays(self._map) | self._places.to_arrays()

    def restore(self, known: Arrays) -> None:
        """Put the known map, as `to_arrays` returns it, in the place of the drive's own."""
        self._own.reset()
        fill_map(self._own, known)

    def _rows(self, stable_ids: NDArray[np.int32]) -> NDArray[np.intp]:
        """Return the rows (N,) of points in the merged map, -1 for those that are gone."""
        rows = np.searchsorted(self._own.stable_id, stable_ids)
        rows = np.minimum(rows, len(self._own.stable_id) - 1)
        there = (self._own.stable_id[rows] == stable_ids) & self._own.alive[rows]
        return np.where(there, rows, -1)


def merge_slam(first: Arrays, second: Arrays, rig: Rig) -> Arrays | None:
    """Return two maps as one; None where no place of the first is seen in the second. rig: of the
    first, and of the second as the rig of the first would have measured it (`as_seen_by`), with ids
    and stamps that come after those of the first.
    """
    rig.offset.estimate = OffsetEstimate(*first[OFFSET].tolist())
    merged = SparseMap(rig)
    fill_map(merged, second)
    known = KnownMap(merged, first, of_drive=False)
    alive = [keyframe for keyframe in merged.keyframes if keyframe.retired is None]
    if not any(known.recognise(keyframe, keyframe.observations.exact()) for keyframe in alive):
        return None
    words = known.merge({name: second[name] for name in ('words', 'word_count')})
    places = PlaceRecognition(merged)
    places.from_arrays(words)
    _close_loops(merged, places, len(first['keyframe_stamp_ns']))
    return map_to_arrays(merged) | places.to_arrays() | {OFFSET: first[OFFSET]}


def _close_loops(merged: SparseMap, places: PlaceRecognition, begin: int) -> None:
    """Close the loops that keyframes from index `begin` on see, and adjust the whole map."""
    loops = LoopDetector(merged, places)
    for keyframe in merged.keyframes[begin:]:
        if keyframe.retired is not None:
            continue
        matches = loops.detect(keyframe, keyframe.observations.exact())
        if matches:
            closing = plan_closing(merged, matches)
            apply_closing(merged, closing, solve_closing(closing))
    copied = copy_map(merged, merged.rig.offset.estimate, None)
    apply_global(merged, solve_global(merged.rig.camera, copied, lambda: True))


def as_seen_by(camera: StereoCamera, offset_px: float, own: StereoCamera, arrays: Arrays) -> Arrays:
    """Return a map, made with camera `own`, as another rectified one would have measured it, whose
    disparities have an offset.
    """
    zoom = np.array([camera.fx / own.fx, camera.fy / own.fy, 1.0])
    zoom[2] = camera.disparity_times_depth / own.disparity_times_depth
    before = np.array([own.cx, own.cy, float(arrays[OFFSET][0])])
    now = np.array([camera.cx, camera.cy, offset_px])
    uvd_px = (arrays['feature_uvd_px'].astype(np.float64) - before) * zoom + now
    return arrays | {
        'feature_uvd_px': uvd_px.astype(np.float32),
        'feature_sigma_px': (arrays['feature_sigma_px'] * zoom).astype(np.float16),
    }
