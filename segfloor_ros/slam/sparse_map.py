"""The sparse map: points and keyframes as arrays, linked by the points' rows.

The row of a point that is gone is given to a new one, so that memory follows the space covered;
its stable id, which the next stages know it by, is never given twice. Frame `world` is the left
optical frame of the first frame.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array
from segfloor_ros.slam.growing_array import GrowingArray
from segfloor_ros.slam.keyframe_record import KeyframeRecord, LoopEdge, Retirement
from segfloor_ros.slam.patch_alignment import SIDE_PX
from segfloor_ros.slam.results import NO_POINT

GONE_AFTER = 3  # keyframes that have seen through a point since it was last found

MAX_PATCH_ZOOM = 1.3
"""Change of a patch's size in the image at which it is taken anew."""


class SparseMap:
    """Points, keyframes and who observes whom."""

    def __init__(self) -> None:
        self.keyframes: list[KeyframeRecord] = []
        self.loops: list[LoopEdge] = []
        self._retired: list[KeyframeRecord] = []
        self._xyz = GrowingArray((3,), np.float64)
        self._descriptor = GrowingArray((32,), np.uint8)
        self._patch = GrowingArray((SIDE_PX, SIDE_PX), np.uint8)
        self._patch_distance = GrowingArray((), np.float64)
        self._viewing_distance = GrowingArray((), np.float64)
        self._viewing_octave = GrowingArray((), np.float64)
        self._viewing_direction = GrowingArray((3,), np.float64)
        self._num_ever = 0
        self._stable_id = GrowingArray((), np.int32)
        self._alive = GrowingArray((), np.bool_)
        self._visible_count = GrowingArray((), np.int32)
        self._found_count = GrowingArray((), np.int32)
        self._observer_count = GrowingArray((), np.int32)
        self._seen_through_count = GrowingArray((), np.int32)
        self._born = GrowingArray((), np.int32)
        self._seen_last = GrowingArray((), np.int32)
        self._edge_point = GrowingArray((), np.int32)
        self._edge_keyframe = GrowingArray((), np.int32)
        self._edge_row = GrowingArray((), np.int32)

    @property
    def xyz_world(self) -> Array:
        """Positions (P, 3) of all points, a writable view indexed by row."""
        return self._xyz.rows

    @property
    def stable_id(self) -> NDArray[np.int32]:
        """The id (P,) of each point, ascending with its age and never used again."""
        return self._stable_id.rows

    @property
    def alive(self) -> NDArray[np.bool_]:
        """Whether each point (P,) is part of the map."""
        return self._alive.rows

    @property
    def descriptor(self) -> NDArray[np.uint8]:
        """Descriptors (P, 32) as last seen by a keyframe."""
        return self._descriptor.rows

    @property
    def patch(self) -> NDArray[np.uint8]:
        """Grey levels (P, SIDE_PX, SIDE_PX) around each point, kept as long as its size in the
        image stays about the same: every change of patch adds an error to the point's
        position.
        """
        return self._patch.rows

    @property
    def patch_distance_m(self) -> Array:
        """Distance (P,) from which the patch was taken."""
        return self._patch_distance.rows

    @property
    def viewing_distance_m(self) -> Array:
        """Distance (P,) from which the descriptor was taken."""
        return self._viewing_distance.rows

    @property
    def viewing_octave(self) -> Array:
        """Pyramid level (P,) at which the descriptor was taken."""
        return self._viewing_octave.rows

    @property
    def viewing_direction(self) -> Array:
        """Unit vectors (P, 3) from the camera to the point, in world axes, when the descriptor
        was taken.
        """
        return self._viewing_direction.rows

    @property
    def observer_count(self) -> NDArray[np.int32]:
        """Number of keyframes (P,) that observe each point."""
        return self._observer_count.rows

    @property
    def num_ever(self) -> int:
        """How many points there have been: the next stable id."""
        return self._num_ever

    def point_columns(self) -> dict[str, tuple[GrowingArray, type]]:
        """Return what is known of points, by name, and the type that is exact enough for a file."""
        return {
            'xyz_world': (self._xyz, np.float64),
            'stable_id': (self._stable_id, np.int32),
            'descriptor': (self._descriptor, np.uint8),
            'patch': (self._patch, np.uint8),
            'patch_distance_m': (self._patch_distance, np.float32),
            'viewing_distance_m': (self._viewing_distance, np.float32),
            'viewing_octave': (self._viewing_octave, np.float32),
            'viewing_direction': (self._viewing_direction, np.float32),
            'visible_count': (self._visible_count, np.int32),
            'found_count': (self._found_count, np.int32),
            'seen_through_count': (self._seen_through_count, np.int32),
            'born': (self._born, np.int32),
            'seen_last': (self._seen_last, np.int32),
        }

    def count_points(self, num_ever: int) -> None:
        """Take the points of the columns as they are, in a map that was empty."""
        self._num_ever = num_ever
        self._alive.extend(np.ones(len(self.stable_id), bool))
        self._observer_count.lengthen(len(self.stable_id))

    def restore(self, keyframe: KeyframeRecord) -> None:
        """Add a keyframe whose points are there already."""
        self.keyframes.append(keyframe)
        self._add_edges(keyframe, np.flatnonzero(keyframe.point_id != NO_POINT))
        if keyframe.retired is not None:
            self._retired.append(keyframe)

    def links(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the pairs (M,), (M,) of keyframes, by index, that shared points when the later one
        was made.
        """
        pairs = [(k.index, other) for k in self.keyframes for other in k.links]
        i, j = np.array(pairs, np.intp).reshape(-1, 2).T
        return i, j

    def living(self, rows: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return point rows (N,) with `NO_POINT` in place of points that are gone."""
        known = rows != NO_POINT
        known[known] = self.alive[rows[known]]
        return np.where(known, rows, NO_POINT).astype(np.int32)

    def add_keyframe(
        self,
        keyframe: KeyframeRecord,
        patches: NDArray[np.uint8],
        new_rows: NDArray[np.intp],
        new_xyz_world: Array,
    ) -> None:
        """Add a keyframe with new points (N, 3) at its features `new_rows` (N,).

        patches: (F, SIDE_PX, SIDE_PX) grey levels around all of its features. The points it
        sees take on its view of them.
        """
        self.keyframes.append(keyframe)
        keyframe.point_id[new_rows] = self._add_points(new_xyz_world, keyframe.index)
        self._link(keyframe, np.flatnonzero(keyframe.point_id != NO_POINT), patches)

    def add_points_between(
        self,
        keyframe: KeyframeRecord,
        rows: NDArray[np.intp],
        other: KeyframeRecord,
        other_rows: NDArray[np.intp],
        xyz_world: Array,
        patches: NDArray[np.uint8],
    ) -> None:
        """Add points (N, 3) that two keyframes of the map see with their features `rows`,
        `other_rows` (N,). patches: as in `add_keyframe`, of the first.
        """
        ids = self._add_points(xyz_world, keyframe.index)
        keyframe.point_id[rows] = other.point_id[other_rows] = ids
        self._link(keyframe, rows, patches)
        self._add_edges(other, other_rows)

    def _add_points(self, xyz_world: Array, born: int) -> NDArray[np.int32]:
        count = len(xyz_world)
        rows_free = np.flatnonzero(~self.alive)[:count]
        fresh = count - len(rows_free)
        new_rows = len(self.alive) + np.arange(fresh)
        rows: NDArray[np.int32] = np.concatenate([rows_free, new_rows], dtype=np.int32)
        initial: list[tuple[GrowingArray, Any]] = [
            (self._xyz, xyz_world),
            (self._stable_id, self._num_ever + np.arange(count)),
            (self._patch_distance, 0.0),
            (self._alive, True),
            (self._visible_count, 1),
            (self._found_count, 1),
            (self._seen_through_count, 0),
            (self._observer_count, 0),
            (self._born, born),
            (self._seen_last, born),
        ]
        seen = [self._descriptor, self._patch, self._viewing_distance]
        seen += [self._viewing_octave, self._viewing_direction]
        for array in [*seen, *(array for array, _ in initial)]:
            array.lengthen(fresh)
        for array, value in initial:
            array.rows[rows] = value
        self._num_ever += count
        return rows

    def _add_edges(self, keyframe: KeyframeRecord, rows: NDArray[np.intp]) -> None:
        ids = keyframe.point_id[rows]
        self._edge_point.extend(ids)
        self._edge_keyframe.extend(np.full(len(ids), keyframe.index, np.int32))
        self._edge_row.extend(rows)
        self.observer_count[ids] += 1

    def _link(
        self, keyframe: KeyframeRecord, rows: NDArray[np.intp], patches: NDArray[np.uint8]
    ) -> None:
        self._add_edges(keyframe, rows)
        ids = keyframe.point_id[rows]
        sight = self.xyz_world[ids] - keyframe.T_world_camera[:3, 3]
        distance = np.linalg.norm(sight, axis=1)
        self.descriptor[ids] = keyframe.features.descriptor[rows]
        self._seen_last.rows[ids] = keyframe.index
        self.viewing_distance_m[ids] = distance
        self.viewing_octave[ids] = keyframe.features.octave[rows]
        self.viewing_direction[ids] = sight / distance[:, None]
        zoom = np.abs(np.log(np.maximum(self.patch_distance_m[ids], 1e-6) / distance))
        stale = zoom > np.log(MAX_PATCH_ZOOM)
        self.patch[ids[stale]] = patches[rows[stale]]
        self.patch_distance_m[ids[stale]] = distance[stale]

    def unlink(self, keyframe: KeyframeRecord, rows: NDArray[np.intp]) -> None:
        """Forget the observations `rows` of a keyframe; a point that nobody observes any more
        is removed.
        """
        ids = keyframe.point_id[rows]
        keyframe.point_id[rows] = NO_POINT
        gone = np.zeros(len(self.alive), bool)
        gone[ids] = True
        edges = gone[self._edge_point.rows] & (self._edge_keyframe.rows == keyframe.index)
        self._drop_edges(edges)
        self.observer_count[ids] -= 1
        self.alive[ids[self.observer_count[ids] <= 0]] = False

    def retire(self, keyframe: KeyframeRecord, reference: KeyframeRecord) -> None:
        """Take a keyframe's observations out of the map and let its pose follow `reference`; its
        index and stamp stay.
        """
        self.unlink(keyframe, np.flatnonzero(keyframe.point_id != NO_POINT))
        none = np.zeros(0, np.intp)
        keyframe.features = keyframe.features.take(none)
        keyframe.observations = keyframe.observations.take(none)
        keyframe.point_id = keyframe.point_id[none]
        keyframe.retired = Retirement(
            reference.index, keyframe.T_camera_world @ reference.T_world_camera
        )
        self._retired.append(keyframe)

    def follow(self) -> None:
        """Move the retired keyframes with those that they follow."""
        # The latest retired first: an older one may follow it.
        for keyframe in reversed(self._retired):
            assert keyframe.retired is not None
            reference = self.keyframes[keyframe.retired.reference]
            keyframe.T_camera_world = keyframe.retired.T_camera_reference @ reference.T_camera_world

    def remove_points(self, ids: NDArray[np.integer]) -> None:
        """Take points out of the map; their rows are free for new ones."""
        self.alive[ids] = False
        gone = ~self.alive
        self._drop_edges(gone[self._edge_point.rows])
        for keyframe in self.keyframes:
            known = keyframe.point_id != NO_POINT
            known[known] = gone[keyframe.point_id[known]]
            keyframe.point_id[known] = NO_POINT

    def seen_together(self, a: NDArray[np.integer], b: NDArray[np.integer]) -> NDArray[np.bool_]:
        """Return whether a keyframe observes both points of each pair (a[i], b[i]), (N,); no point
        occurs twice.
        """
        pair: NDArray[np.intp] = np.full((2, len(self.alive)), -1)
        pair[0, a] = pair[1, b] = np.arange(len(a))
        of_pair = pair[:, self._edge_point.rows]
        keyframe = self._edge_keyframe.rows
        keys = [of[of >= 0] * len(self.keyframes) + keyframe[of >= 0] for of in of_pair]
        together = np.zeros(len(a), bool)
        together[np.intersect1d(*keys) // len(self.keyframes)] = True
        return together

    def merge(self, kept: NDArray[np.integer], gone: NDArray[np.integer]) -> None:
        """Make one point of each pair (kept[i], gone[i]), (N,), that no keyframe observes both
        of. The better known one gives the position and the patch, the one seen last the look.
        """
        better = self.observer_count[gone] > self.observer_count[kept]
        later = self._seen_last.rows[gone] > self._seen_last.rows[kept]
        view = (self._descriptor, self._viewing_distance, self._viewing_octave)
        for arrays, chosen in (
            ((self._xyz, self._patch, self._patch_distance), better),
            ((*view, self._viewing_direction, self._seen_last), later),
        ):
            for array in arrays:
                array.rows[kept[chosen]] = array.rows[gone[chosen]]
        for counts in (self._visible_count, self._found_count, self._observer_count):
            counts.rows[kept] += counts.rows[gone]
        self._born.rows[kept] = np.minimum(self._born.rows[kept], self._born.rows[gone])
        self._rename(kept, gone)
        self.alive[gone] = False

    def _rename(self, kept: NDArray[np.integer], gone: NDArray[np.integer]) -> None:
        """Give the observations of points `gone` to points `kept`."""
        new_row = np.arange(len(self.alive), dtype=np.int32)
        new_row[gone] = kept
        moved = np.flatnonzero(new_row[self._edge_point.rows] != self._edge_point.rows)
        self._edge_point.rows[moved] = new_row[self._edge_point.rows[moved]]
        for k in np.unique(self._edge_keyframe.rows[moved]):
            mine = moved[self._edge_keyframe.rows[moved] == k]
            self.keyframes[k].point_id[self._edge_row.rows[mine]] = self._edge_point.rows[mine]

    def _drop_edges(self, dropped: NDArray[np.bool_]) -> None:
        for edges in (self._edge_point, self._edge_keyframe, self._edge_row):
            edges.keep(~dropped)

    def note_tracking(self, visible: NDArray[np.integer], found: NDArray[np.integer]) -> None:
        """Count that points should have been seen in a frame, and which of them were."""
        self._visible_count.rows[visible] += 1
        self._found_count.rows[found] += 1
        self._seen_through_count.rows[found] = 0

    def note_seen_through(self, ids: NDArray[np.integer]) -> None:
        """Count that a keyframe saw what lies behind points."""
        self._seen_through_count.rows[ids] += 1

    def reliability(self, ids: NDArray[np.integer]) -> Array:
        """Return how likely points (N,) are to be found when they should be seen, in (0, 1)."""
        return self._found_count.rows[ids] / (self._visible_count.rows[ids] + 2.0)

    def poor_points(self, settled_before: int, min_found_ratio: float) -> NDArray[np.intp]:
        """Return ids of points that tracking seldom finds, that are gone, or that only one keyframe
        saw although made before keyframe `settled_before`.
        """
        found = self._found_count.rows
        seldom = found < min_found_ratio * self._visible_count.rows
        seldom |= self._seen_through_count.rows >= GONE_AFTER
        lonely = (self._born.rows < settled_before) & (self.observer_count < 2)
        return np.flatnonzero(self.alive & (seldom | lonely))

    def covisible(self, ids: NDArray[np.integer]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return the keyframes that observe any of the points, most shared first, and the
        numbers shared.
        """
        wanted = np.zeros(len(self.alive), bool)
        wanted[ids] = True
        shared = np.bincount(
            self._edge_keyframe.rows[wanted[self._edge_point.rows]], minlength=len(self.keyframes)
        )
        order = np.lexsort((-np.arange(len(shared)), -shared))
        order = order[shared[order] > 0]
        return order, shared[order]

    def points_of(self, keyframe_indices: NDArray[np.integer]) -> NDArray[np.int32]:
        """Return the ascending rows of all points that the keyframes observe."""
        observed = np.zeros(len(self.alive) + 1, bool)  # one more: NO_POINT is the last
        for k in keyframe_indices:
            observed[self.keyframes[k].point_id] = True
        return np.flatnonzero(observed[:-1]).astype(np.int32)

    def edges_of(
        self, ids: NDArray[np.integer]
    ) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
        """Return all observations of the points: point ids, keyframe indices, feature rows;
        (E,) each.
        """
        wanted = np.zeros(len(self.alive), bool)
        wanted[ids] = True
        edges = wanted[self._edge_point.rows]
        return (
            self._edge_point.rows[edges],
            self._edge_keyframe.rows[edges],
            self._edge_row.rows[edges],
        )
