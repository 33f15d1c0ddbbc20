"""The map at a keyframe, copied for the next stages."""

from __future__ import annotations

import numpy as np

from segfloor_ros.camera.model import StereoFrame
from segfloor_ros.slam.excluded import Region
from segfloor_ros.slam.keyframe_record import KeyframeRecord
from segfloor_ros.slam.results import (
    NO_POINT,
    Keyframe,
    KeyframeFeatures,
    KeyframePath,
    SparseCloud,
)
from segfloor_ros.slam.sparse_map import SparseMap


def take_snapshot(
    sparse_map: SparseMap, keyframe: KeyframeRecord, frame: StereoFrame, moving: Region | None
) -> Keyframe:
    """Copy the map as it is at a keyframe made of `frame`, in optical axes: the camera stands for
    the base and frame `world` for `map` until `held_results.in_map` turns them.
    """
    in_cloud = np.flatnonzero(sparse_map.alive)
    in_cloud = in_cloud[np.argsort(sparse_map.stable_id[in_cloud])]
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
        KeyframePath(
            np.array([k.stamp_ns for k in sparse_map.keyframes], np.int64),
            np.stack([k.T_world_camera for k in sparse_map.keyframes]),
        ),
        SparseCloud(sparse_map.stable_id[in_cloud], sparse_map.xyz_world[in_cloud]),
        moving,
    )
