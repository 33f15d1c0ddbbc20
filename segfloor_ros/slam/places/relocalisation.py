"""Relocalisation: where in the whole map a camera is that does not know.

A known map that the camera is not found in: the drive maps on its own until it recognises it.

It was saved by another drive, or made by this one before it got lost. The two maps stay separate.
Several keyframes in a row must see the known map and agree on where it lies; then the drive's own
map is brought into it (Campos et al., ORB-SLAM3, IEEE T-RO 2021, section VI: map merging).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array, invert, rotation_angle
from segfloor_ros.map_file import Arrays
from segfloor_ros.slam.map.map_arrays import fill_map, map_to_arrays, moved
from segfloor_ros.slam.map.records import KeyframeRecord, LoopEdge, Match
from segfloor_ros.slam.map.sparse_map import SparseMap
from segfloor_ros.slam.places.known_views import views_near
from segfloor_ros.slam.places.loop_checks import (
    LoopChecks,
    are_certain,
    drift,
    greatest_speed_mps,
    median_depth_m,
)
from segfloor_ros.slam.places.loop_closing import fuse_latest, merge_pairs
from segfloor_ros.slam.places.loops import MAX_MISSES
from segfloor_ros.slam.places.place_recognition import PlaceRecognition
from segfloor_ros.slam.results import NO_POINT, Track
from segfloor_ros.slam.rig import LOCAL_KEYFRAMES, NEIGHBOURS, Rig
from segfloor_ros.slam.tracking.features import Features
from segfloor_ros.slam.tracking.images import Images

BEST_GROUPS = 2
"""Places tried with every frame; one more is tried in turn: words alone are not sure."""

SAME_M = 0.5
SAME_RAD = 0.3
"""Two finds further apart than this are two places that look alike."""

FRAMES_IN_A_ROW = 2
STEP_RAD = 2 * SAME_RAD
MIN_AGREEMENT = 0.7
"""Away from where it was lost, so many frames must find the camera, each as far from where the one
before did as it can have moved since, and show what is expected in so many parts of the image: a
shelf that stands twice in a building shows now and then enough for one frame, by chance."""

NARROW_SEARCHES = 100
"""Frames for which only the neighbourhood of a given pose is searched: it may be wrong."""

VIEW_REACH_M = 2.0
"""A view shows a place also from so far before or behind where a keyframe stands."""

MAX_VIEW_TURN_RAD = 1.0

TIMES_A_LOOP = 2
"""No drift limits where the known map can be: so many times the sightings of a loop are asked for.
With as many as for a loop, walls with the same paper were taken for one. A camera that got lost can
be no further away than it can have driven, too.
"""


class Relocaliser:
    """Looks for a view in the map, some places per frame."""

    def __init__(self, sparse_map: SparseMap, places: PlaceRecognition) -> None:
        self._map = sparse_map
        self._places = places
        self._turn = 0
        self.reset()

    def reset(self) -> None:
        """Search the whole map, and forget what was found in it."""
        self._near: tuple[Array, float, float] | None = None
        self._searches_left = 0
        self._last_found: tuple[int, Array] | None = None
        self._in_a_row = 0

    def search_near(self, T_world_camera: Array, reach_m: float, reach_rad: float) -> None:
        """Look around a pose (4, 4) alone, for some time or until the camera is found."""
        self._near = T_world_camera, reach_m, reach_rad
        self._searches_left = NARROW_SEARCHES

    @property
    def is_narrow(self) -> bool:
        """Whether only the neighbourhood of a given pose is searched."""
        return self._near is not None and self._searches_left > 0

    def find_surely(
        self,
        images: Images,
        features: Features,
        stamp_ns: int,
        is_possible: Callable[[Array], bool] | None = None,
        lost_at: Array | None = None,
    ) -> Track | None:
        """Return a frame with its pose as `find` does; None until enough frames in a row are found
        there, or one around a given pose or where the camera was lost (T_camera_world, (4, 4)).
        """
        given = self.is_narrow
        found = self.find(images, features, is_possible)
        expected = found is not None and (given or _follows(found, lost_at, SAME_M))
        if found is None or not (expected or self._places.agreement(found) >= MIN_AGREEMENT):
            self._last_found, self._in_a_row = None, 0
            return None
        before_ns, last = self._last_found or (stamp_ns, None)
        way_m = greatest_speed_mps(self._map.keyframes) * 1e-9 * (stamp_ns - before_ns)
        self._in_a_row = self._in_a_row + 1 if _follows(found, last, SAME_M + way_m) else 1
        self._last_found = stamp_ns, found.T_camera_world
        if self._in_a_row < FRAMES_IN_A_ROW and not expected:
            return None
        self._last_found, self._near = None, None
        return found

    def find(
        self,
        images: Images,
        features: Features,
        is_possible: Callable[[Array], bool] | None = None,
    ) -> Track | None:
        """Return a frame with its pose; None where no place of the map is seen, or two that look
        alike. is_possible: whether the camera can be at a pose T_camera_world (4, 4).
        """
        score = self._places.score(features) * self._allowed()
        groups = self._places.groups(score, LOCAL_KEYFRAMES)
        chosen, others = groups[:BEST_GROUPS], groups[BEST_GROUPS:]
        if others:
            chosen.append(others[self._turn % len(others)])
            self._turn += 1
        found = []
        for group in chosen:
            ids = self._map.points_of(group)
            track = self._places.locate(images, features, ids)
            if track is None or not self._is_near(track):
                continue
            if is_possible is None or is_possible(track.T_camera_world):
                found.append(track)
        if not found or any(_differ(found[0], other) for other in found[1:]):
            return None
        return max(found, key=lambda track: len(track.point_ids))

    def _allowed(self) -> NDArray[np.bool_]:
        """Return the keyframes (K,) that may show where the camera is."""
        keyframes = self._map.keyframes
        if self._near is None or self._searches_left == 0:
            return np.ones(len(keyframes), bool)
        self._searches_left -= 1
        T_world_camera, reach_m, reach_rad = self._near
        poses = np.stack([k.T_world_camera for k in keyframes])
        distance = np.linalg.norm(poses[:, :3, 3] - T_world_camera[:3, 3], axis=1)
        turned = np.arccos(np.clip(poses[:, :3, 2] @ T_world_camera[:3, 2], -1.0, 1.0))
        return (distance < reach_m + VIEW_REACH_M) & (turned < reach_rad + MAX_VIEW_TURN_RAD)

    def _is_near(self, track: Track) -> bool:
        if self._near is None or self._searches_left == 0:
            return True
        T_world_camera, reach_m, reach_rad = self._near
        return is_within(track.T_camera_world @ T_world_camera, reach_m, reach_rad)


def is_within(motion: Array, reach_m: float, reach_rad: float) -> bool:
    """Whether a motion (4, 4) is at most so far and so much of a turn."""
    moved_m = float(np.linalg.norm(motion[:3, 3]))
    return moved_m <= reach_m and rotation_angle(motion[:3, :3]) <= reach_rad


def _follows(found: Track, T_camera_world: Array | None, reach_m: float) -> bool:
    """Whether a frame is within reach of where a camera was before (4, 4), if that is known."""
    if T_camera_world is None:
        return False
    return is_within(found.T_camera_world @ invert(T_camera_world), reach_m, STEP_RAD)


def _differ(a: Track, b: Track) -> bool:
    return not is_within(a.T_camera_world @ invert(b.T_camera_world), SAME_M, SAME_RAD)


@dataclass(frozen=True)
class Sighting:
    """A keyframe of the drive's own map that sees the known one. own_ids, known_ids: (N,) stable
    ids of points that both have.
    """

    match: Match
    own_ids: NDArray[np.int32]
    known_ids: NDArray[np.int32]


class KnownMap:
    """The known map, beside the drive's own. of_drive: whether this drive made it, and got lost."""

    def __init__(
        self,
        rig: Rig,
        own: SparseMap,
        arrays: Arrays,
        of_drive: bool,
    ) -> None:
        self._own = own
        self._of_drive = of_drive
        self._camera = rig.camera
        self._map = SparseMap()
        fill_map(self._map, arrays)
        self._places = PlaceRecognition(rig, self._map)
        self._places.from_arrays(arrays)
        self._relocaliser = Relocaliser(self._map, self._places)
        self._checks = LoopChecks(rig, own, self._map)
        self._sightings: list[Sighting] = []
        self._misses = 0

    def recognise(self, keyframe: KeyframeRecord, images: Images) -> bool:
        """Whether enough keyframes in a row see the known map, this one the last of them."""
        match = self._look(keyframe, images)
        if match is not None and self._is_possible(keyframe, match):
            self._sightings.append(self._sighting(keyframe, match))
            self._misses = 0
        else:
            self._misses += 1
            if self._misses > MAX_MISSES:
                self._sightings = []
        matches = [sighting.match for sighting in self._sightings]
        return are_certain(self._own, matches, TIMES_A_LOOP)

    def _is_possible(self, keyframe: KeyframeRecord, match: Match) -> bool:
        if self._of_drive and not self._checks.is_within_reach(match):
            return False
        return not self._checks.objection(keyframe, match)

    def is_seen(self, images: Images, features: Features, stamp_ns: int) -> bool:
        """Whether enough frames in a row see the known map, this one the last of them."""
        found = self._relocaliser.find_surely(images, features, stamp_ns)
        return found is not None

    def _look(self, keyframe: KeyframeRecord, images: Images) -> Match | None:
        """Look for the view where the keyframes before saw it, else in the whole known map."""
        features = keyframe.features
        if self._sightings:
            pose = keyframe.T_camera_world @ drift(self._own, self._sightings[-1].match)
            depth_m = median_depth_m(self._own, keyframe)
            around = self._map.points_of(views_near(self._map, pose, depth_m, NEIGHBOURS))
            track = self._places.confirm(images, features, around, pose)
        else:
            track = self._relocaliser.find(images, features)
        if track is None or track.observed is None:
            return None
        rows = np.flatnonzero(track.observed.point_id != NO_POINT)
        ids = track.observed.point_id[rows]
        order, _ = self._map.covisible(ids)
        stable_ids = self._map.stable_id[ids]
        return Match(keyframe.index, int(order[0]), track.T_camera_world, rows, ids, stable_ids)

    def _sighting(self, keyframe: KeyframeRecord, match: Match) -> Sighting:
        own = keyframe.point_id[match.rows]
        both = own != NO_POINT
        return Sighting(match, self._own.stable_id[own[both]].copy(), match.stable_ids[both])

    def merge(self, own_words: Arrays) -> Arrays:
        """Merge the drive's own map into the known one, with the same ids and stamps. Returns the
        words of all keyframes.
        """
        latest = self._sightings[-1].match
        T_known_own = invert(drift(self._own, latest))
        before = len(self._map.keyframes)
        arrays = moved(map_to_arrays(self._own), T_known_own)
        known = self.to_arrays()
        self.restore(known)
        fill_map(self._own, arrays)
        for sighting in self._sightings:
            match, i = sighting.match, before + sighting.match.keyframe
            place = self._own.keyframes[match.place]
            T_i_j = match.T_camera_world @ place.T_world_camera
            self._own.loops.append(LoopEdge(i, match.place, T_i_j))
            merge_pairs(self._own, self._rows(sighting.own_ids), self._rows(sighting.known_ids))
        fuse_latest(self._camera, self._own, before + latest.keyframe)
        return {name: np.concatenate([known[name], own_words[name]]) for name in own_words}

    def to_arrays(self) -> Arrays:
        """Return the known map and the words of its keyframes."""
        return map_to_arrays(self._map) | self._places.to_arrays()

    def restore(self, known: Arrays) -> None:
        """Put the known map, as `to_arrays` returns it, in the place of the drive's own."""
        self._own.reset()
        fill_map(self._own, known)

    def _rows(self, stable_ids: NDArray[np.int32]) -> NDArray[np.intp]:
        """Return the rows (N,) of points in the merged map, -1 for those that are gone."""
        rows = np.searchsorted(self._own.stable_id, stable_ids)
        rows = np.minimum(rows, len(self._own.stable_id) - 1)
        there = (self._own.stable_id[rows] == stable_ids) & self._own.alive[rows]
        return np.where(there, rows, -1)
