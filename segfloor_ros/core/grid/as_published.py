"""The occupancy grid as Segfloor published it (dissertation, 2022, section 5.6): points alone, in
two binary layers. Loaded only where `as_published` is set.

Obstacle points, wherever they are above the floor, mark the cells below them. Rays from the base to
the floor points that a keyframe sees mark cells free. Nothing is cleared, filled or weighed.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.contracts import POINT_OBSTACLE, FloorScan, KeyframeFeatures, LabelledPoints
from segfloor_ros.core.files.arrays import Arrays
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.grid.keyframe_evidence import (
    KeyframeEvidence,
    ray_length_limit,
    seen_points,
    unit_vectors,
)
from segfloor_ros.core.grid.mapper import OccupancyGridMapper
from segfloor_ros.core.grid.occupancy import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    OccupancyGrid,
    OccupancyGridSettings,
)

_OBSTACLES = 'obstacle_xy_m'


class PublishedMapper(OccupancyGridMapper):
    """Draws both layers anew for each grid, from the keyframes' rays at their present poses and the
    obstacle points of the present cloud.
    """

    def __init__(self, settings: OccupancyGridSettings) -> None:
        super().__init__(settings)
        self._gather = self._take_in
        self._obstacle_xy_m: NDArray[np.float32] = np.zeros((0, 2), np.float32)

    def grid(self) -> OccupancyGrid:
        """Return the sum of both layers: unknown where neither has anything, occupied where the
        obstacle layer is, else free. It reaches as far around the path as the longest ray does.
        """
        cell_m, poses = self._settings.resolution_m, self._history.poses
        rays = [self._rays(k) for k in range(len(poses))]
        ends = np.concatenate(rays) if rays else np.zeros((0, 2, 2))
        if len(ends) == 0:
            return OccupancyGrid(np.full((1, 1), UNKNOWN, np.int8), cell_m, (0.0, 0.0))
        reach_m = float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).max())
        low = np.floor((poses[:, :2].min(axis=0) - reach_m) / cell_m).astype(np.intp)
        high = np.floor((poses[:, :2].max(axis=0) + reach_m) / cell_m).astype(np.intp) + 1
        free = np.zeros((high - low)[::-1], np.uint8)
        lines = (np.floor(ends / cell_m).astype(np.intp) - low).astype(np.int32)
        cv2.polylines(free, list(lines), False, 1)
        if self._settings.opening_cells > 1:
            around = np.ones((self._settings.opening_cells,) * 2, np.uint8)
            free = cv2.morphologyEx(free, cv2.MORPH_OPEN, around)
        cells = np.where(free > 0, FREE, UNKNOWN).astype(np.int8)
        column, row = (np.floor(self._obstacle_xy_m / cell_m).astype(np.intp) - low).T
        inside = (row >= 0) & (row < cells.shape[0]) & (column >= 0) & (column < cells.shape[1])
        cells[row[inside], column[inside]] = OCCUPIED
        return OccupancyGrid(cells, cell_m, (float(low[0] * cell_m), float(low[1] * cell_m)))

    def to_arrays(self) -> Arrays:
        """Return the rays of all keyframes and the obstacle points, for a file."""
        return super().to_arrays() | {_OBSTACLES: self._obstacle_xy_m}

    def from_arrays(self, arrays: Arrays, stamp_ns: NDArray[np.int64]) -> None:
        """Go on with a map, also one of the usual mapper, whose obstacles come with its points."""
        super().from_arrays(arrays, stamp_ns)
        self._obstacle_xy_m = arrays.get(_OBSTACLES, self._obstacle_xy_m)

    def _rays(self, keyframe: int) -> Array:
        """Return start and end (R, 2, 2) of the rays of a keyframe in frame `map`."""
        evidence, (x, y, yaw) = self._history.evidence[keyframe], self._history.poses[keyframe]
        ends = evidence.positions_m[:, : evidence.num_rays].astype(np.float64)
        cos, sin = unit_vectors(np.array([yaw]))[:, 0]
        turned = np.array([[cos, -sin], [sin, cos]]) @ ends
        start = np.tile([x, y], (ends.shape[1], 1))
        return np.stack([start, start + turned.T], axis=1)

    def _take_in(
        self,
        points: LabelledPoints,
        features: KeyframeFeatures,
        T_map_base: Array,
        scan: FloorScan,
        settings: OccupancyGridSettings,
    ) -> KeyframeEvidence:
        """Keep the obstacle points, and return the ends of the rays to the floor points that a
        keyframe at T_map_base (4, 4) sees; outliers are dropped (equations 5.3 to 5.5), and rays
        longer than `max_range_m` end there. The floor scan is not used.
        """
        self._obstacle_xy_m = points.xyz_map[points.label == POINT_OBSTACLE, :2]
        floor, _ = seen_points(points, features, T_map_base)
        length_m = np.hypot(floor[:, 0], floor[:, 1])
        if len(floor):
            kept = (length_m > 0) & (length_m <= ray_length_limit(length_m))
            floor, length_m = floor[kept], length_m[kept]
        if settings.max_range_m > 0:
            floor = floor * np.minimum(1.0, settings.max_range_m / length_m)[:, None]
        nothing = np.zeros(0, np.float16)
        return KeyframeEvidence(
            first_rad=0.0,
            step_rad=scan.angle_increment_rad,
            fan_m=nothing,
            positions_m=floor.T.astype(np.float16),
            num_rays=len(floor),
            num_contacts=0,
            thickness_m=nothing,
            sure_range_m=0.0,
            movable_m=nothing.reshape(2, 0),
        )
