"""Loops: a place of the map that is seen again after the path has drifted.

Precision comes first: a loop that is missed costs drift, a false one costs the map. The place must
lie where drift can have put it, several keyframes in a row must see it, each on its own, and they
must agree.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from segfloor_ros.camera.model import Mount
from segfloor_ros.geometry import Array, invert, rotation_angle, transform_points
from segfloor_ros.slam.images import Images
from segfloor_ros.slam.keyframe_record import KeyframeRecord
from segfloor_ros.slam.place_recognition import PlaceRecognition
from segfloor_ros.slam.places import views_near
from segfloor_ros.slam.results import NO_POINT
from segfloor_ros.slam.sparse_map import SparseMap
from segfloor_ros.slam.track import Track

RECENT = 20
"""The latest keyframes, which a path leaves behind it, are no place that is seen again."""

MIN_SHARED = 15
MIN_SHARED_PART = 0.25
"""Keyframes that share so many points are joined already; fewer are shared by chance."""

MAX_DRIFT = 0.04
"""Drift of a path, m per m: stereo odometry drifts by one per cent or less."""

MAX_TURN_DRIFT_RADPM = 0.01
LEAST_DRIFT_M = 0.02
LEAST_DRIFT_RAD = 0.005
"""Less is no drift: the local adjustments take it away."""

FREE_DRIFT_M = 0.3
FREE_DRIFT_RAD = 0.1

CANDIDATES = 2
CONFIRMATIONS = 3
"""Keyframes in a row that must see the place."""

MAX_MISSES = 1
MIN_MOVED_M = 0.2
MIN_TURNED_RAD = 0.2
"""So far the camera must have moved while it saw the place, or turned: what is alike from one place
differs from the next."""

AGREE_M = 0.05
AGREE_RAD = 0.02
"""Keyframes in a row must tell the same drift up to this and a share of the depth of the view."""

AGREE_DEPTH_SHARE = 0.02
MAX_STEP_UP_M = 0.1
MAX_SLOPE = 0.15
MAX_TILT_RAD = 0.2
"""Where a robot stands on the same floor again, its camera is about as high and as level as before:
floors slope, and carts shake."""

MIN_BACK = 15
MIN_BACK_SHARE = 0.6
MAX_BACK_PX = 4.0
"""The points of the keyframe must be where the place's own view shows what they are."""


@dataclass(frozen=True)
class Match:
    """A keyframe that sees a place of the map again. place: the keyframe that knows it best, both
    by index. T_camera_world: (4, 4) the keyframe's camera as seen from there. rows, ids: (N,)
    features and the place's points they show, stable_ids: (N,) of these.
    """

    keyframe: int
    place: int
    T_camera_world: Array
    rows: NDArray[np.intp]
    ids: NDArray[np.int32]
    stable_ids: NDArray[np.int32]


class LoopDetector:
    """Looks for loops, keyframe by keyframe."""

    def __init__(self, sparse_map: SparseMap, places: PlaceRecognition) -> None:
        self._map = sparse_map
        self._places = places
        self.reset()

    def reset(self) -> None:
        """Believe in no loop."""
        self._matches: list[Match] = []
        self._misses = 0

    def detect(
        self, keyframe: KeyframeRecord, images: Images, offset_px: float, mount: Mount | None
    ) -> list[Match]:
        """Return the keyframes that see a place again, once there are enough of them, else none."""
        near, far = self._sides(keyframe)
        if not far.any():
            self.reset()
            return []
        known = self._map.points_of(np.flatnonzero(near))
        if self._matches:
            match = self._follow(keyframe, images, offset_px, far, known)
        else:
            match = self._find(keyframe, images, offset_px, far, known)
        if match is not None and self._is_sound(keyframe, match, mount):
            self._matches.append(match)
            self._misses = 0
        elif self._matches:
            self._misses += 1
            if self._misses > MAX_MISSES:
                self.reset()
        if not self._is_certain():
            return []
        matches = self._matches
        self.reset()
        return matches

    def _sides(self, keyframe: KeyframeRecord) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return which keyframes (K,) a view is joined to already, and which of the others it may
        have come back to.
        """
        keyframes = self._map.keyframes
        own = keyframe.point_id[keyframe.point_id != NO_POINT]
        joined, shared = self._map.covisible(own)
        near = np.arange(len(keyframes)) > keyframe.index - RECENT
        near[joined[shared > max(MIN_SHARED, MIN_SHARED_PART * len(own))]] = True
        retired = np.array([k.retired is not None for k in keyframes])
        return near, ~near & ~retired & self._within_drift(keyframe)

    def _within_drift(self, keyframe: KeyframeRecord) -> NDArray[np.bool_]:
        """Return whether each keyframe (K,) stands so near that the path between may have drifted
        by as much, and looks about the same way.
        """
        poses = np.stack([k.T_world_camera for k in self._map.keyframes])
        distance = np.linalg.norm(poses[:, :3, 3] - keyframe.T_world_camera[:3, 3], axis=1)
        cosine = poses[:, :3, 2] @ keyframe.T_world_camera[:3, 2]
        reach = FREE_DRIFT_M + MAX_DRIFT * path_lengths(self._map, keyframe.index)
        # A view shows a place also from some way before and behind it.
        return (distance < reach + 1.0) & (cosine > 0.7)

    def _find(
        self,
        keyframe: KeyframeRecord,
        images: Images,
        offset_px: float,
        far: NDArray[np.bool_],
        known: NDArray[np.int32],
    ) -> Match | None:
        """Look for a place by its look."""
        score = self._places.score(keyframe.features) * far
        for group in self._places.groups(score, CANDIDATES):
            ids = np.setdiff1d(self._map.points_of(group), known).astype(np.int32)
            track = self._places.locate(images, keyframe.features, ids, offset_px)
            if track is not None:
                return self._match(keyframe, track, far)
        return None

    def _follow(
        self,
        keyframe: KeyframeRecord,
        images: Images,
        offset_px: float,
        far: NDArray[np.bool_],
        known: NDArray[np.int32],
    ) -> Match | None:
        """Look for the place where the keyframes before saw it."""
        pose = keyframe.T_camera_world @ self._drift(self._matches[-1])
        around = views_near(self._map, pose, self._depth(keyframe), len(self._map.keyframes))
        around = around[far[around]][:RECENT]
        ids = np.setdiff1d(self._map.points_of(around), known).astype(np.int32)
        track = self._places.confirm(images, keyframe.features, ids, pose, offset_px)
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

    def _drift(self, match: Match) -> Array:
        """Return the (4, 4) that brings the place's coordinates into the keyframe's own."""
        own = self._map.keyframes[match.keyframe].T_camera_world
        return invert(own) @ match.T_camera_world

    def _is_sound(self, keyframe: KeyframeRecord, match: Match, mount: Mount | None) -> bool:
        """Whether a match is possible, level, and holds in both directions."""
        length = path_lengths(self._map, keyframe.index)[match.place]
        moved = match.T_camera_world @ keyframe.T_world_camera
        moved_m, turned = float(np.linalg.norm(moved[:3, 3])), rotation_angle(moved[:3, :3])
        drifted = moved_m > LEAST_DRIFT_M or turned > LEAST_DRIFT_RAD
        possible = (
            moved_m <= FREE_DRIFT_M + MAX_DRIFT * length
            and turned <= FREE_DRIFT_RAD + MAX_TURN_DRIFT_RADPM * length
        )
        return (
            drifted
            and possible
            and self._is_level(match, mount)
            and self._holds_back(keyframe, match)
        )

    def _is_level(self, match: Match, mount: Mount | None) -> bool:
        """Whether the robot stands on the floor of the place, as far as the mount is known."""
        if mount is None:
            return True
        place = self._map.keyframes[match.place]
        T_base_left = mount.T_base_left
        T_place_now = place.T_camera_world @ invert(match.T_camera_world)
        T = T_base_left @ T_place_now @ invert(T_base_left)
        up_m = abs(T[2, 3]) - MAX_SLOPE * float(np.linalg.norm(T[:2, 3]))
        tilt = float(np.arccos(np.clip(T[2, 2], -1.0, 1.0)))
        return bool(up_m <= MAX_STEP_UP_M and tilt <= MAX_TILT_RAD)

    def _holds_back(self, keyframe: KeyframeRecord, match: Match) -> bool:
        """Whether the keyframe's own points lie where the place's keyframe sees what they match."""
        own = keyframe.point_id[match.rows]
        point, holder, row = self._map.edges_of(match.ids)
        of_place = holder == match.place
        slot = np.searchsorted(np.sort(match.ids), point[of_place])
        slot = np.argsort(match.ids)[slot]
        measured = own[slot] != NO_POINT
        slot, row = slot[measured], row[of_place][measured]
        if len(slot) < MIN_BACK:
            return False
        place = self._map.keyframes[match.place]
        T_place_world = place.T_camera_world @ invert(match.T_camera_world)
        local = transform_points(keyframe.T_camera_world, self._map.xyz_world[own[slot]])
        seen = self._places.project(transform_points(T_place_world, local))
        apart = np.linalg.norm(seen - place.observations.uvd_px[row, :2], axis=1)
        return float((apart < MAX_BACK_PX).mean()) >= MIN_BACK_SHARE

    def _is_certain(self) -> bool:
        """Whether enough keyframes agree, over enough of a motion."""
        if len(self._matches) < CONFIRMATIONS:
            return False
        first, last = (self._matches[k].T_camera_world for k in (0, -1))
        motion = last @ invert(first)
        moved = float(np.linalg.norm(motion[:3, 3])) >= MIN_MOVED_M
        if not (moved or rotation_angle(motion[:3, :3]) >= MIN_TURNED_RAD):
            return False
        latest = self._matches[-1]
        keyframe = self._map.keyframes[latest.keyframe]
        limit_m = AGREE_M + AGREE_DEPTH_SHARE * self._depth(keyframe)
        for match in self._matches[:-1]:
            # Both drifts, at the latest keyframe.
            apart = keyframe.T_camera_world @ self._drift(match) @ invert(latest.T_camera_world)
            if np.linalg.norm(apart[:3, 3]) > limit_m or rotation_angle(apart[:3, :3]) > AGREE_RAD:
                return False
        return True

    def _depth(self, keyframe: KeyframeRecord) -> float:
        """Return the median depth of what a keyframe sees."""
        ids = keyframe.point_id[keyframe.point_id != NO_POINT]
        depth = transform_points(keyframe.T_camera_world, self._map.xyz_world[ids])[:, 2]
        return max(float(np.median(depth)), 0.5) if len(ids) else 0.5


def path_lengths(sparse_map: SparseMap, index: int) -> Array:
    """Return the length (K,) in metres of the shortest way from a keyframe to each other one, over
    keyframes that share points: what drift builds up along.
    """
    i, j = sparse_map.links()
    i = np.append(i, [loop.i for loop in sparse_map.loops]).astype(np.int32)
    j = np.append(j, [loop.j for loop in sparse_map.loops]).astype(np.int32)
    centres = np.stack([k.T_world_camera[:3, 3] for k in sparse_map.keyframes])
    weight = np.linalg.norm(centres[i] - centres[j], axis=1) + 1e-6
    graph = sparse.csr_matrix((weight, (i, j)), shape=(len(centres), len(centres)))
    return np.asarray(dijkstra(graph, directed=False, indices=[index]))[0]
