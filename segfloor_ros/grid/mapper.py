"""The occupancy grid stage: from labelled points and floor scans to the map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.cloud.labels import LabelledPoints
from segfloor_ros.errors import MapError
from segfloor_ros.floor.observation import FloorScan
from segfloor_ros.geometry import Array
from segfloor_ros.grid.evidence_arrays import evidence_from_arrays, evidence_to_arrays
from segfloor_ros.grid.fold import EvidenceFolder
from segfloor_ros.grid.history import EvidenceHistory
from segfloor_ros.grid.keyframe_evidence import gather_evidence
from segfloor_ros.grid.occupancy import OccupancyGrid
from segfloor_ros.grid.rendering import render
from segfloor_ros.grid.settings import OccupancyGridSettings
from segfloor_ros.map_file import Arrays, check_lengths
from segfloor_ros.slam.results import KeyframeFeatures, KeyframePath

_LEVER_M = 2.5
"""A turn of the base moves its evidence by the turn times this, about half a ray."""

_MOVE_SHARE = 0.25
_LEAST_MOVE_M = 0.005
"""The map follows keyframes that moved by more than this share of a cell, and by this much."""


class OccupancyGridMapper:
    """Builds the map from the keyframes' evidence, and lets it follow their poses."""

    def __init__(self, settings: OccupancyGridSettings) -> None:
        self._settings = settings
        self._history = EvidenceHistory(EvidenceFolder(settings))
        self._stamp_ns = np.zeros(0, np.int64)
        self._aside: tuple[NDArray[np.int64], EvidenceHistory] | None = None

    def change_settings(self, settings: OccupancyGridSettings) -> None:
        """Map with changed live settings from now on, old evidence included."""
        self._settings = settings
        self._history.fold_anew(EvidenceFolder(settings))

    def update(
        self,
        stamp_ns: int,
        points: LabelledPoints,
        features: KeyframeFeatures,
        path: KeyframePath,
        scan: FloorScan,
    ) -> None:
        """Take in one keyframe, by its stamp; keyframes come in the order of their stamps.

        path: all keyframes as now optimised, this one among them; evidence of keyframes that are
        no longer in it is forgotten, or where it is all there was, waits for their return. Raises
        MapError when the keyframe is not in the path.
        """
        poses = _planar(path.T_map_base)
        self._follow(path.stamp_ns, poses)
        at = int(np.searchsorted(path.stamp_ns, stamp_ns))
        if at == len(path.stamp_ns) or path.stamp_ns[at] != stamp_ns:
            raise MapError(f'keyframe {stamp_ns} ns is not in its own path of keyframes')
        evidence = gather_evidence(points, features, path.T_map_base[at], scan, self._settings)
        self._history.extend([evidence], poses[at : at + 1])
        self._stamp_ns = np.append(self._stamp_ns, np.int64(stamp_ns))

    def grid(self) -> OccupancyGrid:
        """Return the map as of the last update."""
        return render(self._history.raster(), self._history.poses[:, :2], self._settings)

    def to_arrays(self) -> Arrays:
        """Return the evidence of all keyframes, for a file."""
        arrays = evidence_to_arrays(self._history.evidence)
        return arrays | {'stamp_ns': self._stamp_ns, 'pose': self._history.poses}

    def from_arrays(self, arrays: Arrays, stamp_ns: NDArray[np.int64]) -> None:
        """Go on with the evidence of a map, with its keyframes at stamps (K,), ascending."""
        evidence = evidence_from_arrays(arrays)
        check_lengths({'evidence': evidence, 'pose': arrays['pose'], 'stamp_ns': stamp_ns})
        self._history.extend(evidence, arrays['pose'])
        self._stamp_ns = stamp_ns

    def _follow(self, stamp_ns: NDArray[np.int64], poses: NDArray[np.float64]) -> None:
        """Move the evidence to the keyframes' poses (K, 3), where they moved enough to matter."""
        self._bring_back(stamp_ns)
        row = np.minimum(np.searchsorted(stamp_ns, self._stamp_ns), len(stamp_ns) - 1)
        gone = stamp_ns[row] != self._stamp_ns
        if len(gone) and gone.all():
            self._aside = self._stamp_ns, self._history
            self._history = EvidenceHistory(EvidenceFolder(self._settings))
            self._stamp_ns, row = self._stamp_ns[:0], row[:0]
        elif gone.any():
            self._history.remove(gone)
            self._stamp_ns, row = self._stamp_ns[~gone], row[~gone]
        now, then = poses[row], self._history.poses
        moved_m = np.hypot(now[:, 0] - then[:, 0], now[:, 1] - then[:, 1])
        turn = np.abs(np.remainder(now[:, 2] - then[:, 2] + np.pi, 2 * np.pi) - np.pi)
        limit_m = _MOVE_SHARE * self._settings.resolution_m
        limit_m = max(limit_m, _LEAST_MOVE_M)
        moved = np.flatnonzero(moved_m + turn * _LEVER_M > limit_m)
        if len(moved):
            self._history.move(int(moved[0]), now[moved[0] :])

    def _bring_back(self, stamp_ns: NDArray[np.int64]) -> None:
        """Take in what was put aside, once its keyframes, which are older, are in the path again:
        a drive with a map of its own has recognised the one that was loaded.
        """
        if self._aside is None or not np.isin(self._aside[0], stamp_ns).any():
            return
        (earlier, before), latest = self._aside, self._history
        self._history, self._aside = EvidenceHistory(EvidenceFolder(self._settings)), None
        for history in (before, latest):
            self._history.extend(history.evidence, history.poses)
        self._stamp_ns = np.concatenate([earlier, self._stamp_ns])


def _planar(T_map_base: Array) -> NDArray[np.float64]:
    """Return x, y and yaw (K, 3) of poses (K, 4, 4)."""
    yaw = np.arctan2(T_map_base[:, 1, 0], T_map_base[:, 0, 0])
    return np.stack([T_map_base[:, 0, 3], T_map_base[:, 1, 3], yaw], axis=1)
