"""The occupancy grid stage: from labelled points and floor scans to the map.

It keeps the evidence of all keyframes in order, and the raster that follows from it.
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.cloud.labelled_cloud import LabelledPoints
from segfloor_ros.errors import MapError
from segfloor_ros.files.saved_map import Arrays, check_lengths
from segfloor_ros.floor.observation import FloorScan
from segfloor_ros.geometry import Array
from segfloor_ros.grid.fold import EvidenceFolder, Pose2d
from segfloor_ros.grid.keyframe_evidence import (
    KeyframeEvidence,
    evidence_from_arrays,
    evidence_to_arrays,
    gather_evidence,
)
from segfloor_ros.grid.map_file import LogOddsRaster, OccupancyGrid, OccupancyGridSettings, render
from segfloor_ros.slam.results import KeyframeFeatures, KeyframePath

_LEVER_M = 2.5
"""A turn of the base moves its evidence by the turn times this, about half a ray."""

_MOVE_SHARE = 0.25
_LEAST_MOVE_M = 0.005
"""The map follows keyframes that moved by more than this share of a cell, and by this much."""

UNDO_BYTES = 4_000_000
_MAX_STRIDE_M = 2.0
"""Between keyframes farther apart than this the base's way is not known."""


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


class EvidenceHistory:
    """Folds the keyframes into the raster, and folds them anew from the first one that moved.

    What the latest keyframes overwrote is kept, so that they can be taken back one by one: moves
    after local bundle adjustment concern these. The raster depends on evidence and poses alone,
    not on how often and when it was asked for.

    evidence: of the keyframes; poses: (K, 3) = x, y, yaw, where it now lies.
    """

    def __init__(self, folder: EvidenceFolder) -> None:
        self._folder = folder
        self.evidence: list[KeyframeEvidence] = []
        self.poses: NDArray[np.float64] = np.zeros((0, 3))
        self._raster = LogOddsRaster()
        self._done = 0
        self._undo: deque[tuple[tuple[int, int], NDArray[np.uint8]]] = deque()
        self._undo_bytes = 0

    def __len__(self) -> int:
        return len(self.evidence)

    def extend(self, evidence: list[KeyframeEvidence], poses: NDArray[np.float64]) -> None:
        """Add the evidence of the next keyframes, at poses (K, 3) = x, y, yaw."""
        self.evidence += evidence
        self.poses = np.concatenate([self.poses, poses])

    def move(self, first: int, poses: NDArray[np.float64]) -> None:
        """Set the poses (K - first, 3) of keyframe `first` and all after it."""
        self.poses[first:] = poses
        self._return_to(first)

    def remove(self, gone: NDArray[np.bool_]) -> None:
        """Forget the evidence of some keyframes (K,)."""
        self._return_to(int(np.argmax(gone)))
        self.evidence = [e for e, g in zip(self.evidence, gone, strict=True) if not g]
        self.poses = self.poses[~gone]

    def fold_anew(self, folder: EvidenceFolder) -> None:
        """Fold all evidence again by other rules."""
        self._folder = folder
        self._start_over()

    def raster(self) -> LogOddsRaster:
        """Return the raster of all keyframes."""
        while self._done < len(self.evidence):
            evidence = self.evidence[self._done]
            pose, previous = self._pose(self._done), self._previous(self._done)
            placed = self._folder.place(evidence, pose, previous)
            cells = self._raster.patch(placed.low, placed.high)
            self._remember(placed.low, cells)
            self._folder.fold(cells, placed)
            self._done += 1
        return self._raster

    def _pose(self, index: int) -> Pose2d:
        x, y, yaw = self.poses[index].tolist()
        return (x, y, yaw)

    def _previous(self, index: int) -> Pose2d | None:
        if index == 0:
            return None
        stride = np.hypot(*(self.poses[index, :2] - self.poses[index - 1, :2]))
        return self._pose(index - 1) if stride <= _MAX_STRIDE_M else None

    def _remember(self, low: tuple[int, int], cells: NDArray[np.uint8]) -> None:
        self._undo.append((low, cells.copy()))
        self._undo_bytes += cells.size
        while self._undo_bytes > UNDO_BYTES:
            self._undo_bytes -= self._undo.popleft()[1].size

    def _return_to(self, index: int) -> None:
        """Make the raster one of the keyframes before `index`, or of none."""
        if self._done - index > len(self._undo):
            self._start_over()
        while self._done > index:
            low, cells = self._undo.pop()
            self._undo_bytes -= cells.size
            high = (low[0] + cells.shape[0], low[1] + cells.shape[1])
            self._raster.patch(low, high)[:] = cells
            self._done -= 1

    def _start_over(self) -> None:
        self._raster = LogOddsRaster()
        self._done = 0
        self._undo.clear()
        self._undo_bytes = 0
