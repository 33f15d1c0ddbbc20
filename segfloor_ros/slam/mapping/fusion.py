"""Duplicates: one landmark that became two points, because it was not recognised in between.

Whatever a new keyframe should see at the same pixel and depth, and that looks the same, is one
point (Mur-Artal et al., ORB-SLAM, IEEE T-RO 2015, section VI-C). The older one survives, so that
ids stay stable.

Redundant keyframes: views of what others have seen as well, so that memory follows the space
covered (Mur-Artal et al., ORB-SLAM, IEEE T-RO 2015, section VI-E).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.slam.map.records import KeyframeRecord
from segfloor_ros.slam.map.sparse_map import SparseMap
from segfloor_ros.slam.results import NO_POINT
from segfloor_ros.slam.rig import NEIGHBOURS
from segfloor_ros.slam.tracking.features import MAX_HAMMING, hamming, one_to_one
from segfloor_ros.slam.tracking.map_tracking import predict_points

MAX_APART_PX = 2.0
"""Distance of two projections, in u, v and disparity, of what may be one point."""

MAX_OCTAVES_APART = 2.5
CANDIDATES = 4

Pairs = tuple[NDArray[np.int32], NDArray[np.int32]]

OTHERS = 3
REDUNDANT_SHARE = 0.9
LATEST_KEPT = 3
"""The latest keyframes are what tracking and the policy lean on."""


def fuse_duplicates(
    camera: StereoCamera,
    sparse_map: SparseMap,
    keyframe: KeyframeRecord,
) -> int:
    """Merge points of a new keyframe with those of its neighbours; return how many merged."""
    a, b = find_duplicates(camera, sparse_map, keyframe)
    separate = ~sparse_map.seen_together(a, b)
    a, b = a[separate], b[separate]
    older = sparse_map.stable_id[a] < sparse_map.stable_id[b]
    sparse_map.merge(np.where(older, a, b), np.where(older, b, a))
    return len(a)


def find_duplicates(
    camera: StereoCamera,
    sparse_map: SparseMap,
    keyframe: KeyframeRecord,
) -> Pairs:
    """Return pairs of point rows (N,), (N,): of the keyframe, and of its neighbours alone. Each
    point occurs at most once.
    """
    own = np.unique(keyframe.point_id[keyframe.point_id != NO_POINT])
    order, _ = sparse_map.covisible(own)
    around = sparse_map.points_of(order[:NEIGHBOURS])
    others = around[~np.isin(around, own)]
    pose = keyframe.T_camera_world
    here = predict_points(camera, sparse_map, own, pose)
    there = predict_points(camera, sparse_map, others, pose)
    if len(here.ids) == 0 or len(there.ids) == 0:
        return np.zeros(0, np.int32), np.zeros(0, np.int32)
    neighbours = [k + 1 for k in range(min(CANDIDATES, len(here.ids)))]
    reach, near = cKDTree(here.uvd_px).query(
        there.uvd_px, neighbours, distance_upper_bound=MAX_APART_PX
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
    last = len(sparse_map.keyframes) - LATEST_KEPT
    for index in sorted(int(k) for k in candidates if 0 < k < last):
        keyframe = sparse_map.keyframes[index]
        if keyframe.retired is None and redundant_share(sparse_map, keyframe) >= REDUNDANT_SHARE:
            order, _ = sparse_map.covisible(keyframe.point_id[keyframe.point_id != NO_POINT])
            reference = order[order != index][0]
            sparse_map.retire(keyframe, sparse_map.keyframes[reference])


def redundant_share(sparse_map: SparseMap, keyframe: KeyframeRecord) -> float:
    """Return the share of a keyframe's points that at least `OTHERS` other keyframes see at the
    same pyramid level or a finer one.
    """
    rows = np.flatnonzero(keyframe.point_id != NO_POINT)
    enough = sparse_map.observer_count[keyframe.point_id[rows]] > OTHERS
    if not len(rows) or enough.mean() < REDUNDANT_SHARE:
        return float(enough.mean()) if len(rows) else 0.0
    rows = rows[np.argsort(keyframe.point_id[rows])]
    ids = keyframe.point_id[rows]
    edge_point, edge_keyframe, edge_row = sparse_map.edges_of(ids)
    octave = np.empty(len(edge_row))
    for k in np.unique(edge_keyframe):
        mine = edge_keyframe == k
        octave[mine] = sparse_map.keyframes[k].features.octave[edge_row[mine]]
    slot = np.searchsorted(ids, edge_point)
    own_octave = keyframe.features.octave[rows].astype(np.float64)
    # A level further counts as the same: corners jump between neighbouring levels.
    as_fine = (edge_keyframe != keyframe.index) & (octave <= own_octave[slot] + 1)
    return float((np.bincount(slot[as_fine], minlength=len(ids)) >= OTHERS).mean())
