"""What is remembered of every point, in the order of the cloud's ids."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array

_COLUMNS: dict[str, tuple[type, float]] = {
    'mask_log_odds': (np.float32, 0),
    'looks': (np.int32, 0),
    'floor_z_m': (np.float32, 0),
    'distance_m': (np.float32, 0),
    'belief': (np.uint8, 0),
    'judged_z_m': (np.float32, np.nan),
    'label': (np.uint8, 0),
    'confidence': (np.float32, 0),
}
"""Type and first value. belief: what the evidence says, with hysteresis; label, confidence: what
is told of it. judged_z_m: where the point was when that was decided, in frame `map`.
"""


class PointTable:
    """Points by id; rows follow the cloud: removed points vanish, new ones start empty."""

    def __init__(self) -> None:
        self.point_id = np.zeros(0, np.int32)
        self._columns = _empty(0)
        self._aside: dict[str, NDArray[Any]] | None = None

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return a column (N,), to be read and written."""
        return self._columns[name][: len(self.point_id)]

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the ids and the columns."""
        return {'point_id': self.point_id} | {name: self[name].copy() for name in _COLUMNS}

    def from_arrays(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Take in what `to_arrays` returned."""
        self.point_id = arrays['point_id']
        self._columns = {name: arrays[name].astype(kind) for name, (kind, _) in _COLUMNS.items()}

    def follow(self, point_id: NDArray[np.int32]) -> None:
        """Make the rows those of the ids (N,), ascending. What is known of a cloud waits for its
        return where another one that shares no point takes its place.
        """
        self._bring_back(point_id)
        known, count = len(self.point_id), len(point_id)
        if not np.array_equal(point_id[:known], self.point_id):
            at, row = self.rows_of(point_id)
            if known and not len(at):
                self._aside = self.to_arrays()
            kept = _empty(count)
            for name, column in kept.items():
                column[at] = self._columns[name][row]
            self._columns = kept
        elif count > len(self._columns['looks']):
            # Room to grow, so that not every keyframe copies all of it.
            for name, column in _empty(count - known + known // 4).items():
                self._columns[name] = np.concatenate([self[name], column])
        self.point_id = point_id

    def _bring_back(self, point_id: NDArray[np.int32]) -> None:
        """Put what is known of an older cloud before the rest, once its points are there again."""
        if self._aside is None or not np.isin(self._aside['point_id'], point_id).any():
            return
        latest, older = self.to_arrays(), self._aside
        self.from_arrays({name: np.concatenate([older[name], latest[name]]) for name in latest})
        self._aside = None

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
        total = self['mask_log_odds'][row] + evidence
        self['mask_log_odds'][row] = np.clip(total, -limit, limit)
        # The nearest look placed the point best.
        nearer = (self['looks'][row] == 0) | (distance_m < self['distance_m'][row])
        self['distance_m'][row[nearer]] = distance_m[nearer]
        self['floor_z_m'][row] = floor_z_m
        self['looks'][row] += 1


def _empty(count: int) -> dict[str, NDArray[Any]]:
    return {name: np.full(count, first, kind) for name, (kind, first) in _COLUMNS.items()}
