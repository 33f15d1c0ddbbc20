"""Mapping: what happens when a frame becomes a keyframe.

Whatever it should see at the same pixel and depth as a neighbour, and that looks the same, is one
point: the older one. Keyframes that show what others have seen as well are retired, so that memory
follows the space covered (Mur-Artal et al., ORB-SLAM, IEEE T-RO 2015, sections VI-C and VI-E).

A first guess of the disparity everywhere, to two pixels: block matching of shrunken images
(Konolige, Small Vision Systems, ISRR 1997, as in OpenCV).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from segfloor_ros.core.contracts import NO_POINT, StereoFrame, Up
from segfloor_ros.core.geometry import Array, invert, transform_points
from segfloor_ros.core.slam.mapping.bundle_adjustment import (
    BundleProblem,
    BundleResult,
    adjust,
    gather,
)
from segfloor_ros.core.slam.mapping.normal_equations import factors_of, motion_before
from segfloor_ros.core.slam.rig import LOCAL_KEYFRAMES, NEIGHBOURS, SHOWN_EVERY
from segfloor_ros.core.slam.sparse_map import KeyframeRecord, SparseMap
from segfloor_ros.core.slam.thresholds import CHANCE_SHARE, ENOUGH, MAJORITY, NEARLY_ALL, PROOF
from segfloor_ros.core.slam.tracking.images import MAX_HAMMING, Images, hamming, one_to_one
from segfloor_ros.core.slam.tracking.map_tracking import predict_points
from segfloor_ros.core.slam.tracking.patch_alignment import ALIGNED_PX, measure_disparities
from segfloor_ros.core.slam.tracking.track import ObservedFeatures
from segfloor_ros.core.timing import timed

MIN_DISPARITY_PX = 1.0
"""Less is known too badly, as a share of it, for a new point."""

SETTLING_KEYFRAMES = 2
"""Within so many keyframes others must see a new point too (Mur-Artal et al., ORB-SLAM, 2015,
section VI-B)."""

MAX_OCTAVES_APART, CANDIDATES = 2.5, 4
"""Levels of the pyramid between two views of what may be one point, and points tried for each."""

Pairs = tuple[NDArray[np.int32], NDArray[np.int32]]


@dataclass(frozen=True)
class Adjustment:
    """A local bundle adjustment and where its unknowns belong.

    newest: index of the keyframe that caused it. free: (K,) indices of the keyframes that move.
    ids: (P,) of the points. edge_keyframe, edge_row: (N,) of the observations. carried_ids,
    carried_keyframe: (C,) points that one keyframe alone sees, which say nothing about poses and
    move along with it.
    """

    newest: int
    problem: BundleProblem
    free: NDArray[np.intp]
    ids: NDArray[np.int32]
    edge_keyframe: NDArray[np.int32]
    edge_row: NDArray[np.int32]
    carried_ids: NDArray[np.int32]
    carried_keyframe: NDArray[np.int32]


class LocalMapper:
    """Adds keyframes and their points to the map and adjusts the neighbourhood."""

    def __init__(self, sparse_map: SparseMap) -> None:
        self._map = sparse_map
        self._rig = sparse_map.rig
        self._camera = sparse_map.rig.camera

    @timed
    def measure_stereo(
        self, frame: StereoFrame, images: Images, observed: ObservedFeatures
    ) -> None:
        """Add a disparity, in place, to every feature that is found in the right image and shows no
        point of the map: that of a point was looked for where it should be, and what is elsewhere
        is something else, which hides the point from one eye.
        """
        observations = observed.observations
        missing = np.flatnonzero(
            np.isnan(observations.uvd_px[:, 2]) & (observed.point_id == NO_POINT)
        )
        measure_disparities(frame, images, observations, missing)

    @timed
    def insert(self, keyframe: KeyframeRecord, patches: NDArray[np.uint8]) -> None:
        """Add a keyframe and new points from its stereo features; points that turn out to be known
        are fused with the older ones.
        """
        rows, points = self._new_points(keyframe)
        self._map.add_keyframe(keyframe, patches, rows, points)
        fuse_duplicates(self._map, keyframe)
        keyframe.links = self._links(keyframe)

    def _links(self, keyframe: KeyframeRecord) -> tuple[int, ...]:
        """Return the earlier keyframes that share most points with a new one; the one before it
        where none does.
        """
        own = keyframe.seen_ids
        order, shared = self._map.covisible(own)
        enough = max(ENOUGH, CHANCE_SHARE * len(own))
        near = order[(shared >= enough) & (order != keyframe.index)]
        before = [keyframe.index - 1] if keyframe.index > 0 else []
        return tuple(int(k) for k in (near[:LOCAL_KEYFRAMES] if len(near) else before))

    def _new_points(self, keyframe: KeyframeRecord) -> tuple[NDArray[np.intp], Array]:
        """Return features (N,) that are measured but belong to no point yet, and where they are."""
        uvd = keyframe.observations.uvd_px
        disparity = np.nan_to_num(uvd[:, 2] - self._rig.offset.at(uvd))
        rows = np.flatnonzero((disparity >= MIN_DISPARITY_PX) & (keyframe.point_id == NO_POINT))
        depth = self._camera.disparity_times_depth / disparity[rows]
        points = self._camera.back_project(uvd[rows, :2], depth)
        return rows, transform_points(keyframe.T_world_camera, points)

    @timed
    def plan_adjustment(
        self, keyframe: KeyframeRecord, up_world: Up | None = None
    ) -> Adjustment | None:
        """Copy the neighbourhood of a keyframe, not the first one, out of the map; None where no
        two keyframes share a point. up_world: where up is, if that is known.
        """
        free, fixed = self._choose_keyframes(keyframe)
        ids = self._map.points_of(free)
        edge_point, edge_keyframe, edge_row = self._map.edges_of(ids)
        chosen = np.concatenate([free, fixed])
        slot = np.full(len(self._map.keyframes), -1)
        slot[chosen] = np.arange(len(chosen))
        taking_part = slot[edge_keyframe] >= 0
        seen_by = np.bincount(edge_point[taking_part], minlength=len(self._map.alive))
        ids = ids[seen_by[ids] > 1]
        alone = taking_part & (seen_by[edge_point] == 1)
        carried = edge_point[alone], edge_keyframe[alone]
        taking_part &= ~alone
        edge_point, edge_keyframe, edge_row = (
            edges[taking_part] for edges in (edge_point, edge_keyframe, edge_row)
        )
        if len(ids) == 0:
            return None
        taken = [k.observations for k in self._map.keyframes]
        observations = gather(taken, edge_keyframe, edge_row)
        problem = BundleProblem(
            np.stack([self._map.keyframes[k].T_camera_world for k in chosen]),
            len(free),
            self._map.xyz_world[ids],
            slot[edge_keyframe],
            np.searchsorted(ids, edge_point),
            observations.without_offset(self._rig.offset),
            factors_of(self._map.keyframes, slot, up_world),
            self._rig.offset if keyframe.index % SHOWN_EVERY == 0 else None,
        )
        return Adjustment(keyframe.index, problem, free, ids, edge_keyframe, edge_row, *carried)

    @timed
    def solve(self, adjustment: Adjustment) -> BundleResult:
        """Adjust the copy; safe on another thread, since it shares nothing with the map."""
        return adjust(self._camera, adjustment.problem)

    @timed
    def apply(self, adjustment: Adjustment, result: BundleResult) -> None:
        """Write an adjustment back to the map, which has had no new keyframe since, and cull poor
        points. One that loses what the newest keyframe saw has followed something that moves, or a
        wrong match, and is left out. A keyframe as old as the neighbourhood gets no more points.
        """
        kept = result.inliers[adjustment.edge_keyframe == adjustment.newest]
        if len(kept) and kept.mean() < MAJORITY:
            return
        if result.offset is not None:
            self._rig.offset.learn(result.offset)
        self._write_back(adjustment, result)
        outliers = ~result.inliers
        self._map.unlink(adjustment.edge_keyframe[outliers], adjustment.edge_row[outliers])
        settled = adjustment.newest - SETTLING_KEYFRAMES
        self._map.remove_points(self._map.poor_points(settled))
        retire_redundant(self._map, adjustment.free)
        if adjustment.newest >= NEIGHBOURS:
            self._map.thin_out(self._map.keyframes[adjustment.newest - NEIGHBOURS])
        self._map.follow()

    def _choose_keyframes(
        self, keyframe: KeyframeRecord
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the covisible keyframes that move and those that hold them; the first one
        does not move here.
        """
        own = keyframe.seen_ids
        order, shared = self._map.covisible(own)
        near = order[(shared >= ENOUGH) & (order != keyframe.index)]
        near = np.concatenate([near, np.setdiff1d(_linked(self._map, keyframe), near)[::-1]])
        free = np.append(keyframe.index, near[: LOCAL_KEYFRAMES - 1])
        free = free[free != 0]
        around, _ = self._map.covisible(self._map.points_of(free))
        if keyframe.motion is not None:
            # What wheels tie to the oldest that moves holds it.
            before, _ = motion_before(self._map.keyframes, int(free.min()))
            around = np.append(max(before, 0), around)
        fixed = around[~np.isin(around, free)][: NEIGHBOURS - LOCAL_KEYFRAMES]
        if len(fixed) == 0:
            fixed, free = free[-1:], free[:-1]
        return free, fixed

    def _write_back(self, adjustment: Adjustment, result: BundleResult) -> None:
        self._map.xyz_world[adjustment.ids] = result.points_world
        for slot, k in enumerate(adjustment.free):
            keyframe, T_camera_world = self._map.keyframes[k], result.T_camera_world[slot].copy()
            carried = adjustment.carried_ids[adjustment.carried_keyframe == k]
            self._map.xyz_world[carried] = transform_points(
                invert(T_camera_world) @ keyframe.T_camera_world, self._map.xyz_world[carried]
            )
            keyframe.T_camera_world = T_camera_world


def _linked(sparse_map: SparseMap, keyframe: KeyframeRecord) -> NDArray[np.intp]:
    """Return the keyframes before one that wheels tie to it without a gap, the oldest first."""
    linked: list[int] = []
    while len(linked) < LOCAL_KEYFRAMES - 1:
        before, motion = motion_before(sparse_map.keyframes, (linked or [keyframe.index])[-1])
        if motion is None:
            break
        linked.append(before)
    return np.array(linked[::-1], np.intp)


def fuse_duplicates(sparse_map: SparseMap, keyframe: KeyframeRecord) -> int:
    """Merge points of a new keyframe with those of its neighbours; return how many merged."""
    return sparse_map.merge(*find_duplicates(sparse_map, keyframe))


def find_duplicates(sparse_map: SparseMap, keyframe: KeyframeRecord) -> Pairs:
    """Return pairs of point rows (N,), (N,): of the keyframe, and of its neighbours alone. Each
    point occurs at most once.
    """
    own = np.unique(keyframe.seen_ids)
    order, _ = sparse_map.covisible(own)
    around = sparse_map.points_of(order[:NEIGHBOURS])
    others = around[~np.isin(around, own)]
    pose = keyframe.T_camera_world
    here = predict_points(sparse_map, own, pose)
    there = predict_points(sparse_map, others, pose)
    if len(here.ids) == 0 or len(there.ids) == 0:
        return np.zeros(0, np.int32), np.zeros(0, np.int32)
    neighbours = [k + 1 for k in range(min(CANDIDATES, len(here.ids)))]
    reach, near = cKDTree(here.uvd_px).query(
        there.uvd_px, neighbours, distance_upper_bound=ALIGNED_PX
    )
    j, column = np.nonzero(np.isfinite(reach))
    i = np.asarray(near)[j, column]
    distance = hamming(sparse_map.descriptor[here.ids[i]], sparse_map.descriptor[there.ids[j]])
    alike = (distance <= MAX_HAMMING) & (
        np.abs(here.octave[i] - there.octave[j]) <= MAX_OCTAVES_APART
    )
    i, j = one_to_one(i[alike], j[alike], distance[alike])
    return here.ids[i], there.ids[j]


def retire_redundant(sparse_map: SparseMap, candidates: NDArray[np.integer]) -> None:
    """Retire candidates (K,) most of whose points others have seen as well, oldest first; never
    the first keyframe nor the latest.
    """
    last = len(sparse_map.keyframes) - PROOF
    for index in sorted(int(k) for k in candidates if 0 < k < last):
        keyframe = sparse_map.keyframes[index]
        if keyframe.retired is None and redundant_share(sparse_map, keyframe) >= NEARLY_ALL:
            order, _ = sparse_map.covisible(keyframe.seen_ids)
            reference = order[order != index][0]
            sparse_map.retire(keyframe, sparse_map.keyframes[reference])


def redundant_share(sparse_map: SparseMap, keyframe: KeyframeRecord) -> float:
    """Return the share of a keyframe's points that at least `PROOF` other keyframes see at the
    same pyramid level or a finer one.
    """
    rows = np.flatnonzero(keyframe.point_id != NO_POINT)
    enough = sparse_map.observer_count[keyframe.point_id[rows]] > PROOF
    if not len(rows) or enough.mean() < NEARLY_ALL:
        return float(enough.mean()) if len(rows) else 0.0
    rows = rows[np.argsort(keyframe.point_id[rows])]
    ids = keyframe.point_id[rows]
    edge_point, edge_keyframe, edge_row = sparse_map.edges_of(ids)
    octave = np.empty(len(edge_row))
    for k in np.unique(edge_keyframe):
        mine = edge_keyframe == k
        octave[mine] = sparse_map.keyframes[k].octave[edge_row[mine]]
    slot = np.searchsorted(ids, edge_point)
    own_octave = keyframe.octave[rows].astype(np.float64)
    # A level further counts as the same: corners jump between neighbouring levels.
    as_fine = (edge_keyframe != keyframe.index) & (octave <= own_octave[slot] + 1)
    return float((np.bincount(slot[as_fine], minlength=len(ids)) >= PROOF).mean())
