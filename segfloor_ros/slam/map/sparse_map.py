"""The sparse map: points and keyframes as arrays, linked by the points' rows.

The row of a point that is gone is given to a new one, so that memory follows the space covered;
its stable id, which the next stages know it by, is never given twice. Frame `world` is the left
optical frame of the first frame.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array
from segfloor_ros.slam.map.records import (
    GrowingArray,
    KeyframeRecord,
    LoopEdge,
    PointRows,
    Retirement,
)
from segfloor_ros.slam.results import NO_POINT

GONE_AFTER = 3  # keyframes that have seen through a point since it was last found

OF_POSITION = ('xyz_world', 'patch', 'patch_distance_m')
OF_LOOK = (
    'descriptor',
    'viewing_distance_m',
    'viewing_octave',
    'viewing_direction',
    'seen_last',
)
"""Columns that go together when two points are merged."""

MAX_PATCH_ZOOM = 1.3
"""Change of a patch's size in the image at which it is taken anew."""


class SparseMap:
    """Points, keyframes and who observes whom."""

    def __init__(self) -> None:
        self.reset()

    def reset(self, num_ever: int = 0) -> None:
        """Begin again with an empty map. num_ever: the first stable id."""
        self.keyframes: list[KeyframeRecord] = []
        self.loops: list[LoopEdge] = []
        self._retired: list[KeyframeRecord] = []
        self._points = PointRows(num_ever)
        self._links = GrowingArray((2,), np.intp)
        self._linked = 0
        self._edge_point = GrowingArray((), np.int32)
        self._edge_keyframe = GrowingArray((), np.int32)
        self._edge_row = GrowingArray((), np.int32)

    @property
    def xyz_world(self) -> Array:
        """Positions (P, 3) of all points, a writable view indexed by row."""
        return self._points['xyz_world']

    @property
    def stable_id(self) -> NDArray[np.int32]:
        """The id (P,) of each point, ascending with its age and never used again."""
        return self._points['stable_id']

    @property
    def alive(self) -> NDArray[np.bool_]:
        """Whether each point (P,) is part of the map."""
        return self._points['alive']

    @property
    def descriptor(self) -> NDArray[np.uint8]:
        """Descriptors (P, 32) as last seen by a keyframe."""
        return self._points['descriptor']

    @property
    def patch(self) -> NDArray[np.uint8]:
        """Grey levels (P, SIDE_PX, SIDE_PX) around each point, kept as long as its size in the
        image stays about the same: every change of patch adds an error to the point's
        position.
        """
        return self._points['patch']

    @property
    def patch_distance_m(self) -> Array:
        """Distance (P,) from which the patch was taken."""
        return self._points['patch_distance_m']

    @property
    def viewing_distance_m(self) -> Array:
        """Distance (P,) from which the descriptor was taken."""
        return self._points['viewing_distance_m']

    @property
    def viewing_octave(self) -> Array:
        """Pyramid level (P,) at which the descriptor was taken."""
        return self._points['viewing_octave']

    @property
    def viewing_direction(self) -> Array:
        """Unit vectors (P, 3) from the camera to the point, in world axes, when the descriptor
        was taken.
        """
        return self._points['viewing_direction']

    @property
    def observer_count(self) -> NDArray[np.int32]:
        """Number of keyframes (P,) that observe each point."""
        return self._points['observer_count']

    @property
    def points(self) -> PointRows:
        """All that is known of the points."""
        return self._points

    @property
    def num_ever(self) -> int:
        """How many points there have been: the next stable id."""
        return self._points.num_ever

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
        for keyframe in self.keyframes[self._linked :]:
            others = np.array(keyframe.links, np.intp)
            self._links.extend(np.column_stack([np.full(len(others), keyframe.index), others]))
        self._linked = len(self.keyframes)
        i, j = self._links.rows.T
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
        keyframe.point_id[new_rows] = self._new_points(new_xyz_world, keyframe.index)
        self._link(keyframe, np.flatnonzero(keyframe.point_id != NO_POINT), patches)

    def _new_points(self, xyz_world: Array, born: int) -> NDArray[np.int32]:
        return self._points.add(len(xyz_world), xyz_world=xyz_world, born=born, seen_last=born)

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
        self._points['seen_last'][ids] = keyframe.index
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
        later = self._points['seen_last'][gone] > self._points['seen_last'][kept]
        for names, chosen in ((OF_POSITION, better), (OF_LOOK, later)):
            for name in names:
                self._points[name][kept[chosen]] = self._points[name][gone[chosen]]
        for name in ('visible_count', 'found_count', 'observer_count'):
            self._points[name][kept] += self._points[name][gone]
        born = self._points['born']
        born[kept] = np.minimum(born[kept], born[gone])
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
        self._points['visible_count'][visible] += 1
        self._points['found_count'][found] += 1
        self._points['seen_through_count'][found] = 0

    def note_seen_through(self, ids: NDArray[np.integer]) -> None:
        """Count that a keyframe saw what lies behind points."""
        self._points['seen_through_count'][ids] += 1

    def reliability(self, ids: NDArray[np.integer]) -> Array:
        """Return how likely points (N,) are to be found when they should be seen, in (0, 1)."""
        return self._points['found_count'][ids] / (self._points['visible_count'][ids] + 2.0)

    def poor_points(self, settled_before: int, min_found_ratio: float) -> NDArray[np.intp]:
        """Return ids of points that tracking seldom finds, that are gone, or that only one keyframe
        saw although made before keyframe `settled_before`.
        """
        found = self._points['found_count']
        seldom = found < min_found_ratio * self._points['visible_count']
        seldom |= self._points['seen_through_count'] >= GONE_AFTER
        lonely = (self._points['born'] < settled_before) & (self.observer_count < 2)
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

    def edges(self) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
        """Return all observations as `edges_of`."""
        return self._edge_point.rows, self._edge_keyframe.rows, self._edge_row.rows

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
