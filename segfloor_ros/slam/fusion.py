"""Duplicates: one landmark that became two points, because it was not recognised in between.

Whatever a new keyframe should see at the same pixel and depth, and that looks the same, is one
point (Mur-Artal et al., ORB-SLAM, IEEE T-RO 2015, section VI-C). The older one survives, so that
ids stay stable.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.slam.keyframe_record import KeyframeRecord
from segfloor_ros.slam.matching import MAX_HAMMING, hamming, one_to_one
from segfloor_ros.slam.results import NO_POINT
from segfloor_ros.slam.sparse_map import SparseMap
from segfloor_ros.slam.visibility import predict_points

NEIGHBOUR_KEYFRAMES = 20
MAX_APART_PX = 2.0
"""Distance of two projections, in u, v and disparity, of what may be one point."""

MAX_OCTAVES_APART = 2.5
CANDIDATES = 4

Pairs = tuple[NDArray[np.int32], NDArray[np.int32]]


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
    around = sparse_map.points_of(order[:NEIGHBOUR_KEYFRAMES])
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
