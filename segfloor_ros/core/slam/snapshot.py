"""The map as it is at a keyframe, copied for the next stages."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from segfloor_ros.core.camera.pixels import Region
from segfloor_ros.core.contracts import (
    NO_POINT,
    Keyframe,
    KeyframeFeatures,
    KeyframePath,
    SparseCloud,
    StereoFrame,
)
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.slam.sparse_map import KeyframeRecord, SparseMap


def take_snapshot(
    sparse_map: SparseMap,
    keyframe: KeyframeRecord,
    frame: StereoFrame,
    moving: Region | None,
    uv_px: Array,
) -> Keyframe:
    """Copy the map as it is at a keyframe made of `frame`, in optical axes: the camera stands for
    the base and frame `world` for `map` until `in_map` turns them. uv_px: (F, 2), where the image
    shows its features, which keyframes have freed of the readout.
    """
    point_id = keyframe.point_id.copy()
    xyz = np.full((len(point_id), 3), np.nan)
    known = point_id != NO_POINT
    xyz[known] = sparse_map.xyz_world[point_id[known]]
    point_id[known] = sparse_map.stable_id[point_id[known]]
    features = KeyframeFeatures(uv_px.astype(np.float32), point_id, xyz)
    shown = frame.stamp_ns, frame.index, keyframe.T_world_camera, frame.left, frame.right
    path, cloud = path_of(sparse_map.keyframes), cloud_of(sparse_map)
    offset_px2 = np.linalg.inv(sparse_map.rig.offset.estimate.information)
    return Keyframe(*shown, features, path, cloud, moving, offset_px2)


def path_of(keyframes: Sequence[KeyframeRecord]) -> KeyframePath:
    """Return the poses of keyframes."""
    stamp_ns = np.array([k.stamp_ns for k in keyframes], np.int64)
    return KeyframePath(stamp_ns, np.stack([k.T_world_camera for k in keyframes]))


def cloud_of(sparse_map: SparseMap) -> SparseCloud:
    """Return all points of a map."""
    alive = np.flatnonzero(sparse_map.alive)
    alive = alive[np.argsort(sparse_map.stable_id[alive])]
    return SparseCloud(sparse_map.stable_id[alive], sparse_map.xyz_world[alive])
