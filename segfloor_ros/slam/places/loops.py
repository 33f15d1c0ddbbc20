"""Loops: a place of the map that is seen again after the path has drifted.

Precision comes first: a loop that is missed costs drift, a false one costs the map. The place must
lie where drift can have put it, several keyframes in a row must see it, each on its own, and they
must agree.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from segfloor_ros.geometry import Array, invert
from segfloor_ros.slam.map.records import KeyframeRecord, Match
from segfloor_ros.slam.map.sparse_map import SparseMap
from segfloor_ros.slam.places.known_views import RECENT, views_near
from segfloor_ros.slam.places.loop_checks import (
    FREE_DRIFT_M,
    MAX_DRIFT,
    LoopChecks,
    are_certain,
    drift,
    median_depth_m,
)
from segfloor_ros.slam.places.place_recognition import PlaceRecognition
from segfloor_ros.slam.results import MIN_SHARED, NO_POINT, Track
from segfloor_ros.slam.rig import Rig
from segfloor_ros.slam.tracking.images import Images

MIN_SHARED_SHARE = 0.25
"""Keyframes that share so many points are linked already; fewer are shared by chance."""

CANDIDATES = 2
MAX_MISSES = 1
REMEMBERED = 1000


@dataclass(frozen=True)
class Candidate:
    """What became of a keyframe that saw a place, both by index, as it seemed from T_keyframe_place
    (4, 4): verdict is 'seen' for one that counts, 'closed' for the last of a loop, else what spoke
    against it.
    """

    keyframe: int
    place: int
    T_keyframe_place: Array
    verdict: str


class LoopDetector:
    """Looks for loops, keyframe by keyframe."""

    def __init__(self, rig: Rig, sparse_map: SparseMap, places: PlaceRecognition) -> None:
        self.candidates: deque[Candidate] = deque(maxlen=REMEMBERED)
        self._map = sparse_map
        self._places = places
        self._checks = LoopChecks(rig, sparse_map)
        self.reset()

    def reset(self) -> None:
        """Believe in no loop."""
        self._matches: list[Match] = []
        self._misses = 0

    def detect(self, keyframe: KeyframeRecord, images: Images) -> list[Match]:
        """Return the keyframes that see a place again, once there are enough of them, else none."""
        lengths = path_lengths(self._map, keyframe.index)
        near, far = self._sides(keyframe, lengths)
        if not far.any():
            self.reset()
            return []
        known = self._map.points_of(np.flatnonzero(near))
        if self._matches:
            match = self._follow(keyframe, images, far, known)
        else:
            match = self._find(keyframe, images, far, known)
        if match is not None and self._is_sound(keyframe, match, lengths):
            self._matches.append(match)
            self._misses = 0
        elif self._matches:
            self._misses += 1
            if self._misses > MAX_MISSES:
                self.reset()
        if not are_certain(self._map, self._matches):
            return []
        matches = self._matches
        self._note(matches[-1], 'closed')
        self.reset()
        return matches

    def _is_sound(self, keyframe: KeyframeRecord, match: Match, lengths: Array) -> bool:
        length_m = float(lengths[match.place])
        objection = self._checks.objection_to_drift(keyframe, match, length_m)
        objection = objection or self._checks.objection(keyframe, match)
        self._note(match, objection or 'seen')
        return not objection

    def _note(self, match: Match, verdict: str) -> None:
        place = self._map.keyframes[match.place]
        T_keyframe_place = match.T_camera_world @ place.T_world_camera
        self.candidates.append(Candidate(match.keyframe, match.place, T_keyframe_place, verdict))

    def _sides(
        self, keyframe: KeyframeRecord, lengths: Array
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return which keyframes (K,) a view is linked to already, and which of the others it may
        have come back to.
        """
        keyframes = self._map.keyframes
        own = keyframe.point_id[keyframe.point_id != NO_POINT]
        linked, shared = self._map.covisible(own)
        near = np.arange(len(keyframes)) > keyframe.index - RECENT
        near[linked[shared > max(MIN_SHARED, MIN_SHARED_SHARE * len(own))]] = True
        retired = np.array([k.retired is not None for k in keyframes])
        return near, ~near & ~retired & self._within_drift(keyframe, lengths)

    def _within_drift(self, keyframe: KeyframeRecord, lengths: Array) -> NDArray[np.bool_]:
        """Return whether each keyframe (K,) stands so near that the path between may have drifted
        by as much, and looks about the same way.
        """
        poses = invert(np.stack([k.T_camera_world for k in self._map.keyframes]))
        distance = np.linalg.norm(poses[:, :3, 3] - keyframe.T_world_camera[:3, 3], axis=1)
        cosine = poses[:, :3, 2] @ keyframe.T_world_camera[:3, 2]
        reach = FREE_DRIFT_M + MAX_DRIFT * lengths
        # A view shows a place also from some way before and behind it.
        return (distance < reach + 1.0) & (cosine > 0.7)

    def _find(
        self,
        keyframe: KeyframeRecord,
        images: Images,
        far: NDArray[np.bool_],
        known: NDArray[np.int32],
    ) -> Match | None:
        """Look for a place by its look."""
        score = self._places.score(keyframe.features) * far
        for group in self._places.groups(score, CANDIDATES):
            ids = np.setdiff1d(self._map.points_of(group), known).astype(np.int32)
            track = self._places.locate(images, keyframe.features, ids)
            if track is not None:
                return self._match(keyframe, track, far)
        return None

    def _follow(
        self,
        keyframe: KeyframeRecord,
        images: Images,
        far: NDArray[np.bool_],
        known: NDArray[np.int32],
    ) -> Match | None:
        """Look for the place where the keyframes before saw it."""
        pose = keyframe.T_camera_world @ drift(self._map, self._matches[-1])
        around = views_near(
            self._map, pose, median_depth_m(self._map, keyframe), len(self._map.keyframes)
        )
        around = around[far[around]][:RECENT]
        ids = np.setdiff1d(self._map.points_of(around), known).astype(np.int32)
        track = self._places.confirm(images, keyframe.features, ids, pose)
        return None if track is None else self._match(keyframe, track, far)

    def _match(
        self, keyframe: KeyframeRecord, track: Track, far: NDArray[np.bool_]
    ) -> Match | None:
        assert track.observed is not None
        rows = np.flatnonzero(track.observed.point_id != NO_POINT)
        ids = track.observed.point_id[rows]
        order, _ = self._map.covisible(ids)
        order = order[far[order]]
        if len(order) == 0:
            return None
        stable = self._map.stable_id[ids].copy()
        return Match(keyframe.index, int(order[0]), track.T_camera_world, rows, ids, stable)


def path_lengths(sparse_map: SparseMap, index: int) -> Array:
    """Return the length (K,) in metres of the shortest way from a keyframe to each other one, over
    keyframes that share points: what drift builds up along.
    """
    i, j = sparse_map.links()
    i = np.append(i, [loop.i for loop in sparse_map.loops]).astype(np.int32)
    j = np.append(j, [loop.j for loop in sparse_map.loops]).astype(np.int32)
    poses = np.stack([k.T_camera_world for k in sparse_map.keyframes])
    centres = invert(poses)[:, :3, 3]
    weight = np.linalg.norm(centres[i] - centres[j], axis=1) + 1e-6
    graph = sparse.csr_matrix((weight, (i, j)), shape=(len(centres), len(centres)))
    return np.asarray(dijkstra(graph, directed=False, indices=[index]))[0]
