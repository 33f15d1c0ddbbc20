"""Results of SLAM on their way out: held back, changed, and turned into ROS frames.

Tracking and mapping work in optical axes from the first camera pose. Frame `map` lies on the
floor, so it is known only when the mount is, and a submap is in it only once it is merged: until
then results are held back.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from segfloor_ros.core.contracts import (
    UNKNOWN_COVARIANCE,
    FrameResult,
    Keyframe,
    Mount,
    MovingPoints,
)
from segfloor_ros.core.geometry import Array, invert, transform_points
from segfloor_ros.core.slam.rig import Rig
from segfloor_ros.core.slam.thresholds import SEARCHED_FRAMES
from segfloor_ros.core.slam.tracking.track import Track
from segfloor_ros.core.twists import adjoint

NOT_RECOGNISED = 'mapped, but no place of the map was recognised'
NOTHING_SEEN = 'too few known points in view'

MAX_HELD_KEYFRAMES = 50
"""Keyframes that wait with their images; of more, every second one goes without."""


def recognised(result: FrameResult, track: Track, T_world_odom: Array) -> FrameResult:
    """Return the outcome, in optical axes, of a frame that was lost but saw the place where the
    camera was found soon after. T_world_odom: (4, 4), the correction since.
    """
    return replace(
        result,
        tracked=True,
        T_odom_base=invert(track.T_camera_world @ T_world_odom),
        T_map_odom=T_world_odom,
        covariance=track.covariance,
        num_matches=len(track.point_ids),
        state='tracking: the place was recognised by later frames',
    )


def left_out(result: FrameResult) -> FrameResult:
    """Return what is left of a frame of a submap that was not recognised in the map by the end, or
    of a map that a larger submap was not recognised in.
    """
    return replace(
        result,
        tracked=False,
        covariance=np.eye(6) * UNKNOWN_COVARIANCE,
        state=f'lost: {NOT_RECOGNISED}',
        keyframe=None,
        moving=None,
        blind=False,
        in_submap=result.in_submap or result.tracked,
    )


def turned(points: MovingPoints, T: Array) -> MovingPoints:
    """Return points and velocities in another frame, T (4, 4)."""
    return MovingPoints(
        transform_points(T, points.xyz_map).astype(np.float32),
        (points.velocity_m_s @ T[:3, :3].T).astype(np.float32),
    )


class HeldResults:
    """Holds results in optical axes back, then turns all of them into ROS frames."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._held: list[FrameResult] = []
        self._released: list[FrameResult] = []
        self._lost: list[FrameResult] = []
        self._keeps = False

    @property
    def is_empty(self) -> bool:
        """Whether nothing is held back."""
        return not self._held

    def take(self, result: FrameResult) -> list[FrameResult]:
        """Take in the next result and return what is ready: nothing while it is of a submap."""
        self._held.append(result)
        self._lost = [] if result.tracked else [*self._lost[-SEARCHED_FRAMES:], result]
        self._thin_out()
        return [] if result.in_submap else self.release()

    def change(self, change: Callable[[FrameResult], FrameResult]) -> None:
        """Change the results that are held; those that are lost then may be recognised later."""
        self._held = [change(result) for result in self._held]
        self._lost = [result for result in self._held if not result.tracked][-SEARCHED_FRAMES:]

    def recognise(self, proof: Mapping[int, Track], T_world_odom: Array) -> None:
        """Release the frames once more that were lost when the camera was looked for, from the
        first on that saw the place where it was found. proof: those that did, by stamp.
        T_world_odom: (4, 4), the correction since.
        """
        if not proof:
            return
        again = [
            recognised(result, proof[result.stamp_ns], T_world_odom)
            if result.stamp_ns in proof
            else result
            for result in self._lost
            if result.stamp_ns >= min(proof)
        ]
        if again:
            self._held = [*_before(self._held, again[0]), *again]
            self._released = _before(self._released, again[0])

    def release(self) -> list[FrameResult]:
        """Return the results in ROS frames, oldest first; none while the mount is unknown."""
        mount = self._rig.base_mount
        if mount is None:
            return []
        ready, self._held = self._held, []
        self._released += ready if self._keeps else []
        return [in_map(held, mount.T_base_left) for held in ready]

    def keep(self, keeps: bool) -> None:
        """Keep what is released from now on, as long as the mount may turn out to be another."""
        self._keeps = keeps
        if not keeps:
            self._released.clear()

    def take_back(self) -> None:
        """Hold all results back again: they are released once more, the first ones first."""
        self._held, self._released = [*self._released, *self._held], []

    def newest(self, mount: Mount) -> FrameResult | None:
        """Return the pose of the newest result that is held, as seen from a mount."""
        if not self._held:
            return None
        return in_map(replace(self._held[-1], keyframe=None, moving=None), mount.T_base_left)

    def _thin_out(self) -> None:
        """Keep the images of so many keyframes only: a camera that never sees the floor must not
        fill the memory. The poses of all frames are kept.
        """
        for kept in (self._held, self._released):
            holders = [i for i, held in enumerate(kept) if held.keyframe is not None]
            for i in holders[1::2] if len(holders) > MAX_HELD_KEYFRAMES else []:
                kept[i] = replace(kept[i], keyframe=None)


def _before(results: list[FrameResult], first: FrameResult) -> list[FrameResult]:
    return [result for result in results if result.index < first.index]


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
    A = np.kron(np.eye(2), T_odom_base[:3, :3]) @ adjoint(T_base_left)
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
