"""What becomes of the results of a submap: merged, not recognised, or outside of a loaded map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from segfloor_ros.core.contracts import NO_POINT, FrameResult, SparseCloud
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.slam.held_results import NOTHING_SEEN, left_out
from segfloor_ros.core.slam.session import BEFORE_RECOGNITION, OUTSIDE_LOADED
from segfloor_ros.core.slam.snapshot import cloud_of, path_of
from segfloor_ros.core.slam.sparse_map import KeyframeRecord, SparseMap


def searched(result: FrameResult) -> FrameResult:
    """Return what is left of a frame that was searched for in a loaded map, and mapped in a submap
    that is dropped.
    """
    return replace(left_out(result), in_submap=False, state=f'lost: {NOTHING_SEEN}')


def outside(result: FrameResult) -> FrameResult:
    """Return a frame that was not found in a loaded map, as one outside of it."""
    state = result.state.replace(BEFORE_RECOGNITION, OUTSIDE_LOADED)
    return replace(result, in_submap=False, outside=result.tracked, state=state)


def in_merged_map(
    sparse_map: SparseMap, T_world_odom: Array
) -> Callable[[FrameResult], FrameResult]:
    """Return what brings a result of a submap, in optical axes, up to date, now that it is merged
    with the map. T_world_odom: (4, 4), the correction since.
    """
    return partial(_in_merged_map, sparse_map.keyframes, cloud_of(sparse_map), T_world_odom)


def _in_merged_map(
    keyframes: Sequence[KeyframeRecord],
    cloud: SparseCloud,
    T_world_odom: Array,
    result: FrameResult,
) -> FrameResult:
    keyframe = result.keyframe
    if keyframe is not None:
        path = path_of([k for k in keyframes if k.stamp_ns <= keyframe.stamp_ns])
        features = keyframe.features
        row = np.searchsorted(cloud.point_id, features.point_id)
        row = np.minimum(row, len(cloud.point_id) - 1)
        there = cloud.point_id[row] == features.point_id
        xyz = np.where(there[:, None], cloud.xyz_map[row], np.nan)
        ids = np.where(there, features.point_id, np.int32(NO_POINT))
        keyframe = replace(
            keyframe,
            T_map_base=path.T_map_base[-1],
            features=replace(features, point_id=ids, xyz_map=xyz),
            path=path,
            cloud=cloud,
        )
    return replace(result, T_map_odom=T_world_odom, keyframe=keyframe)
