"""A known map beside the drive's own: one that was loaded, or that the drive made before it got
lost.

Once several keyframes in a row see it and agree on where it lies, the drive's own map is brought
into it (Campos et al., ORB-SLAM3, IEEE T-RO 2021, section VI: map merging). Two saved maps, of
several robots or of days that were mapped apart, become one in the same way: the keyframes of the
second are looked for in the first by what they observed, one after the other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from segfloor_ros.core.contracts import NO_POINT, Mount
from segfloor_ros.core.files.arrays import Arrays
from segfloor_ros.core.geometry import Array, invert, transform_points
from segfloor_ros.core.plugins.maps.map_arrays import fill_map, map_to_arrays, moved
from segfloor_ros.core.slam.mapping.bundle_adjustment import apply_global, copy_map, solve_global
from segfloor_ros.core.slam.places.evidence import of_counts
from segfloor_ros.core.slam.places.loop_closing import (
    apply_closing,
    fuse_latest,
    loop_edge,
    merge_pairs,
    optimise,
    plan_closing,
)
from segfloor_ros.core.slam.places.loops import UP_SIGMA_M, LoopDetector, PlaceMatcher, drift
from segfloor_ros.core.slam.places.place_recognition import (
    PlaceIndex,
    PlaceRecognition,
    Relocaliser,
    Vocabulary,
    greatest_speed_mps,
)
from segfloor_ros.core.slam.rig import LOCAL_KEYFRAMES, NEIGHBOURS, DisparityOffset, Rig, chi2_limit
from segfloor_ros.core.slam.sparse_map import (
    LINK_SIGMA,
    GroundView,
    KeyframeRecord,
    Match,
    SparseMap,
)
from segfloor_ros.core.slam.thresholds import SAME
from segfloor_ros.core.slam.tracking.images import Features
from segfloor_ros.core.slam.tracking.map_tracking import Pixels
from segfloor_ros.core.slam.tracking.track import Track

OFFSET = 'disparity_offset'
"""What a map knows of the disparity offset, by name."""


class KnownPlaces(PlaceMatcher):
    """Matches keyframes with the places of another map than their own."""

    def is_within_reach(self, match: Match) -> bool:
        """Whether the robot can have come there while it was lost: from the last keyframe of the
        known map to the first of its own.
        """
        first, known = self._map.keyframes[0], self._known.keyframes
        T_own_known = drift(self._map, match)
        way = known[-1].T_camera_world @ invert(first.T_camera_world @ T_own_known)
        lost_s = 1e-9 * (first.stamp_ns - known[-1].stamp_ns)
        return bool(np.linalg.norm(way[:3, 3]) <= SAME[0] + greatest_speed_mps(known) * lost_s)

    def around(self, match: Match) -> float:
        """Return how much likelier what stands around the keyframe stands where the known map has
        it than in a place beside: floors repeat themselves.
        """
        mount = self._map.rig.mount
        if mount is None:
            return 0.0
        recent = np.arange(max(0, match.keyframe - NEIGHBOURS), match.keyframe + 1)
        own = upright(self._map, mount, self._map.points_of(recent))
        own = transform_points(invert(drift(self._map, match)), own)
        reach_m = np.sqrt(chi2_limit(3)) * LINK_SIGMA[0]
        along, aside, _ = mount.T_base_left[:3, :3]
        angles = np.linspace(0.0, 2 * np.pi, 8, endpoint=False)
        ring = reach_m * (np.outer(np.cos(angles), along) + np.outer(np.sin(angles), aside))
        shifts = np.concatenate([np.zeros((1, 3)), 4 * ring, 8 * ring, 12 * ring])
        gaps_m, _ = self._upright.query(own[:, None] + shifts, distance_upper_bound=reach_m)
        here, *beside = np.isfinite(gaps_m).sum(axis=0)
        return of_counts(here, max(beside))

    @cached_property
    def _upright(self) -> cKDTree:
        """What stands in the known map, once it does not change any more."""
        assert self._map.rig.mount is not None
        alive = np.flatnonzero(self._known.alive)
        return cKDTree(upright(self._known, self._map.rig.mount, alive))


def upright(sparse_map: SparseMap, mount: Mount, ids: NDArray[np.integer]) -> Array:
    """Return those of points (N,), (M, 3), that stand clearly above the floor."""
    xyz = sparse_map.xyz_world[ids]
    return xyz[transform_points(mount.T_base_left, xyz)[:, 2] > 4 * UP_SIGMA_M]


class KnownMap:
    """The known map, beside the drive's own. of_drive: whether this drive made it, and got lost."""

    def __init__(self, own: SparseMap, arrays: Arrays, of_drive: bool) -> None:
        self._own = own
        self.of_drive = of_drive
        self._map = SparseMap(own.rig)
        fill_map(self._map, arrays)
        self._places = PlaceRecognition(self._map)
        self._places.from_arrays(arrays)
        self._relocaliser = Relocaliser(self._map, self._places)
        self._matcher = KnownPlaces(own, self._map, self._places)
        self._floors = FloorIndex(self._map.keyframes)
        self._matches: list[Match] = []

    @property
    def num_keyframes(self) -> int:
        """How large the known map is."""
        return len(self._map.keyframes)

    def recognise(self, keyframe: KeyframeRecord, images: Pixels) -> bool:
        """Whether enough keyframes in a row see the known map, this one the last of them. Look and
        floor compete where they differ: shelves and pictures are all over a building, and so are
        floors.
        """
        anywhere = np.ones(len(self._map.keyframes), bool)
        alike = self._floors.like(keyframe.ground)[:LOCAL_KEYFRAMES]
        found = self._matcher.look_at_floor(keyframe, alike)
        by_look = self._matcher.look(keyframe, images, anywhere, ~anywhere)
        found += [by_look] if by_look else []
        seen = self._matcher.best(keyframe, found, self._travel)
        seen = None if seen is None or seen[1].objection else seen
        self._matches = self._matcher.sightings.add(seen)
        return bool(self._matches)

    def recognise_all(self) -> bool:
        """Whether keyframes of the own map see the known one: all that do, and agree with those
        which proved it first, tie the two.
        """
        own = [keyframe for keyframe in self._own.keyframes if keyframe.retired is None]
        proofs = [self._matches for k in own if self.recognise(k, k.observations.exact())]
        self._matches = [
            match
            for proof in proofs
            for match in proof
            if self._matcher.agree(match, proofs[0][-1])
        ]
        return bool(proofs)

    def _travel(self, match: Match) -> float:
        """Return how likely the robot is at a match: at any place that it can have come to."""
        if self.of_drive and not self._matcher.is_within_reach(match):
            return -math.inf
        return -math.log(self.num_keyframes)

    def find(
        self, images: Pixels, features: Features, stamp_ns: int
    ) -> tuple[Track | None, dict[int, Track]]:
        """Return a frame with its pose in the known map, once several in a row were found there,
        and those, by stamp.
        """
        found = self._relocaliser.find(images, features, stamp_ns)
        return found, self._relocaliser.take_proof()

    def _own_ids(self, match: Match) -> NDArray[np.int32]:
        """Return the stable ids (N,) that the points of a match have in the drive's own map, -1
        where it has none.
        """
        keyframe = self._own.keyframes[match.keyframe]
        own = np.full(len(match.rows), NO_POINT, np.int32)
        if not keyframe.is_thin:
            own = keyframe.point_id[match.rows]
        return np.where(own != NO_POINT, self._own.stable_id[own], np.int32(NO_POINT))

    def merge(self, own_words: Arrays) -> Arrays:
        """Merge the drive's own map into the known one, with the same ids and stamps. Returns the
        words of all keyframes.
        """
        matches = self._matches
        latest, own_ids = matches[-1], [self._own_ids(match) for match in matches]
        T_known_own = invert(drift(self._own, latest))
        before = len(self._map.keyframes)
        arrays = moved(map_to_arrays(self._own), T_known_own)
        known = self.to_arrays()
        self.restore(known)
        fill_map(self._own, arrays)
        for match, ids in zip(matches, own_ids, strict=True):
            edge = loop_edge(self._own, match)
            self._own.loops.append(replace(edge, i=before + match.keyframe))
            merge_pairs(self._own, self._rows(ids), self._rows(match.stable_ids))
        fuse_latest(self._own, before + latest.keyframe)
        return {name: np.concatenate([known[name], own_words[name]]) for name in own_words}

    def to_arrays(self) -> Arrays:
        """Return the known map and the words of its keyframes."""
        return map_and_words(self._map, self._places)

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


def map_and_words(sparse_map: SparseMap, places: PlaceRecognition) -> Arrays:
    """Return a map and the words of its keyframes."""
    return map_to_arrays(sparse_map) | places.to_arrays()


def merge_slam(first: Arrays, second: Arrays, rig: Rig) -> Arrays | None:
    """Return two maps as one; None where no place of the first is seen in the second. rig: of the
    first, and of the second as the rig of the first would have measured it (`as_seen_by`), with ids
    and stamps that come after those of the first.
    """
    rig.offset.restored(first[OFFSET])
    merged = SparseMap(rig)
    fill_map(merged, second)
    known = KnownMap(merged, first, of_drive=False)
    if not known.recognise_all():
        return None
    words = known.merge({name: second[name] for name in ('words', 'word_count')})
    places = PlaceRecognition(merged)
    places.from_arrays(words)
    _close_loops(merged, places, len(first['keyframe_stamp_ns']))
    return map_and_words(merged, places) | {OFFSET: first[OFFSET]}


def _close_loops(merged: SparseMap, places: PlaceRecognition, begin: int) -> None:
    """Close the loops that keyframes from index `begin` on see, and adjust the whole map."""
    loops = LoopDetector(merged, places)
    for keyframe in merged.keyframes[begin:]:
        if keyframe.retired is not None:
            continue
        matches = loops.detect(keyframe, keyframe.observations.exact())
        if matches:
            closing = plan_closing(merged, matches)
            apply_closing(merged, closing, optimise(closing.graph))
    copied = copy_map(merged, None)
    apply_global(merged, solve_global(merged.rig.camera, copied, lambda: True))


def as_seen_by(offset: DisparityOffset, own_offset: DisparityOffset, arrays: Arrays) -> Arrays:
    """Return a map, made with a camera of its own, as another rectified one would have measured it;
    disparities of both have an offset.
    """
    camera, own = offset.camera, own_offset.camera
    zoom = np.array([camera.fx / own.fx, camera.fy / own.fy, 1.0])
    zoom[2] = camera.disparity_times_depth / own.disparity_times_depth
    uvd_px = arrays['feature_uvd_px'].astype(np.float64)
    uvd_px[:, 2] -= own_offset.at(uvd_px)
    uvd_px = (uvd_px - (own.cx, own.cy, 0.0)) * zoom + (camera.cx, camera.cy, 0.0)
    uvd_px[:, 2] += offset.at(uvd_px)
    return arrays | {
        'feature_uvd_px': uvd_px.astype(np.float32),
        'feature_sigma_px': (arrays['feature_sigma_px'] * zoom).astype(np.float16),
    }


class FloorIndex:
    """Keyframes of a map by the look of their floor."""

    def __init__(self, keyframes: Sequence[KeyframeRecord]) -> None:
        self._vocabulary, self._index = Vocabulary.load(), PlaceIndex()
        for keyframe in keyframes:
            self._index.add(keyframe.index, self._vocabulary.words(keyframe.ground.descriptor))

    def like(self, ground: GroundView) -> NDArray[np.intp]:
        """Return the keyframes, by index, whose floor looks like a view of it, most alike first."""
        score = self._index.score(self._vocabulary.words(ground.descriptor), len(self._index))
        best = np.argsort(-score, kind='stable')
        return best[score[best] > 0]
