"""The search for what moves, frame after frame: its region, its points and what it left behind."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import Mount, StereoCamera, StereoFrame
from segfloor_ros.geometry import Array, transform_points
from segfloor_ros.slam.excluded import Region
from segfloor_ros.slam.moving_points import Look, MovingPointMeter
from segfloor_ros.slam.moving_regions import MovingRegions
from segfloor_ros.slam.results import MovingPoints
from segfloor_ros.slam.small_camera import Disparity
from segfloor_ros.slam.sparse_map import KeyframeRecord, SparseMap

SEARCH_EVERY = 3
"""Frames between two searches where no keyframe asks for one, e.g. while the robot stands."""


@dataclass(frozen=True)
class Searched:
    """What a search found. disparity: (h, w) of the shrunk image. region: what moves, None for
    nothing. points: of what moves, in the world.
    """

    disparity: Disparity
    region: Region | None
    points: MovingPoints


class MotionSearch:
    """Searches keyframes, and some of the frames between, for what moves."""

    def __init__(self, camera: StereoCamera) -> None:
        self._regions = MovingRegions(camera)
        self._meter = MovingPointMeter()
        self._frames_since = 0

    def is_due(self, is_keyframe: bool, is_tracked: bool) -> bool:
        """Whether to search a frame."""
        self._frames_since += 1
        return is_keyframe or (is_tracked and self._frames_since >= SEARCH_EVERY)

    def search(
        self,
        frame: StereoFrame,
        T_camera_world: Array,
        T_odom_camera: Array,
        mount: Mount | None,
    ) -> Searched:
        """Find what moves in a frame whose pose is known."""
        self._frames_since = 0
        scene = self._regions.search(frame, T_camera_world, T_odom_camera, mount)
        xyz_world = self._regions.positions(scene.disparity, T_camera_world)
        points = self._meter.measure(Look(frame.stamp_ns, scene.left, xyz_world), scene.moving)
        return Searched(scene.disparity, self._regions.enlarged(scene.moving), points)

    def remember(self, keyframe: KeyframeRecord, searched: Searched) -> None:
        """Compare later frames with this keyframe."""
        self._regions.remember(keyframe, searched.disparity)

    def seen_through(
        self,
        searched: Searched,
        sparse_map: SparseMap,
        ids: NDArray[np.int32],
        keyframe: KeyframeRecord,
    ) -> NDArray[np.int32]:
        """Return those of the points (N,) that a keyframe does not observe but sees through."""
        ids = np.setdiff1d(ids, keyframe.point_id)
        points = transform_points(keyframe.T_camera_world, sparse_map.xyz_world[ids])
        return ids[self._regions.seen_through(searched.disparity, points)]
