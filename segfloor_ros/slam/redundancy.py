"""Redundant keyframes: views of what others have seen as well, so that memory follows the space
covered (Mur-Artal et al., ORB-SLAM, IEEE T-RO 2015, section VI-E).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.slam.keyframe_record import KeyframeRecord
from segfloor_ros.slam.results import NO_POINT
from segfloor_ros.slam.sparse_map import SparseMap

OTHERS = 3
REDUNDANT_SHARE = 0.9
LATEST_KEPT = 3
"""The latest keyframes are what tracking and the policy lean on."""


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
