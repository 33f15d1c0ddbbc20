"""Results wait here until it is known where they are in frame `map`.

Tracking and mapping work in optical axes from the first camera pose. Frame `map` lies on the
floor, so it is known only when the mount is. A camera that got lost and maps on its own does not
know it until it recognises the map.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from segfloor_ros.camera.model import Mount
from segfloor_ros.geometry import Array, adjoint, invert, transform_points
from segfloor_ros.slam.moving_points import turned
from segfloor_ros.slam.results import FrameResult, Keyframe

MAX_HELD_KEYFRAMES = 50
"""Keyframes that wait with their images; of more, every second one goes without."""


class HeldResults:
    """Holds results in optical axes back, then turns all of them into ROS frames."""

    def __init__(self) -> None:
        self._held: list[FrameResult] = []

    def add(self, result: FrameResult) -> None:
        """Take in the next result."""
        self._held.append(result)
        self._thin_out()

    def change(self, change: Callable[[FrameResult], FrameResult]) -> None:
        """Change the results that are held of a part of the map."""
        self._held = [change(result) if result.apart else result for result in self._held]

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
