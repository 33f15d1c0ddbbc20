"""The labelling stage: which points of the sparse cloud are floor and which are obstacles.

The published method takes the label from the mask at the latest look. Here every look counts:
log-odds per point, negative for floor and positive for an obstacle, from the mask and from the
height above the local floor. They are kept in the order of the cloud's ids. The grid gets the
sparse cloud with a label per point.
"""

from __future__ import annotations

import itertools
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.contracts import (
    CELL_M,
    NOT_FLOOR,
    POINT_FLOOR,
    POINT_OBSTACLE,
    POINT_UNKNOWN,
    KeyframeFeatures,
    LabelledPoints,
    SparseCloud,
)
from segfloor_ros.core.contracts import FLOOR as MASK_FLOOR
from segfloor_ros.core.geometry import Array, invert, transform_points
from segfloor_ros.core.settings import RobotSettings

_HEIGHT_SIGMA_M, _HEIGHT_SIGMA_PER_M = 0.02, 0.01
"""Error of a height close to the robot, and its growth with the distance, one sigma."""
_MASK_LOG_ODDS, _MAX_MASK_LOG_ODDS = 0.6, 3.0
"""Evidence of one look at the floor mask, and of all: a label can still change after five."""
_MAX_HEIGHT_LOG_ODDS = 2.0
"""Evidence of a height; less than that of the mask, for the floor is not a plane."""
_LABEL_LOG_ODDS = 0.8
"""A label is given, or changed, when the evidence exceeds this."""
_ENOUGH_POINTS = 3
"""So many points above a place of the size of a cell are something that stands there."""
_RECENT_KEYFRAMES = 5
"""Points that so many keyframes have seen are company for those of the newest."""

_COLUMNS = {
    'mask_log_odds': np.float32,
    'looks': np.int32,
    'floor_z_m': np.float32,
    'distance_m': np.float32,
    'belief': np.uint8,
    'judged_z_m': np.float32,
    'label': np.uint8,
    'confidence': np.float32,
}
"""All begin with 0. belief: what the evidence says, with hysteresis; label, confidence: what
gets it. judged_z_m: where the point was when that was decided, in frame `map`.
"""


class CloudLabelling:
    """Labels the points of the sparse cloud by id, keyframe after keyframe."""

    def __init__(self, settings: CloudLabellingSettings) -> None:
        self.settings = settings
        self._judged_by = settings
        self._table = PointTable()
        self._seen: deque[NDArray[np.int32]] = deque(maxlen=_RECENT_KEYFRAMES)

    def update(
        self,
        cloud: SparseCloud,
        features: KeyframeFeatures,
        mask: NDArray[np.uint8],
        T_map_base: Array,
    ) -> LabelledPoints:
        """Take in one keyframe and return the whole cloud with its labels.

        mask: (H, W) uint8, the keyframe's floor mask. T_map_base: (4, 4) pose of the keyframe's
        base: heights are measured from the floor below it, with an error that grows with the
        distance the point was seen from.
        """
        table, settings = self._table, self.settings
        table.follow(cloud.point_id)
        seen, row = table.rows_of(features.point_id)
        self._seen.append(features.point_id[seen])
        looks = mask_evidence(mask, features.uv_px[seen]) * _MASK_LOG_ODDS
        xyz = cloud.xyz_map[row].astype(np.float64)
        floor_z, distance_m = local_floor_m(xyz, T_map_base)
        table.look(row, looks, _MAX_MASK_LOG_ODDS, floor_z, distance_m)
        z_m = cloud.xyz_map[:, 2]
        stale = table['judged_z_m'] != z_m
        stale[row] = True
        if self._judged_by != settings:
            stale[:] = True
            self._judged_by = settings
        self._judge(np.flatnonzero(stale), z_m)
        return self._labelled(cloud)

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return what is known of the points, for a file."""
        return self._table.to_arrays()

    def from_arrays(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Go on with what is known of the points of a map."""
        self._table.from_arrays(arrays)
        self._seen.clear()

    def standing(self, points: LabelledPoints) -> NDArray[np.intp]:
        """Return the rows (M,) of obstacles for a costmap, which remembers them: those that the
        newest keyframe has seen, for who was there before may have gone; of a loaded map all, until
        one comes. What stands somewhere has several corners: a lone point above the floor is a
        wrong match.
        """
        seen = list(self._seen) or [points.point_id]
        row = np.flatnonzero(points.label == POINT_OBSTACLE)
        row = row[np.isin(points.point_id[row], np.concatenate(seen))]
        row = row[count_around(points.xyz_map[row, :2]) >= _ENOUGH_POINTS]
        return row[np.isin(points.point_id[row], seen[-1])]

    def labelled(self, cloud: SparseCloud) -> LabelledPoints:
        """Return a cloud with the labels known of its points, which are all in the table."""
        self._table.follow(cloud.point_id)
        return self._labelled(cloud)

    def _labelled(self, cloud: SparseCloud) -> LabelledPoints:
        """Return the cloud with the labels in the table."""
        label, confidence = self._table['label'].copy(), self._table['confidence'].copy()
        return LabelledPoints(cloud.point_id, cloud.xyz_map, label, confidence)

    def _judge(self, row: NDArray[np.intp], z_m: NDArray[np.float32]) -> None:
        """Label the points of rows (M,), which were looked at or moved; z_m: of all points (N,).

        All others are as far above the floor as before, and so would be their labels.
        """
        table, settings = self._table, self.settings
        looked = table['looks'][row] > 0
        height_m = z_m[row] - table['floor_z_m'][row]
        sigma_m = _HEIGHT_SIGMA_M + _HEIGHT_SIGMA_PER_M * table['distance_m'][row]
        by_height = height_evidence(height_m, sigma_m, settings) * looked
        log_odds = table['mask_log_odds'][row] + by_height
        belief = table['belief'][row]
        # Between the thresholds it stays as it is.
        belief[log_odds >= _LABEL_LOG_ODDS] = POINT_OBSTACLE
        belief[log_odds <= -_LABEL_LOG_ODDS] = POINT_FLOOR
        belief[~looked] = POINT_UNKNOWN
        concerned = height_m <= settings.robot_height_m
        concerned &= height_m >= -(settings.drop_height_m + 2 * sigma_m)
        label = np.where(concerned, belief, POINT_UNKNOWN)
        towards = np.where(label == POINT_OBSTACLE, log_odds, -log_odds)
        certainty = np.clip(np.tanh(towards / 2), 0, 1)
        table['belief'][row], table['judged_z_m'][row] = belief, z_m[row]
        table['label'][row] = label
        table['confidence'][row] = np.where(label == POINT_UNKNOWN, 0, certainty)


def mask_evidence(mask: NDArray[np.uint8], uv_px: NDArray[np.float32]) -> Array:
    """Return -1 for floor, +1 for not floor and 0 for neither at pixels (N, 2) of a mask (H, W).

    A pixel on the border of floor and not floor says nothing: corners lie on such borders, and
    the mask is not exact to the pixel.
    """
    rows, columns = mask.shape
    u = np.clip(np.rint(uv_px[:, 0]), 0, columns - 1).astype(np.intp)
    v = np.clip(np.rint(uv_px[:, 1]), 0, rows - 1).astype(np.intp)
    offsets = np.arange(-1, 2)
    near_v = np.clip(v[:, None] + np.repeat(offsets, 3), 0, rows - 1)
    near_u = np.clip(u[:, None] + np.tile(offsets, 3), 0, columns - 1)
    near = mask[near_v, near_u]
    floor, upright = (near == MASK_FLOOR).any(axis=1), (near == NOT_FLOOR).any(axis=1)
    centre = mask[v, u]
    evidence = np.where(centre == MASK_FLOOR, -1.0, np.where(centre == NOT_FLOOR, 1.0, 0.0))
    return np.where(floor & upright, 0.0, evidence)


def local_floor_m(xyz_map: Array, T_map_base: Array) -> tuple[Array, Array]:
    """Return the height (N,) of the floor, the base's plane, below points (N, 3), and the distances
    (N,) of the points from the base in metres.
    """
    in_base = transform_points(invert(T_map_base), xyz_map)
    return xyz_map[:, 2] - in_base[:, 2], np.hypot(in_base[:, 0], in_base[:, 1])


def height_evidence(height_m: Array, sigma_m: Array, settings: CloudLabellingSettings) -> Array:
    """Return the log-odds (N,) of an obstacle from heights (N,) above the floor.

    Floor lies at 0, obstacles anywhere above the step: the log of the ratio of the two Gaussian
    tails, which is close to linear in the distance from the middle of the step.
    """
    log_odds = (height_m - settings.step_height_m) / sigma_m
    return np.clip(log_odds, -_MAX_HEIGHT_LOG_ODDS, _MAX_HEIGHT_LOG_ODDS)


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
        self._columns = {name: arrays[name].astype(kind) for name, kind in _COLUMNS.items()}

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
    return {name: np.zeros(count, kind) for name, kind in _COLUMNS.items()}


def count_around(points: NDArray[np.floating]) -> NDArray[np.intp]:
    """Return how many of the points (N, 2) lie around each, itself among them: in its square of
    half a cell and the eight beside it.
    """
    squares = np.floor(points / (CELL_M / 2)).astype(np.int64)
    key = (squares[:, 0] << 32) + squares[:, 1]
    taken, at, here = np.unique(key, return_inverse=True, return_counts=True)
    around = np.zeros(len(taken), np.intp)
    for dx, dy in itertools.product((-1, 0, 1), repeat=2):
        beside = taken + (dx << 32) + dy
        row = np.minimum(np.searchsorted(taken, beside), len(taken) - 1)
        around += np.where(taken[row] == beside, here[row], 0)
    return around[at]


@dataclass(frozen=True)
class CloudLabellingSettings(RobotSettings):
    """The robot that floor and obstacles are judged for."""
