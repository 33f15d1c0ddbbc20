"""Tracking of ordinary frames: the points of the last frame are followed into this one.

Corners and descriptors are only needed where nothing is known of the motion, or where new points
are wanted. Between keyframes optical flow of some points gives the pose to a pixel, and the patches
of a spread selection of map points give the rest (Forster et al., SVO: Semidirect Visual Odometry,
ICRA 2014). The patches come from keyframes: errors do not add up from frame to frame.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array, transform_points
from segfloor_ros.slam.results import ENOUGH, Track
from segfloor_ros.slam.rig import MIN_DEPTH_M, Observations
from segfloor_ros.slam.sparse_map import SparseMap
from segfloor_ros.slam.tracking.features import spread
from segfloor_ros.slam.tracking.images import (
    SIGMA_FLOW_PX,
    Images,
    Region,
    follow_pixels,
    is_inside,
)
from segfloor_ros.slam.tracking.map_tracking import (
    TRACKED_POINTS,
    Prediction,
    align_pixels,
    predict_points,
)
from segfloor_ros.slam.tracking.patch_alignment import measure_disparity
from segfloor_ros.slam.tracking.pose import Agreement, Consensus
from segfloor_ros.timing import timed

MAX_FOLLOWED = 250


class Follower:
    """Finds the pose of a frame from the one before."""

    def __init__(self, sparse_map: SparseMap) -> None:
        self._map = sparse_map
        self._camera = sparse_map.rig.camera
        self._consensus = Consensus(sparse_map)
        self.reset()

    def reset(self) -> None:
        """Know no frame before."""
        self._small: NDArray[np.uint8] | None = None
        self._ids: NDArray[np.int32] = np.zeros(0, np.int32)
        self._uv_px: Array = np.zeros((0, 2))

    def see(self, images: Images, ids: NDArray[np.int32], uv_px: Array) -> None:
        """Take in a frame that shows map points `ids` (N,) at pixels (N, 2)."""
        self._small, self._ids, self._uv_px = images.small, ids, uv_px

    @property
    def seen_ids(self) -> NDArray[np.int32]:
        """The points (N,) of the last frame."""
        return self._ids

    def drop_inside(self, region: Region) -> None:
        """Forget the points that the last frame shows in a region."""
        outside = ~is_inside(region, self._uv_px)
        self._ids, self._uv_px = self._ids[outside], self._uv_px[outside]

    def drop_dead(self) -> None:
        """Forget points that are not part of the map any more."""
        alive = self._map.alive[self._ids]
        self._ids, self._uv_px = self._ids[alive], self._uv_px[alive]

    def follow(
        self, images: Images, local_ids: NDArray[np.int32], T_predicted: Array
    ) -> Track | None:
        """Find the pose of a frame; None where too little of the last one is found again."""
        offset_px = self._map.rig.offset.value_px
        roughly = self._by_flow(images, T_predicted)
        if roughly is None:
            return None
        pose = roughly.estimate.T_camera_world
        seen = self._select(local_ids, pose, images.excluded)
        observations = Observations(seen.uvd_px.copy(), np.ones((len(seen.ids), 3)))
        rows = np.arange(len(seen.ids))
        rows = rows[align_pixels(images.left, observations, rows, self._map, seen.ids, pose)]
        measure_disparity(images, observations, rows, seen.uvd_px[rows, 2] + offset_px)
        if len(rows) < ENOUGH:
            return None
        ids = seen.ids[rows]
        measured = observations.take(rows)
        found = self._consensus.refine(pose, ids, measured.without_offset(offset_px))
        if not found.is_believable(len(seen.ids)):
            return None
        estimate = found.estimate
        return Track(estimate, ids[estimate.inliers], measured.take(estimate.inliers), seen.ids)

    @timed
    def _by_flow(self, images: Images, T_predicted: Array) -> Agreement | None:
        """Find the pose to about a pixel from where the last frame's points went."""
        if self._small is None or len(self._ids) < ENOUGH:
            return None
        step = -(-len(self._ids) // MAX_FOLLOWED)
        ids, uv_last = self._ids[::step], self._uv_px[::step]
        points = transform_points(T_predicted, self._map.xyz_world[ids])
        front = points[:, 2] > MIN_DEPTH_M
        ids, uv_last, points = ids[front], uv_last[front], points[front]
        if len(ids) < ENOUGH:
            return None
        guess = self._camera.project(points)[:, :2]
        width = self._camera.width
        uv, found = follow_pixels(self._small, images.small, width, uv_last, guess)
        found &= ~is_inside(images.excluded, uv)
        if found.sum() < ENOUGH:
            return None
        uvd = np.column_stack([uv[found], np.full(int(found.sum()), np.nan)])
        observations = Observations(uvd, np.full(uvd.shape, SIGMA_FLOW_PX))
        agreement = self._consensus.refine(T_predicted, ids[found], observations)
        return agreement if agreement.is_believable(len(ids)) else None

    @timed
    def _select(
        self, local_ids: NDArray[np.int32], T_camera_world: Array, excluded: Region | None
    ) -> Prediction:
        """Return points that should be seen, spread over the image, the often found first."""
        seen = predict_points(self._map, local_ids, T_camera_world, excluded)
        if len(seen.ids) <= TRACKED_POINTS:
            return seen
        area = self._camera.width * self._camera.height
        cell_px = max(1, int(np.sqrt(area / TRACKED_POINTS)))
        reliability = self._map.points.reliability(seen.ids).astype(np.float32)
        return seen.take(spread(seen.uvd_px[:, :2], reliability, cell_px, TRACKED_POINTS))
