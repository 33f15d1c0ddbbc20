"""Places that keyframes see again: of their own map after the path has drifted, a loop, or of a
known one.

Precision comes first: a loop that is missed costs drift, a false one costs the map. What several
keyframes say for one place, by points or by the floor, by what they see through it and by how the
robot can have come there, is weighed as one sum (see `evidence`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from segfloor_ros.core.contracts import NO_POINT
from segfloor_ros.core.geometry import Array, invert, rotation_angle, transform_points
from segfloor_ros.core.slam.places.evidence import HOPELESS, PlaceEvidence, of_counts, of_errors
from segfloor_ros.core.slam.places.place_recognition import PlaceRecognition, Sightings
from segfloor_ros.core.slam.places.views import (
    ALIKE_SHARE,
    motion_between,
    novelty,
    seen_ahead_m,
    views_near,
)
from segfloor_ros.core.slam.rig import GATE, NEIGHBOURS, SAME_PX, chi2_limit, in_view
from segfloor_ros.core.slam.sparse_map import (
    LINK_SIGMA,
    LOOP_FACTOR,
    KeyframeRecord,
    Match,
    SparseMap,
    features_of,
    loop_sigma,
    median_depth_m,
)
from segfloor_ros.core.slam.thresholds import ENOUGH, PROOF
from segfloor_ros.core.slam.tracking.map_tracking import MIN_VIEW_COSINE, Pixels
from segfloor_ros.core.slam.tracking.track import Track
from segfloor_ros.core.twists import is_within

DRIFT_PER_M = 0.01, 0.0025
"""Error of a path, m and rad per m: stereo odometry drifts by one per cent or less."""

FREE_DRIFT = 0.07, 0.023
"""Error, m and rad, of the shortest of ways."""

REACH_SIGMAS = float(np.sqrt(-2 * HOPELESS))
"""Farther than so many sigmas no place is believed."""

UP_SIGMA_M, SLOPE_SIGMA = 0.025, 0.05
"""Where a robot stands on the same floor again, its camera is about as high and, in rad, as level
as before: floors slope, and carts shake."""

IN_FRONT_SHARE, MAX_SEEN_THROUGH = 0.1, 0.2
"""A point is in front of another on its ray where its disparity is larger by the first share. The
second of all points the other side may see through: edges hide what is behind by a few pixels."""


@dataclass(frozen=True)
class Candidate:
    """What became of a keyframe that saw a place, both by index, as it seemed from T_keyframe_place
    (4, 4): verdict is 'seen' for one that counts, else what spoke against it. The last of a loop
    comes once more, as 'closed', or with what spoke against the loop.
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
        self._matcher = PlaceMatcher(sparse_map, sparse_map, places)

    def reset(self) -> None:
        """Believe in no loop."""
        self._matcher.sightings.reset()

    def detect(self, keyframe: KeyframeRecord, images: Pixels) -> list[Match]:
        """Return the keyframes that see a place again, once there are enough of them, else none."""
        lengths_m, near = path_lengths(self._map, keyframe.index), self._linked(keyframe)
        reach_m, reach_rad = (REACH_SIGMAS * sigma for sigma in drift_sigma(lengths_m))
        shown = self._places.shown_from(keyframe.T_world_camera, reach_m, reach_rad)
        by_look = self._matcher.look(keyframe, images, ~near & shown, near)
        if by_look is None:
            found = self._from_above(keyframe, ~near, reach_m)
        else:  # what repeats itself fits where the path has the keyframe, too
            here = self._matcher.at(
                keyframe, images, keyframe.T_camera_world, ~near & shown, near, is_rough=True
            )
            found = [by_look, here] if here else [by_look]

        def travel(match: Match) -> float:
            return likely_drift(keyframe, match, float(lengths_m[match.place]))

        seen = self._matcher.best(keyframe, found, travel)
        if seen is not None:
            objection = 'no drift' if is_no_drift(keyframe, seen[0]) else seen[1].objection
            self._note(seen[0], objection or 'seen')
            seen = None if objection else seen
        return self._matcher.sightings.add(seen)

    def _note(self, match: Match, verdict: str) -> None:
        place = self._map.keyframes[match.place]
        T_keyframe_place = match.T_camera_world @ place.T_world_camera
        self.candidates.append(Candidate(match.keyframe, match.place, T_keyframe_place, verdict))

    def _linked(self, keyframe: KeyframeRecord) -> NDArray[np.bool_]:
        """Return which keyframes (K,) a view is linked to already."""
        own = keyframe.seen_ids
        linked, shared = self._map.covisible(own)
        near = np.arange(len(self._map.keyframes)) > keyframe.index - NEIGHBOURS
        near[linked[shared > max(ENOUGH, ALIKE_SHARE * len(own))]] = True
        return near

    def _from_above(
        self, keyframe: KeyframeRecord, others: NDArray[np.bool_], reach_m: Array
    ) -> list[Match]:
        """Look for the floor of other keyframes (K,), within reach (K,), that look another way."""
        mount, keyframes = self._map.rig.mount, self._map.keyframes
        if mount is None or not len(keyframe.ground.xy_m):
            return []
        middle = invert(mount.T_base_left) @ np.array([seen_ahead_m(mount), 0.0, 0.0, 1.0])
        poses = invert(np.stack([k.T_camera_world for k in keyframes]))
        distance = np.linalg.norm((poses - keyframe.T_world_camera) @ middle, axis=1)
        turned = poses[:, :3, 2] @ keyframe.T_world_camera[:3, 2] <= MIN_VIEW_COSINE
        shown = np.array([len(k.ground.xy_m) > 0 for k in keyframes])
        near = np.flatnonzero(others & turned & shown & (distance < reach_m + seen_ahead_m(mount)))
        return self._matcher.look_at_floor(keyframe, near[np.argsort(distance[near])[:PROOF]])


def path_lengths(sparse_map: SparseMap, index: int) -> Array:
    """Return the length (K,) in metres of the shortest way from a keyframe to each other one, over
    keyframes that share points: what drift builds up along. To where none leads it is the longest.
    """
    i, j = sparse_map.links()
    i = np.append(i, [loop.i for loop in sparse_map.loops]).astype(np.int32)
    j = np.append(j, [loop.j for loop in sparse_map.loops]).astype(np.int32)
    poses = np.stack([k.T_camera_world for k in sparse_map.keyframes])
    centres = invert(poses)[:, :3, 3]
    weight = np.linalg.norm(centres[i] - centres[j], axis=1) + 1e-6
    graph = sparse.csr_matrix((weight, (i, j)), shape=(len(centres), len(centres)))
    lengths = np.asarray(dijkstra(graph, directed=False, indices=[index]))[0]
    return np.minimum(lengths, lengths[np.isfinite(lengths)].max())


def drift_sigma(length_m: Array) -> tuple[Array, Array]:
    """Return by how much paths (K,) of a length err, in m and rad."""
    (free_m, free_rad), (per_m, rad_per_m) = FREE_DRIFT, DRIFT_PER_M
    return free_m + per_m * length_m, free_rad + rad_per_m * length_m


def likely_drift(keyframe: KeyframeRecord, match: Match, length_m: float) -> float:
    """Return how likely it is that a path of a length has drifted as a match shows, in nats."""
    T = match.T_camera_world @ keyframe.T_world_camera
    sigma_m, sigma_rad = map(float, drift_sigma(np.array(length_m)))
    moved_m, turned_rad = float(np.linalg.norm(T[:3, 3])), float(rotation_angle(T[:3, :3]))
    return of_errors((moved_m, sigma_m), (turned_rad, sigma_rad))


def is_no_drift(keyframe: KeyframeRecord, match: Match) -> bool:
    """Whether a match in the same map is where the path has it already."""
    moved = match.T_camera_world @ keyframe.T_world_camera
    return bool(is_within(moved, loop_sigma(by_floor=not len(match.rows))))


class PlaceMatcher:
    """Matches keyframes with the places of a known map, which may be their own. sightings: those
    that agree so far.
    """

    def __init__(self, own: SparseMap, known: SparseMap, places: PlaceRecognition) -> None:
        self._map = own
        self._camera = own.rig.camera
        self._known = known
        self._places = places
        self.sightings: Sightings[Match] = Sightings(self.agree, self._newness)

    def look(
        self,
        keyframe: KeyframeRecord,
        images: Pixels,
        may_show: NDArray[np.bool_],
        near: NDArray[np.bool_],
    ) -> Match | None:
        """Look for the place where the keyframes before saw it, else by its look. may_show, near:
        which keyframes (K,) of the known map may be of the place, and which are of the view itself.
        """
        before = self.sightings.views
        if before:
            pose = keyframe.T_camera_world @ drift(self._map, before[-1])
            again = self.at(keyframe, images, pose, may_show, near)
            if again is not None:
                return again
        own_ids = self._known.points_of(np.flatnonzero(near))
        is_bounded = self._known is self._map
        features = features_of(self._map, keyframe)
        track = self._places.find(images, features, may_show, own_ids, is_bounded=is_bounded)
        return None if track is None else self._match(keyframe, track, may_show)

    def at(
        self,
        keyframe: KeyframeRecord,
        images: Pixels,
        T_camera_world: Array,
        may_show: NDArray[np.bool_],
        near: NDArray[np.bool_],
        is_rough: bool = False,
    ) -> Match | None:
        """Look for the place at a pose (4, 4) alone, or, where it is rough, around it. may_show,
        near: as in `look`.
        """
        around = np.flatnonzero(may_show)
        if not is_rough:
            depth_m = median_depth_m(self._map, keyframe.seen_ids, keyframe.T_camera_world)
            around = views_near(self._known, T_camera_world, depth_m, len(may_show))
            around = around[may_show[around]][:NEIGHBOURS]
        own_ids = self._known.points_of(np.flatnonzero(near))
        ids = self._places.points_of(around, own_ids)
        features = features_of(self._map, keyframe)
        find = self._places.locate if is_rough else self._places.confirm
        track = find(images, features, ids, T_camera_world)
        return None if track is None else self._match(keyframe, track, may_show)

    def _match(self, keyframe: KeyframeRecord, track: Track, may_show: NDArray[np.bool_]) -> Match:
        """Return what a keyframe sees again where it was tracked in the known map."""
        assert track.observed is not None
        rows = np.flatnonzero(track.observed.point_id != NO_POINT)
        ids = track.observed.point_id[rows]
        order, _ = self._known.covisible(ids)
        place = int(order[may_show[order]][0])
        stable_ids, log_ratio = self._known.stable_id[ids], self._places.log_ratio(track)
        return Match(keyframe.index, place, track.T_camera_world, rows, ids, stable_ids, log_ratio)

    def look_at_floor(self, keyframe: KeyframeRecord, places: NDArray[np.intp]) -> list[Match]:
        """Return where known keyframes (N,), by index, show the same floor, from whatever side."""
        mount, found = self._map.rig.mount, list[Match]()
        if mount is None:
            return found
        nothing = np.zeros(0, np.intp), np.zeros(0, np.int32), np.zeros(0, np.int32)
        for place in places.tolist():
            known = self._known.keyframes[place]
            motion = motion_between(keyframe.ground, known.ground, mount.height_m)
            if motion is not None:
                T_camera_place = invert(mount.T_base_left) @ motion[0] @ mount.T_base_left
                pose = T_camera_place @ known.T_camera_world
                found.append(Match(keyframe.index, place, pose, *nothing, motion[1]))
        return found

    def best(
        self, keyframe: KeyframeRecord, found: list[Match], travel: Callable[[Match], float]
    ) -> tuple[Match, PlaceEvidence] | None:
        """Return what fits a keyframe best; what disagrees with it counts against it. travel: how
        likely the robot is at a match before that is seen, in nats.
        """
        said = [(match, self.evidence(keyframe, match, travel(match))) for match in found]
        if not said:
            return None
        best, evidence = max(said, key=lambda one: one[1].seen + one[1].prior)
        others = [other.seen for match, other in said if not self.agree(match, best)]
        return best, replace(evidence, rivals=-max(0.0, *others, 0.0))

    def evidence(self, keyframe: KeyframeRecord, match: Match, travel: float) -> PlaceEvidence:
        """Return what a keyframe says for a match. A floor alone could be anywhere in a map: there
        it counts no more than what stands around.
        """
        around = self.around(match)
        by_points = len(match.rows) > 0
        return PlaceEvidence(
            look=match.log_ratio if by_points else 0.0,
            ground=0.0 if by_points else min(match.log_ratio, around),
            around=around if np.isfinite(around) else 0.0,
            sides=self._sides(keyframe, match) if by_points else 0.0,
            free=self._free(keyframe, match),
            travel=travel,
            level=self.level(match),
        )

    def _newness(self, matches: list[Match]) -> list[float]:
        """Return how new the view of each keyframe is to those before it."""
        latest = self._map.keyframes[matches[-1].keyframe]
        depth_m = median_depth_m(self._map, latest.seen_ids, latest.T_camera_world)
        poses = np.stack([match.T_camera_world for match in matches])
        new = novelty(poses[:, None] @ invert(poses), depth_m)
        return [float(new[k, :k].min(initial=1.0)) for k in range(len(matches))]

    def agree(self, before: Match, latest: Match) -> bool:
        """Whether two keyframes show the same drift, up to what two loops err."""
        now = self._map.keyframes[latest.keyframe].T_camera_world
        gap = now @ drift(self._map, before) @ invert(latest.T_camera_world)
        sigmas = np.sqrt(2 * chi2_limit(6, GATE)) * LOOP_FACTOR
        return is_within(gap, (sigmas * LINK_SIGMA[0], sigmas * LINK_SIGMA[1]))

    def level(self, match: Match) -> float:
        """Return how likely it is that the robot stands as high and as level as at the place."""
        mount = self._map.rig.mount
        if mount is None:
            return 0.0
        place = self._known.keyframes[match.place]
        T_base_left = mount.T_base_left
        T_place_now = place.T_camera_world @ invert(match.T_camera_world)
        T = T_base_left @ T_place_now @ invert(T_base_left)
        up_sigma_m = UP_SIGMA_M + SLOPE_SIGMA * float(np.linalg.norm(T[:2, 3]))
        tilt = float(np.arccos(np.clip(T[2, 2], -1.0, 1.0)))
        return of_errors((T[2, 3], up_sigma_m), (tilt, SLOPE_SIGMA))

    def around(self, match: Match) -> float:
        """Return how much likelier what stands around the keyframe stands where the known map has
        it than in a place beside, in nats; infinite within one map, where it is not compared.
        """
        return np.inf

    def _sides(self, keyframe: KeyframeRecord, match: Match) -> float:
        """Return how much likelier than not the keyframe's own points lie where the place's
        keyframe sees what they match.
        """
        own = keyframe.point_id[match.rows]
        place = self._known.keyframes[match.place]
        _, row, slot = np.intersect1d(place.point_id, match.ids, return_indices=True)
        measured = own[slot] != NO_POINT
        slot, row = slot[measured], row[measured]
        T_place_world = place.T_camera_world @ invert(match.T_camera_world)
        local = transform_points(keyframe.T_camera_world, self._map.xyz_world[own[slot]])
        uvd, _ = in_view(self._camera, transform_points(T_place_world, local))
        gap = np.linalg.norm(uvd[:, :2] - place.observations.uvd_px[row, :2], axis=1)
        agree = int((gap < SAME_PX).sum())
        return of_counts(agree, len(gap) - agree)

    def _free(self, keyframe: KeyframeRecord, match: Match) -> float:
        """Return how likely it is, were both the same place, that one side sees through so many
        points of the other: the rays to what is seen are free.
        """
        place = self._known.keyframes[match.place]
        own, known = keyframe.seen_ids, place.seen_ids
        if self._known is self._map:
            own = np.setdiff1d(own, known)
        in_now = transform_points(keyframe.T_camera_world, self._map.xyz_world[own])
        in_place = transform_points(place.T_camera_world, self._known.xyz_world[known])
        T_place_now = place.T_camera_world @ invert(match.T_camera_world)
        return min(
            self._not_in_front(transform_points(T_place_now, in_now), in_place),
            self._not_in_front(transform_points(invert(T_place_now), in_place), in_now),
        )

    def _not_in_front(self, points: Array, seen: Array) -> float:
        """Return how likely it is that so few points (N, 3) lie behind what a camera sees (M, 3)
        beside them, both in its optical frame; 0 where none can be compared.
        """
        uvd, valid = in_view(self._camera, points)
        uvd_seen, _ = in_view(self._camera, seen)
        uvd, uvd_seen = uvd[valid], uvd_seen[np.isfinite(uvd_seen[:, 0])]
        if not len(uvd) or not len(uvd_seen):
            return 0.0
        gap, near = cKDTree(uvd_seen[:, :2]).query(uvd[:, :2], distance_upper_bound=SAME_PX)
        beside = np.isfinite(gap)
        behind = uvd_seen[np.asarray(near)[beside], 2]
        margin = np.maximum(SAME_PX, IN_FRONT_SHARE * behind)
        in_front = int((uvd[beside, 2] - behind > margin).sum())
        return of_counts(MAX_SEEN_THROUGH * beside.sum(), in_front)


def drift(sparse_map: SparseMap, match: Match) -> Array:
    """Return the (4, 4) that brings a place's coordinates into those of the keyframe's map."""
    own = sparse_map.keyframes[match.keyframe].T_camera_world
    return invert(own) @ match.T_camera_world
