"""Loops: a place of the map that is seen again after the path has drifted.

Precision comes first: a loop that is missed costs drift, a false one costs the map. The place must
lie where drift can have put it, several keyframes in a row must see it, each on its own, and they
must agree on drift and floor, and see the same space from both sides.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from segfloor_ros.geometry import Array, invert, is_within, transform_points
from segfloor_ros.slam.places.ground_views import motion_between, seen_ahead_m
from segfloor_ros.slam.places.known_views import ALIKE_SHARE, views_near
from segfloor_ros.slam.places.place_recognition import (
    BEST_GROUPS,
    PlaceRecognition,
    greatest_speed_mps,
)
from segfloor_ros.slam.results import ENOUGH, MOST, NO_POINT, PROOF, SAME, Track
from segfloor_ros.slam.rig import MIN_DEPTH_M, NEIGHBOURS, SAME_PX, in_view
from segfloor_ros.slam.sparse_map import LINK_SIGMA, LOOP_FACTOR, KeyframeRecord, Match, SparseMap
from segfloor_ros.slam.tracking.map_tracking import Pixels

MAX_MISSES = 1

DRIFT_PER_M = 0.04, 0.01
"""Drift of a path in m and rad per m: stereo odometry drifts by one per cent or less."""

FREE_DRIFT = 0.3, 0.1
"""Drift, in m and rad, of the shortest of ways."""

MAX_STEP_UP_M, MAX_SLOPE = 0.1, 0.2
"""Where a robot stands on the same floor again, its camera is about as high and, in rad, as level
as before: floors slope, and carts shake."""

SAME_WAY = 0.7
"""Cosine between two views up to which the same points are seen; beyond, the floor is."""

IN_FRONT_SHARE = 0.1
"""A point is in front of another on its ray where its disparity is larger by this share."""

MAX_SEEN_THROUGH = 0.2
"""Share of points that the other side may see through: edges hide what is behind by a few pixels.
"""

MIN_MOTION = 0.2, 0.2
"""So far, in m or rad, the camera must have moved while it saw the place: what is alike from one
place differs from the next."""

AGREE = 0.05, 0.02
"""Keyframes in a row must show the same drift up to this, in m and rad, at the depth of the view.
"""


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

    def __init__(self, sparse_map: SparseMap, places: PlaceRecognition) -> None:
        self.candidates: list[Candidate] = []
        self._map = sparse_map
        self._places = places
        self._checks = LoopChecks(sparse_map)
        self.reset()

    def reset(self) -> None:
        """Believe in no loop."""
        self._sightings = Sightings(self._map)

    def detect(self, keyframe: KeyframeRecord, images: Pixels) -> list[Match]:
        """Return the keyframes that see a place again, once there are enough of them, else none."""
        lengths = path_lengths(self._map, keyframe.index)
        near, far = self._sides(keyframe, lengths)
        known = self._map.points_of(np.flatnonzero(near))
        look = self._follow if self._sightings.matches else self._find
        match = look(keyframe, images, far, known) if far.any() else None
        match = match or self._from_above(keyframe, ~near, lengths)
        if match is None and not far.any():
            self.reset()
            return []
        is_sound = match is not None and self._is_sound(keyframe, match, lengths)
        if not self._sightings.add(match if is_sound else None):
            return []
        matches = self._sightings.matches
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
        near = np.arange(len(keyframes)) > keyframe.index - NEIGHBOURS
        near[linked[shared > max(ENOUGH, ALIKE_SHARE * len(own))]] = True
        retired = np.array([k.retired is not None for k in keyframes])
        return near, ~near & ~retired & self._within_drift(keyframe, lengths)

    def _within_drift(self, keyframe: KeyframeRecord, lengths: Array) -> NDArray[np.bool_]:
        """Return whether each keyframe (K,) stands so near that the path between may have drifted
        by as much, and looks about the same way.
        """
        poses = invert(np.stack([k.T_camera_world for k in self._map.keyframes]))
        distance = np.linalg.norm(poses[:, :3, 3] - keyframe.T_world_camera[:3, 3], axis=1)
        cosine = poses[:, :3, 2] @ keyframe.T_world_camera[:3, 2]
        reach = FREE_DRIFT[0] + DRIFT_PER_M[0] * lengths
        # A view shows a place also from some way before and behind it.
        return (distance < reach + 1.0) & (cosine > SAME_WAY)

    def _from_above(
        self, keyframe: KeyframeRecord, others: NDArray[np.bool_], lengths: Array
    ) -> Match | None:
        """Look for the floor of other keyframes (K,) that look another way; None where they do not
        agree.
        """
        mount, keyframes = self._map.rig.mount, self._map.keyframes
        if mount is None or not len(keyframe.ground.xy_m):
            return None
        T_left_base = invert(mount.T_base_left)
        middle = T_left_base @ np.array([seen_ahead_m(mount), 0.0, 0.0, 1.0])
        poses = invert(np.stack([k.T_camera_world for k in keyframes]))
        distance = np.linalg.norm((poses - keyframe.T_world_camera) @ middle, axis=1)
        turned = poses[:, :3, 2] @ keyframe.T_world_camera[:3, 2] <= SAME_WAY
        reach = FREE_DRIFT[0] + DRIFT_PER_M[0] * lengths + seen_ahead_m(mount)
        shown = np.array([len(k.ground.xy_m) > 0 for k in keyframes])
        near = np.flatnonzero(others & turned & shown & (distance < reach))
        found: list[Match] = []
        nothing = np.zeros(0, np.intp), np.zeros(0, np.int32), np.zeros(0, np.int32)
        for place in near[np.argsort(distance[near])][:PROOF].tolist():
            ground = keyframes[place].ground
            T_base_place = motion_between(keyframe.ground, ground, mount.height_m)
            if T_base_place is not None:
                T_camera_place = T_left_base @ T_base_place @ mount.T_base_left
                pose = T_camera_place @ keyframes[place].T_camera_world
                found.append(Match(keyframe.index, place, pose, *nothing))
        if not found:
            return None
        back = invert(found[0].T_camera_world)
        agree = all(is_within(match.T_camera_world @ back, AGREE) for match in found[1:])
        return found[0] if agree else None

    def _find(
        self,
        keyframe: KeyframeRecord,
        images: Pixels,
        far: NDArray[np.bool_],
        known: NDArray[np.int32],
    ) -> Match | None:
        """Look for a place by its look."""
        score = self._places.score(keyframe.features) * far
        for group in self._places.groups(score, BEST_GROUPS):
            ids = np.setdiff1d(self._map.points_of(group), known).astype(np.int32)
            track = self._places.locate(images, keyframe.features, ids)
            if track is not None:
                return match_of(self._map, keyframe, track, far)
        return None

    def _follow(
        self,
        keyframe: KeyframeRecord,
        images: Pixels,
        far: NDArray[np.bool_],
        known: NDArray[np.int32],
    ) -> Match | None:
        """Look for the place where the keyframes before saw it."""
        pose = keyframe.T_camera_world @ drift(self._map, self._sightings.matches[-1])
        around = views_near(
            self._map, pose, median_depth_m(self._map, keyframe), len(self._map.keyframes)
        )
        around = around[far[around]][:NEIGHBOURS]
        ids = np.setdiff1d(self._map.points_of(around), known).astype(np.int32)
        track = self._places.confirm(images, keyframe.features, ids, pose)
        return None if track is None else match_of(self._map, keyframe, track, far)


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


class LoopChecks:
    """Judges whether a keyframe can see a place: of its own map again, or of another, known one."""

    def __init__(self, sparse_map: SparseMap, known: SparseMap | None = None) -> None:
        self._map = sparse_map
        self._camera = sparse_map.rig.camera
        self._known = known or sparse_map

    def objection_to_drift(self, keyframe: KeyframeRecord, match: Match, length_m: float) -> str:
        """Return what speaks against a match in the same map: a way of length_m cannot have drifted
        so far, or has not drifted; '' for nothing.
        """
        moved = match.T_camera_world @ keyframe.T_world_camera
        sigma_m, sigma_rad = LINK_SIGMA
        if is_within(moved, (LOOP_FACTOR * sigma_m, LOOP_FACTOR * sigma_rad)):
            return 'no drift'
        (free_m, free_rad), (per_m, rad_per_m) = FREE_DRIFT, DRIFT_PER_M
        reach = free_m + per_m * length_m, free_rad + rad_per_m * length_m
        return '' if is_within(moved, reach) else 'more than drift'

    def is_within_reach(self, match: Match) -> bool:
        """Whether the robot can have come there while it was lost: from the last keyframe of the
        known map to the first of its own.
        """
        first, known = self._map.keyframes[0], self._known.keyframes
        T_own_known = drift(self._map, match)
        way = known[-1].T_camera_world @ invert(first.T_camera_world @ T_own_known)
        lost_s = 1e-9 * (first.stamp_ns - known[-1].stamp_ns)
        return bool(np.linalg.norm(way[:3, 3]) <= SAME[0] + greatest_speed_mps(known) * lost_s)

    def objection(self, keyframe: KeyframeRecord, match: Match) -> str:
        """Return what else speaks against a match, '' for nothing."""
        if not self.is_level(match):
            return 'another floor'
        if len(match.rows) and not self._holds_back(keyframe, match):
            return 'not seen from the other side'
        if self._seen_through(keyframe, match) > MAX_SEEN_THROUGH:
            return 'free space through obstacles'
        return ''

    def is_level(self, match: Match) -> bool:
        """Whether the robot stands on the floor of the place, as far as the mount is known."""
        mount = self._map.rig.mount
        if mount is None:
            return True
        place = self._known.keyframes[match.place]
        T_base_left = mount.T_base_left
        T_place_now = place.T_camera_world @ invert(match.T_camera_world)
        T = T_base_left @ T_place_now @ invert(T_base_left)
        up_m = abs(T[2, 3]) - MAX_SLOPE * float(np.linalg.norm(T[:2, 3]))
        tilt = float(np.arccos(np.clip(T[2, 2], -1.0, 1.0)))
        return bool(up_m <= MAX_STEP_UP_M and tilt <= MAX_SLOPE)

    def _holds_back(self, keyframe: KeyframeRecord, match: Match) -> bool:
        """Whether the keyframe's own points lie where the place's keyframe sees what they match."""
        own = keyframe.point_id[match.rows]
        point, holder, row = self._known.edges_of(match.ids)
        of_place = holder == match.place
        slot = np.searchsorted(np.sort(match.ids), point[of_place])
        slot = np.argsort(match.ids)[slot]
        measured = own[slot] != NO_POINT
        slot, row = slot[measured], row[of_place][measured]
        if len(slot) < ENOUGH:
            return False
        place = self._known.keyframes[match.place]
        T_place_world = place.T_camera_world @ invert(match.T_camera_world)
        local = transform_points(keyframe.T_camera_world, self._map.xyz_world[own[slot]])
        uvd, _ = in_view(self._camera, transform_points(T_place_world, local))
        gap = np.linalg.norm(uvd[:, :2] - place.observations.uvd_px[row, :2], axis=1)
        return float((gap < SAME_PX).mean()) >= MOST

    def _seen_through(self, keyframe: KeyframeRecord, match: Match) -> float:
        """Return the larger share of the points of one side that the other sees through, were both
        the same place: the rays to what is seen are free.
        """
        place = self._known.keyframes[match.place]
        own = keyframe.point_id[keyframe.point_id != NO_POINT]
        known = place.point_id[place.point_id != NO_POINT]
        if self._known is self._map:
            own = np.setdiff1d(own, known)
        in_now = transform_points(keyframe.T_camera_world, self._map.xyz_world[own])
        in_place = transform_points(place.T_camera_world, self._known.xyz_world[known])
        T_place_now = place.T_camera_world @ invert(match.T_camera_world)
        return max(
            self._share_in_front(transform_points(T_place_now, in_now), in_place),
            self._share_in_front(transform_points(invert(T_place_now), in_place), in_now),
        )

    def _share_in_front(self, points: Array, seen: Array) -> float:
        """Return the share of points (N, 3) that lie in front of what a camera sees (M, 3) beside
        them, both in its optical frame; 0 where few can be compared.
        """
        uvd, valid = in_view(self._camera, points)
        uvd_seen, _ = in_view(self._camera, seen)
        uvd, uvd_seen = uvd[valid], uvd_seen[np.isfinite(uvd_seen[:, 0])]
        if not len(uvd) or not len(uvd_seen):
            return 0.0
        gap, near = cKDTree(uvd_seen[:, :2]).query(uvd[:, :2], distance_upper_bound=SAME_PX)
        beside = np.isfinite(gap)
        if beside.sum() < ENOUGH:
            return 0.0
        behind = uvd_seen[np.asarray(near)[beside], 2]
        margin = np.maximum(SAME_PX, IN_FRONT_SHARE * behind)
        return float((uvd[beside, 2] - behind > margin).mean())


def match_of(
    known: SparseMap, keyframe: KeyframeRecord, track: Track, may_be: NDArray[np.bool_]
) -> Match | None:
    """Return what a keyframe that was found in a map sees of it. may_be: which keyframes of the map
    (K,) may be the place; None where none of them sees the same.
    """
    assert track.observed is not None
    rows = np.flatnonzero(track.observed.point_id != NO_POINT)
    ids = track.observed.point_id[rows]
    order, _ = known.covisible(ids)
    order = order[may_be[order]]
    if len(order) == 0:
        return None
    stable_ids = known.stable_id[ids]
    return Match(keyframe.index, int(order[0]), track.T_camera_world, rows, ids, stable_ids)


class Sightings:
    """Keyframes in a row, all but `MAX_MISSES`, that see a place. times: as many of them, over as
    long a motion, are asked for as for a loop.
    """

    def __init__(self, sparse_map: SparseMap, times: int = 1) -> None:
        self.matches: list[Match] = []
        self._map = sparse_map
        self._times = times
        self._misses = 0

    def add(self, match: Match | None) -> bool:
        """Take in what the next keyframe sees of the place; returns whether enough of them agree,
        over enough of a motion.
        """
        self._misses = self._misses + 1 if match is None else 0
        if match is not None:
            self.matches.append(match)
        elif self._misses > MAX_MISSES:
            self.matches = []
        return self._are_certain()

    def _are_certain(self) -> bool:
        if len(self.matches) < self._times * PROOF:
            return False
        latest = self.matches[-1]
        motion = latest.T_camera_world @ invert(self.matches[0].T_camera_world)
        if is_within(motion, (self._times * MIN_MOTION[0], self._times * MIN_MOTION[1])):
            return False
        keyframe = self._map.keyframes[latest.keyframe]
        reach = AGREE[0] + AGREE[1] * median_depth_m(self._map, keyframe), AGREE[1]
        # Both drifts, at the latest keyframe.
        back = invert(latest.T_camera_world)
        gaps = (keyframe.T_camera_world @ drift(self._map, m) @ back for m in self.matches[:-1])
        return all(is_within(gap, reach) for gap in gaps)


def drift(sparse_map: SparseMap, match: Match) -> Array:
    """Return the (4, 4) that brings a place's coordinates into those of the keyframe's map."""
    own = sparse_map.keyframes[match.keyframe].T_camera_world
    return invert(own) @ match.T_camera_world


def median_depth_m(sparse_map: SparseMap, keyframe: KeyframeRecord) -> float:
    """Return the median depth of what a keyframe sees."""
    ids = keyframe.point_id[keyframe.point_id != NO_POINT]
    depth = transform_points(keyframe.T_camera_world, sparse_map.xyz_world[ids])[:, 2]
    return max(float(np.median(depth)), MIN_DEPTH_M) if len(ids) else MIN_DEPTH_M
