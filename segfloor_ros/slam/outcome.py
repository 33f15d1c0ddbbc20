"""What SLAM found, in its own coordinates, and how it becomes what the next stages get.

Tracking and mapping work in optical axes from the first camera pose. Frame `map` lies on the
floor, so it is known only when the camera's mount is; outcomes wait in this form until then.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import StereoFrame
from segfloor_ros.geometry import Array, invert, skew, transform_points
from segfloor_ros.slam.results import (
    NO_POINT,
    FrameResult,
    Keyframe,
    KeyframeFeatures,
    KeyframePath,
    SparseCloud,
)
from segfloor_ros.slam.sparse_map import KeyframeRecord, SparseMap


@dataclass(frozen=True)
class MapSnapshot:
    """The map at a keyframe, in world coordinates, before the mount turns it into frame `map`."""

    T_world_camera: Array
    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    uv_px: NDArray[np.float32]
    point_id: NDArray[np.int32]
    xyz_world: Array
    path_stamp_ns: NDArray[np.int64]
    path_T_world_camera: Array
    cloud_id: NDArray[np.int32]
    cloud_xyz_world: Array


def take_snapshot(
    sparse_map: SparseMap, keyframe: KeyframeRecord, frame: StereoFrame
) -> MapSnapshot:
    """Copy the map as it is at a keyframe made of `frame`."""
    in_cloud = np.flatnonzero(sparse_map.alive)
    in_cloud = in_cloud[np.argsort(sparse_map.stable_id[in_cloud])]
    point_id = keyframe.point_id.copy()
    xyz = np.full((len(point_id), 3), np.nan)
    known = point_id != NO_POINT
    xyz[known] = sparse_map.xyz_world[point_id[known]]
    point_id[known] = sparse_map.stable_id[point_id[known]]
    return MapSnapshot(
        keyframe.T_world_camera,
        frame.left,
        frame.right,
        keyframe.observations.uvd_px[:, :2].astype(np.float32),
        point_id,
        xyz,
        np.array([k.stamp_ns for k in sparse_map.keyframes], np.int64),
        np.stack([k.T_world_camera for k in sparse_map.keyframes]),
        sparse_map.stable_id[in_cloud],
        sparse_map.xyz_world[in_cloud],
    )


@dataclass(frozen=True)
class Outcome:
    """The outcome of a frame in optical coordinates: `odom` and `world` coincide at the first
    frame.
    """

    index: int
    stamp_ns: int
    tracked: bool
    T_odom_camera: Array
    T_world_odom: Array
    covariance: Array
    num_matches: int
    state: str
    reference_ns: int
    snapshot: MapSnapshot | None


def in_map(outcome: Outcome, T_map_world: Array) -> FrameResult:
    """Turn optical coordinates into ROS frames; `map` is the base at the first pose, so
    T_map_world = T_base_left.
    """
    T_left_base = invert(T_map_world)
    return FrameResult(
        outcome.index,
        outcome.stamp_ns,
        outcome.tracked,
        T_map_world @ outcome.T_odom_camera @ T_left_base,
        T_map_world @ outcome.T_world_odom @ T_left_base,
        _covariance_of_base(outcome, T_map_world),
        outcome.num_matches,
        outcome.state,
        outcome.reference_ns,
        _keyframe_in_map(outcome, T_map_world) if outcome.snapshot else None,
    )


def _covariance_of_base(outcome: Outcome, T_base_left: Array) -> Array:
    """Carry the covariance of the camera twist to the base, in odom axes (Barfoot 2017, eq.
    7.49: adjoint).
    """
    R, t = T_base_left[:3, :3], T_base_left[:3, 3]
    adjoint = np.zeros((6, 6))
    adjoint[:3, :3] = adjoint[3:, 3:] = R
    adjoint[:3, 3:] = skew(t) @ R
    T_odom_base = T_base_left @ outcome.T_odom_camera @ invert(T_base_left)
    axes = np.zeros((6, 6))
    axes[:3, :3] = axes[3:, 3:] = T_odom_base[:3, :3]
    A = axes @ adjoint
    return A @ outcome.covariance @ A.T


def _keyframe_in_map(outcome: Outcome, T_map_world: Array) -> Keyframe:
    snapshot = outcome.snapshot
    assert snapshot is not None
    T_left_base = invert(T_map_world)
    features = KeyframeFeatures(
        snapshot.uv_px,
        snapshot.point_id,
        transform_points(T_map_world, snapshot.xyz_world).astype(np.float32),
    )
    path = KeyframePath(
        snapshot.path_stamp_ns, T_map_world @ snapshot.path_T_world_camera @ T_left_base
    )
    cloud = SparseCloud(
        snapshot.cloud_id,
        transform_points(T_map_world, snapshot.cloud_xyz_world).astype(np.float32),
    )
    return Keyframe(
        outcome.stamp_ns,
        outcome.index,
        T_map_world @ snapshot.T_world_camera @ T_left_base,
        snapshot.left,
        snapshot.right,
        features,
        path,
        cloud,
    )
