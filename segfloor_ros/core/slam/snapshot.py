"""The map as it is at a keyframe, copied for the next stages."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from segfloor_ros.core.camera.pixels import Region
from segfloor_ros.core.contracts import (
    NO_POINT,
    FrameResult,
    Keyframe,
    KeyframeFeatures,
    KeyframePath,
    SparseCloud,
    StereoFrame,
)
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.slam.sparse_map import KeyframeRecord, SparseMap


def take_snapshot(
    sparse_map: SparseMap, keyframe: KeyframeRecord, frame: StereoFrame, moving: Region | None
) -> Keyframe:
    """Copy the map as it is at a keyframe made of `frame`, in optical axes: the camera stands for
    the base and frame `world` for `map` until `in_map` turns them.
    """
    point_id = keyframe.point_id.copy()
    xyz = np.full((len(point_id), 3), np.nan)
    known = point_id != NO_POINT
    xyz[known] = sparse_map.xyz_world[point_id[known]]
    point_id[known] = sparse_map.stable_id[point_id[known]]
    return Keyframe(
        frame.stamp_ns,
        frame.index,
        keyframe.T_world_camera,
        frame.left,
        frame.right,
        KeyframeFeatures(keyframe.observations.uvd_px[:, :2].astype(np.float32), point_id, xyz),
        _path(sparse_map.keyframes),
        _cloud(sparse_map),
        moving,
    )


def in_merged_map(
    sparse_map: SparseMap, T_world_odom: Array
) -> Callable[[FrameResult], FrameResult]:
    """Return what brings a result of a submap, in optical axes, up to date, now that it is merged
    with the map. T_world_odom: (4, 4), the correction since.
    """
    return partial(_in_merged_map, sparse_map.keyframes, _cloud(sparse_map), T_world_odom)


def _in_merged_map(
    keyframes: Sequence[KeyframeRecord],
    cloud: SparseCloud,
    T_world_odom: Array,
    result: FrameResult,
) -> FrameResult:
    keyframe = result.keyframe
    if keyframe is not None:
        path = _path([k for k in keyframes if k.stamp_ns <= keyframe.stamp_ns])
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


def _path(keyframes: Sequence[KeyframeRecord]) -> KeyframePath:
    return KeyframePath(
        np.array([k.stamp_ns for k in keyframes], np.int64),
        np.stack([k.T_world_camera for k in keyframes]),
    )


def _cloud(sparse_map: SparseMap) -> SparseCloud:
    alive = np.flatnonzero(sparse_map.alive)
    alive = alive[np.argsort(sparse_map.stable_id[alive])]
    return SparseCloud(sparse_map.stable_id[alive], sparse_map.xyz_world[alive])
