"""The labelling stage: which points of the sparse cloud are floor and which are obstacles.

The published method takes the label from the mask at the latest look. Here every look counts:
log-odds per point, from the mask and from the height above the local floor.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.cloud.labels import FLOOR, OBSTACLE, UNKNOWN, LabelledPoints
from segfloor_ros.cloud.point_evidence import height_evidence, local_floor_m, mask_evidence
from segfloor_ros.cloud.point_table import PointTable
from segfloor_ros.cloud.settings import CloudLabellingSettings
from segfloor_ros.geometry import Array
from segfloor_ros.slam.results import KeyframeFeatures, SparseCloud

_HEIGHT_SIGMA_PER_M = 0.01
"""Growth of the error of a height with the distance, one sigma."""
_MASK_LOG_ODDS = 0.6
"""Evidence of one look at the floor mask."""
_LABEL_LOG_ODDS = 0.8
"""A label is given, or changed, when the evidence exceeds this."""


class CloudLabelling:
    """Labels the points of the sparse cloud by id, keyframe after keyframe."""

    def __init__(self, settings: CloudLabellingSettings) -> None:
        self.settings = settings
        self._judged_by = settings
        self._table = PointTable()

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
        looks = mask_evidence(mask, features.uv_px[seen]) * _MASK_LOG_ODDS
        xyz = cloud.xyz_map[row].astype(np.float64)
        floor_z, distance_m = local_floor_m(xyz, T_map_base)
        table.look(row, looks, settings.max_mask_log_odds, floor_z, distance_m)
        z_m = cloud.xyz_map[:, 2]
        stale = table['judged_z_m'] != z_m
        stale[row] = True
        if self._judged_by != settings:
            stale[:] = True
            self._judged_by = settings
        self._judge(np.flatnonzero(stale), z_m)
        return LabelledPoints(
            point_id=cloud.point_id,
            xyz_map=cloud.xyz_map,
            label=table['label'].copy(),
            confidence=table['confidence'].copy(),
        )

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return what is known of the points, for a file."""
        return self._table.to_arrays()

    def from_arrays(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Go on with what is known of the points of a map."""
        self._table.from_arrays(arrays)

    def labelled(self, cloud: SparseCloud) -> LabelledPoints:
        """Return a cloud with the labels known of its points, which are all in the table."""
        self._table.follow(cloud.point_id)
        label, confidence = self._table['label'].copy(), self._table['confidence'].copy()
        return LabelledPoints(cloud.point_id, cloud.xyz_map, label, confidence)

    def _judge(self, row: NDArray[np.intp], z_m: NDArray[np.float32]) -> None:
        """Label the points of rows (M,), which were looked at or moved; z_m: of all points (N,).

        All others are as far above the floor as before, and so would be their labels.
        """
        table, settings = self._table, self.settings
        looked = table['looks'][row] > 0
        height_m = z_m[row] - table['floor_z_m'][row]
        sigma_m = settings.height_sigma_m + _HEIGHT_SIGMA_PER_M * table['distance_m'][row]
        by_height = height_evidence(height_m, sigma_m, settings) * looked
        log_odds = table['mask_log_odds'][row] + by_height
        belief = table['belief'][row]
        # Between the thresholds it stays as it is.
        belief[log_odds >= _LABEL_LOG_ODDS] = OBSTACLE
        belief[log_odds <= -_LABEL_LOG_ODDS] = FLOOR
        belief[~looked] = UNKNOWN
        concerned = height_m <= settings.robot_height_m
        concerned &= height_m >= -(settings.drop_height_m + 2 * sigma_m)
        label = np.where(concerned, belief, UNKNOWN)
        towards = np.where(label == OBSTACLE, log_odds, -log_odds)
        certainty = np.clip(np.tanh(towards / 2), 0, 1)
        table['belief'][row], table['judged_z_m'][row] = belief, z_m[row]
        table['label'][row] = label
        table['confidence'][row] = np.where(label == UNKNOWN, 0, certainty)
