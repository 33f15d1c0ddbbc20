"""The local map: the part of the map that a frame is tracked against, and whether it is enough."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import StereoCamera
from segfloor_ros.geometry import Array, invert, transform_points
from segfloor_ros.slam.map.residuals import MIN_DEPTH_M
from segfloor_ros.slam.map.sparse_map import SparseMap
from segfloor_ros.slam.mapping.keyframe_policy import SEEN_BY_SEVERAL, View, is_keyframe, novelty
from segfloor_ros.slam.places.known_views import view_novelty, views_near
from segfloor_ros.slam.results import NO_POINT, Track
from segfloor_ros.slam.settings import StereoSlamSettings

COVISIBLE_KEYFRAMES = 20
PLACE_KEYFRAMES = 10
"""Keyframes of the local map that belong to it by where they are."""


class LocalMap:
    """Chooses points around a view (Mur-Artal et al., ORB-SLAM, 2015, section V-D)."""

    def __init__(
        self, camera: StereoCamera, settings: StereoSlamSettings, sparse_map: SparseMap
    ) -> None:
        self.point_ids: NDArray[np.int32] = np.zeros(0, np.int32)
        self._camera = camera
        self._settings = settings
        self._map = sparse_map
        self._depth_m = MIN_DEPTH_M

    def move_to(self, ids: NDArray[np.int32], T_camera_world: Array) -> None:
        """Take the points around a camera that sees points `ids` (N,)."""
        self.point_ids = self.points_around(ids, T_camera_world)

    def points_around(self, ids: NDArray[np.int32], T_camera_world: Array) -> NDArray[np.int32]:
        """Return the points of keyframes that share points `ids` (N,) with a view, or stand where
        it is.
        """
        order, _ = self._map.covisible(ids)
        depth_m = self._median_depth(ids, T_camera_world)
        here = views_near(self._map, T_camera_world, depth_m, PLACE_KEYFRAMES)
        local = self._map.points_of(np.append(order[:COVISIBLE_KEYFRAMES], here))
        # The oldest first: of two points that fit a feature equally well it is the one to keep.
        return local[np.argsort(self._map.stable_id[local])]

    def drop_dead(self) -> None:
        """Forget points that are not part of the map any more."""
        self.point_ids = self.point_ids[self._map.alive[self.point_ids]]

    def wants_keyframe(self, track: Track, frames_since: int, mapper_idle: bool) -> bool:
        """Whether a frame shows enough that is new. frames_since: since the last keyframe."""
        order, _ = self._map.covisible(track.point_ids)
        reference = self._map.keyframes[order[0]]
        known = reference.point_id[reference.point_id != NO_POINT]
        reliable = known[self._map.observer_count[known] >= SEEN_BY_SEVERAL]
        depth_m = self._median_depth(reliable if len(reliable) else known, track.T_camera_world)
        novelty = view_novelty(
            self._camera, self._settings, self._map, track.point_ids, track.T_camera_world, depth_m
        )
        num_reliable = min(len(reliable), self._settings.tracked_points)
        found = len(track.point_ids)
        share = found / max(1, len(track.visible_ids))
        view = View(frames_since, found, num_reliable, novelty, mapper_idle, share)
        return is_keyframe(view, self._settings)

    def is_new_view(self, T_camera_world: Array) -> bool:
        """Whether a camera that sees no point has come to where the last keyframe was not."""
        T_last_now = self._map.keyframes[-1].T_camera_world @ invert(T_camera_world)
        return novelty(T_last_now, self._depth_m, self._settings) > 1

    def _median_depth(self, ids: NDArray[np.int32], T_camera_world: Array) -> float:
        """Return the depth of points `ids` (N,); without any, that of those seen last."""
        if len(ids):
            depth = transform_points(T_camera_world, self._map.xyz_world[ids])[:, 2]
            self._depth_m = max(float(np.median(depth)), MIN_DEPTH_M)
        return self._depth_m
