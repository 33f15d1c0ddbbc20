"""The evidence of all keyframes in order, and the raster that follows from it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.grid.evidence import KeyframeEvidence
from segfloor_ros.grid.fold import EvidenceFolder
from segfloor_ros.grid.log_odds import LogOddsRaster, Snapshot
from segfloor_ros.grid.placing import Pose2d

CHECKPOINT_EVERY = 16
_KEEP_GROWTH = 8
_MAX_STRIDE_M = 2.0
"""Between keyframes farther apart than this the base's way is not known."""


class EvidenceHistory:
    """Folds the keyframes into the raster, and folds them anew from the first one that moved.

    Copies of the raster from a while ago save most of the work: moves after local bundle
    adjustment concern the latest keyframes. The raster depends on evidence and poses alone, not on
    how often and when it was asked for.
    """

    def __init__(self, folder: EvidenceFolder) -> None:
        self._folder = folder
        self._evidence: list[KeyframeEvidence] = []
        self._poses: NDArray[np.float64] = np.zeros((0, 3))
        self._raster = LogOddsRaster()
        self._done = 0
        self._checkpoints: dict[int, Snapshot] = {}

    def __len__(self) -> int:
        return len(self._evidence)

    @property
    def poses(self) -> NDArray[np.float64]:
        """The poses (K, 3) = x, y, yaw the evidence now lies at."""
        return self._poses

    def append(self, evidence: KeyframeEvidence, pose: Pose2d) -> None:
        """Add the evidence of the next keyframe."""
        self._evidence.append(evidence)
        self._poses = np.concatenate([self._poses, [pose]])

    def move(self, first: int, poses: NDArray[np.float64]) -> None:
        """Set the poses (K - first, 3) of keyframe `first` and all after it."""
        self._poses[first:] = poses
        self._return_to(first)

    def remove(self, gone: NDArray[np.bool_]) -> None:
        """Forget the evidence of some keyframes (K,)."""
        first = int(np.argmax(gone))
        self._evidence = [e for e, g in zip(self._evidence, gone, strict=True) if not g]
        self._poses = self._poses[~gone]
        self._return_to(first)

    def fold_anew(self, folder: EvidenceFolder) -> None:
        """Fold all evidence again by other rules."""
        self._folder = folder
        self._return_to(0)

    def raster(self) -> LogOddsRaster:
        """Return the raster of all keyframes."""
        while self._done < len(self._evidence):
            if self._done % CHECKPOINT_EVERY == 0 and self._done:
                self._checkpoints[self._done] = self._raster.snapshot()
                self._thin_checkpoints()
            pose = self._pose(self._done)
            evidence = self._evidence[self._done]
            self._folder.fold(self._raster, evidence, pose, self._previous(self._done))
            self._done += 1
        return self._raster

    def _pose(self, index: int) -> Pose2d:
        x, y, yaw = self._poses[index].tolist()
        return (x, y, yaw)

    def _previous(self, index: int) -> Pose2d | None:
        if index == 0:
            return None
        stride = np.hypot(*(self._poses[index, :2] - self._poses[index - 1, :2]))
        return self._pose(index - 1) if stride <= _MAX_STRIDE_M else None

    def _return_to(self, index: int) -> None:
        """Make the raster one of keyframes before `index` only, or of fewer."""
        if index >= self._done:
            return
        self._checkpoints = {n: s for n, s in self._checkpoints.items() if n <= index}
        self._done = max(self._checkpoints, default=0)
        self._raster = LogOddsRaster()
        if self._done:
            self._raster.restore(self._checkpoints[self._done])

    def _thin_checkpoints(self) -> None:
        """Keep the two latest, and the latest that is much older."""
        numbers = sorted(self._checkpoints, reverse=True)
        old = [n for n in numbers[2:] if self._done - n >= _KEEP_GROWTH * CHECKPOINT_EVERY]
        middle = numbers[2:][-1:] if not old else [old[0]]
        waiting = [n for n in numbers[2:] if n > middle[0]][-1:] if middle else []
        keep = {*numbers[:2], *middle, *waiting}
        self._checkpoints = {n: s for n, s in self._checkpoints.items() if n in keep}
