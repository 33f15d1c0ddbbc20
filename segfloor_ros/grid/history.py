"""The evidence of all keyframes in order, and the raster that follows from it."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.grid.fold import EvidenceFolder
from segfloor_ros.grid.keyframe_evidence import KeyframeEvidence
from segfloor_ros.grid.log_odds import LogOddsRaster
from segfloor_ros.grid.placing import Pose2d

UNDO_BYTES = 4_000_000
_MAX_STRIDE_M = 2.0
"""Between keyframes farther apart than this the base's way is not known."""


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
