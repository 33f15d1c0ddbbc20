"""The map at a keyframe, copied for the next stages.

Results wait here until it is known where they are in frame `map`.

Tracking and mapping work in optical axes from the first camera pose. Frame `map` lies on the
floor, so it is known only when the mount is. A camera that got lost and maps on its own does not
know it until it recognises the map.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from segfloor_ros.camera.model import Mount, StereoFrame
from segfloor_ros.geometry import Array, adjoint, invert, transform_points
from segfloor_ros.slam.map.records import KeyframeRecord
from segfloor_ros.slam.map.sparse_map import SparseMap
from segfloor_ros.slam.moving.motion_search import turned
from segfloor_ros.slam.results import (
    NO_POINT,
    FrameResult,
    Keyframe,
    KeyframeFeatures,
    KeyframePath,
    SparseCloud,
)
from segfloor_ros.slam.tracking.images import Region

MAX_HELD_KEYFRAMES = 50
"""Keyframes that wait with their images; of more, every second one goes without."""


def take_snapshot(
    sparse_map: SparseMap, keyframe: KeyframeRecord, frame: StereoFrame, moving: Region | None
) -> Keyframe:
    """Copy the map as it is at a keyframe made of `frame`, in optical axes: the camera stands for
    the base and frame `world` for `map` until `held_results.in_map` turns them.
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


class HeldResults:
    """Holds results in optical axes back, then turns all of them into ROS frames."""

    def __init__(self) -> None:
        self._held: list[FrameResult] = []

    def add(self, result: FrameResult) -> None:
        """Take in the next result."""
        self._held.append(result)
        self._thin_out()

    def change(self, change: Callable[[FrameResult], FrameResult]) -> None:
        """Change the results that are held of a submap."""
        self._held = [change(result) if result.in_submap else result for result in self._held]

    def release(self, mount: Mount | None) -> list[FrameResult]:
        """Return the results in ROS frames, oldest first; none while the mount is unknown."""
        if mount is None:
            return []
        ready, self._held = self._held, []
        return [in_map(held, mount.T_base_left) for held in ready]

    def newest(self, mount: Mount) -> FrameResult | None:
        """Return the pose of the newest result that is held, as seen from a mount."""
        if not self._held:
            return None
        return in_map(replace(self._held[-1], keyframe=None, moving=None), mount.T_base_left)

    def _thin_out(self) -> None:
        """Keep the images of so many keyframes only: a camera that never sees the floor must not
        fill the memory. The poses of all frames are kept.
        """
        holders = [i for i, held in enumerate(self._held) if held.keyframe is not None]
        for i in holders[1::2] if len(holders) > MAX_HELD_KEYFRAMES else []:
            self._held[i] = replace(self._held[i], keyframe=None)


def in_map(result: FrameResult, T_map_world: Array) -> FrameResult:
    """Turn a result in optical axes into ROS frames; `map` is the base at the first pose, so
    T_map_world = T_base_left.
    """
    T_left_base = invert(T_map_world)
    return replace(
        result,
        T_odom_base=T_map_world @ result.T_odom_base @ T_left_base,
        T_map_odom=T_map_world @ result.T_map_odom @ T_left_base,
        covariance=_covariance_of_base(result, T_map_world),
        keyframe=_keyframe_in_map(result.keyframe, T_map_world) if result.keyframe else None,
        moving=turned(result.moving, T_map_world) if result.moving else None,
    )


def _covariance_of_base(result: FrameResult, T_base_left: Array) -> Array:
    """Carry the covariance of the camera twist to the base, in odom axes."""
    T_odom_base = T_base_left @ result.T_odom_base @ invert(T_base_left)
    axes = np.zeros((6, 6))
    axes[:3, :3] = axes[3:, 3:] = T_odom_base[:3, :3]
    A = axes @ adjoint(T_base_left)
    return A @ result.covariance @ A.T


def _keyframe_in_map(keyframe: Keyframe, T_map_world: Array) -> Keyframe:
    T_left_base = invert(T_map_world)
    features, path, cloud = keyframe.features, keyframe.path, keyframe.cloud
    features_xyz, cloud_xyz = (
        transform_points(T_map_world, part.xyz_map).astype(np.float32) for part in (features, cloud)
    )
    return replace(
        keyframe,
        T_map_base=T_map_world @ keyframe.T_map_base @ T_left_base,
        features=replace(features, xyz_map=features_xyz),
        path=replace(path, T_map_base=T_map_world @ path.T_map_base @ T_left_base),
        cloud=replace(cloud, xyz_map=cloud_xyz),
    )
