"""What is remembered of every point, as arrays in the order of the cloud's ids."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.cloud.labels import FLOOR, OBSTACLE, UNKNOWN
from segfloor_ros.geometry import Array


class PointTable:
    """Evidence by point id; rows follow the cloud: removed points vanish, new ones start empty."""

    def __init__(self) -> None:
        self.point_id = np.zeros(0, np.int32)
        self.mask_log_odds = np.zeros(0, np.float32)
        self.looks = np.zeros(0, np.int32)
        self.floor_z_m = np.zeros(0, np.float32)
        self.distance_m = np.zeros(0, np.float32)
        self.label = np.zeros(0, np.uint8)

    def follow(self, point_id: NDArray[np.int32]) -> None:
        """Make the rows those of the ids (N,), ascending."""
        row = np.searchsorted(self.point_id, point_id)
        row = np.minimum(row, max(len(self.point_id) - 1, 0))
        known = self.point_id[row] == point_id if len(self.point_id) else np.zeros(row.shape, bool)
        for name in ('mask_log_odds', 'looks', 'floor_z_m', 'distance_m', 'label'):
            old = getattr(self, name)
            new = np.zeros(len(point_id), old.dtype)
            new[known] = old[row[known]]
            setattr(self, name, new)
        self.point_id = point_id

    def rows_of(self, ids: NDArray[np.int32]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return which of the ids (N,) are in the table, as indices (M,), and their rows (M,)."""
        if len(self.point_id) == 0:
            return np.zeros(0, np.intp), np.zeros(0, np.intp)
        row = np.minimum(np.searchsorted(self.point_id, ids), len(self.point_id) - 1)
        found = np.flatnonzero(self.point_id[row] == ids)
        return found, row[found]

    def look(
        self,
        row: NDArray[np.intp],
        evidence: Array,
        limit: float,
        floor_z_m: Array,
        distance_m: Array,
    ) -> None:
        """Add one look at the points of rows (M,): evidence, floor height and distance (M,)."""
        total = self.mask_log_odds[row] + evidence
        self.mask_log_odds[row] = np.clip(total, -limit, limit)
        # The nearest look placed the point best.
        nearer = (self.looks[row] == 0) | (distance_m < self.distance_m[row])
        self.distance_m[row[nearer]] = distance_m[nearer]
        self.floor_z_m[row] = floor_z_m
        self.looks[row] += 1

    def decide(self, log_odds: Array, threshold: float) -> None:
        """Set the labels by evidence (N,); between the thresholds a label stays as it is."""
        self.label[log_odds >= threshold] = OBSTACLE
        self.label[log_odds <= -threshold] = FLOOR
        self.label[self.looks == 0] = UNKNOWN
