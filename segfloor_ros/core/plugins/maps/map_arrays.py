"""A sparse map as arrays, and back.

Features that show no point are left out, and so are the motions that sensors measured; nothing is
lost that tracking, relocalisation or the closing of loops need.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.contracts import NO_POINT
from segfloor_ros.core.files.arrays import Arrays, check_lengths, joined, split
from segfloor_ros.core.geometry import Array, invert, transform_points
from segfloor_ros.core.slam.rig import Observations
from segfloor_ros.core.slam.sparse_map import (
    COLUMNS,
    NOTHING,
    GroundView,
    KeyframeRecord,
    LoopEdge,
    PointRows,
    Retirement,
    SparseMap,
)

IN_FILE = tuple(name for name in COLUMNS if name not in ('alive', 'observer_count'))
"""Columns of points that a file holds; the others follow from the rest."""

OF_KEYFRAMES = ('born', 'seen_last')
"""Columns that hold indices of keyframes."""


def points_to_arrays(points: PointRows, rows: NDArray[np.intp]) -> Arrays:
    """Return what a file holds of some points (N,)."""
    arrays = {f'point_{name}': points[name][rows] for name in IN_FILE}
    return arrays | {'num_ever': np.array([points.num_ever])}


def add_points(points: PointRows, arrays: Arrays, first_keyframe: int) -> None:
    """Add points of a file behind those that are there, all alive; its keyframes are counted from
    first_keyframe on. Raises KeyError or ValueError for other arrays.
    """
    check_lengths({name: arrays[f'point_{name}'] for name in IN_FILE})
    rows = points.add(len(arrays['point_stable_id']))
    for name in IN_FILE:
        points[name][rows] = arrays[f'point_{name}']
    for name in OF_KEYFRAMES:
        points[name][rows] += first_keyframe
    points.num_ever = int(arrays['num_ever'][0])


def map_to_arrays(sparse_map: SparseMap) -> Arrays:
    """Return a map as arrays; points are numbered anew in the order of their ids."""
    alive = np.flatnonzero(sparse_map.alive)
    alive = alive[np.argsort(sparse_map.stable_id[alive])]
    new_row = np.full(len(sparse_map.alive) + 1, NO_POINT, np.int32)
    new_row[alive] = np.arange(len(alive), dtype=np.int32)
    keyframes = sparse_map.keyframes
    shown = [np.flatnonzero(k.point_id != NO_POINT) for k in keyframes]
    pairs = list(zip(keyframes, shown, strict=True))
    uvd, length = joined([k.observations.uvd_px[r] for k, r in pairs], np.zeros((0, 3)))
    sigma, _ = joined([k.observations.sigma_px[r] for k, r in pairs], np.zeros((0, 3)))
    octave, _ = joined([k.octave[r] for k, r in pairs], np.zeros(0, np.uint8))
    point, _ = joined([new_row[k.point_id[r]] for k, r in pairs], np.zeros(0, np.int32))
    links, link_length = joined(
        [np.array(k.links, np.int32) for k in keyframes], np.zeros(0, np.int32)
    )
    retired = [_followed(sparse_map, k) for k in keyframes]
    corners, corner_count = joined([k.ground.xy_m for k in keyframes], NOTHING.xy_m)
    looks, _ = joined([k.ground.descriptor for k in keyframes], NOTHING.descriptor)
    loops = sparse_map.loops
    return points_to_arrays(sparse_map.points, alive) | {
        'keyframe_frame_index': np.array([k.frame_index for k in keyframes], np.int64),
        'keyframe_stamp_ns': np.array([k.stamp_ns for k in keyframes], np.int64),
        'keyframe_T_camera_world': _stack([k.T_camera_world for k in keyframes]),
        'keyframe_features': length,
        'keyframe_link_count': link_length,
        'keyframe_links': links,
        'keyframe_follows': np.array([r.reference for r in retired], np.int32),
        'keyframe_T_camera_followed': _stack([r.T_camera_reference for r in retired]),
        'feature_uvd_px': uvd.astype(np.float32),
        'feature_sigma_px': sigma.astype(np.float16),
        'feature_octave': octave,
        'feature_point': point,
        'keyframe_corners': corner_count,
        'corner_xy_m': corners,
        'corner_descriptor': looks,
        'loop_ends': np.array([(e.i, e.j) for e in loops], np.int32).reshape(-1, 2),
        'loop_T_i_j': _stack([e.T_i_j for e in loops]),
        'loop_by_floor': np.array([e.by_floor for e in loops], bool),
    }


def fill_map(sparse_map: SparseMap, arrays: Arrays) -> None:
    """Add a map, whose stable ids come later, to one without gaps: an empty one, or one that was
    filled like this. Raises KeyError or ValueError for arrays that are no map.
    """
    first, first_row = len(sparse_map.keyframes), len(sparse_map.alive)
    add_points(sparse_map.points, arrays, first)
    for index, record in enumerate(_keyframes(arrays, first, first_row), first):
        if record.index != index or (record.point_id >= len(sparse_map.alive)).any():
            raise ValueError('features of points that are not there')
        sparse_map.restore(record)
    ends, T_i_j = (arrays['loop_ends'] + first).tolist(), arrays['loop_T_i_j']
    # Maps of earlier releases have loops by points alone.
    by_floor = arrays.get('loop_by_floor', np.zeros(len(ends), bool)).tolist()
    of_loops = zip(ends, T_i_j, by_floor, strict=True)
    sparse_map.loops += [LoopEdge(i, j, T, by) for (i, j), T, by in of_loops]


def moved(arrays: Arrays, T_new_old: Array) -> Arrays:
    """Return a map seen from another world frame."""
    return arrays | {
        'point_xyz_world': transform_points(T_new_old, arrays['point_xyz_world']),
        'point_viewing_direction': arrays['point_viewing_direction'] @ T_new_old[:3, :3].T,
        'keyframe_T_camera_world': arrays['keyframe_T_camera_world'] @ invert(T_new_old),
    }


def _keyframes(arrays: Arrays, first: int, first_row: int) -> list[KeyframeRecord]:
    length = arrays['keyframe_features']
    features = [arrays[f'feature_{name}'] for name in ('uvd_px', 'sigma_px', 'octave', 'point')]
    if any(array.shape[1:] != (3,) for array in features[:2]) or (features[3] < 0).any():
        raise ValueError('features that are measured nowhere, or show no point')
    uvd, sigma, octave, point = (split(array, length) for array in features)
    links = split(arrays['keyframe_links'], arrays['keyframe_link_count'])
    grounds = [NOTHING] * len(length)
    if 'keyframe_corners' in arrays:  # not in maps of earlier releases
        corners = (
            split(arrays[name], arrays['keyframe_corners'])
            for name in ('corner_xy_m', 'corner_descriptor')
        )
        grounds = [GroundView(xy_m, look) for xy_m, look in zip(*corners, strict=True)]
    records = []
    for k, stamp_ns in enumerate(arrays['keyframe_stamp_ns'].tolist()):
        follows = int(arrays['keyframe_follows'][k])
        retired = Retirement(first + follows, arrays['keyframe_T_camera_followed'][k])
        records.append(
            KeyframeRecord(
                first + k,
                int(arrays['keyframe_frame_index'][k]),
                stamp_ns,
                arrays['keyframe_T_camera_world'][k],
                None,
                octave[k],
                Observations(uvd[k], sigma[k]),
                (first_row + point[k]).astype(np.int32),
                retired=retired if follows != NO_POINT else None,
                links=tuple((first + links[k]).tolist()),
                ground=grounds[k],
            )
        )
    return records


def _followed(sparse_map: SparseMap, keyframe: KeyframeRecord) -> Retirement:
    """Return the keyframe with features that a retired one follows in the end, `NO_POINT` for one
    that is not retired.
    """
    root = keyframe
    while root.retired is not None:
        root = sparse_map.keyframes[root.retired.reference]
    if root is keyframe:
        return Retirement(NO_POINT, np.eye(4))
    return Retirement(root.index, keyframe.T_camera_world @ root.T_world_camera)


def _stack(transforms: list[Array]) -> NDArray[Any]:
    return np.array(transforms, np.float64).reshape(-1, 4, 4)
