"""The sparse map: points and keyframes as arrays, linked by the points' rows.

The row of a point that is gone is given to a new one, so that memory follows the space covered;
its stable id, which the next stages know it by, is never given twice. Frame `world` is the left
optical frame of the first frame as it was first; adjustments of the whole map may move that.

In: keyframes and points of mapping. Out: arrays by row or by id, for tracking, files and messages.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.contracts import NO_POINT, RelativeMotion, Up
from segfloor_ros.core.geometry import Array, invert, transform_points
from segfloor_ros.core.slam.rig import MIN_DEPTH_M, Observations, Rig
from segfloor_ros.core.slam.thresholds import FOUND_SHARE, PROOF
from segfloor_ros.core.slam.tracking.images import Features
from segfloor_ros.core.slam.tracking.patch_alignment import SIDE_PX

OF_POSITION = ('xyz_world', 'patch', 'patch_distance_m')
OF_LOOK = ('descriptor', 'viewing_distance_m', 'viewing_octave', 'viewing_direction', 'seen_last')
"""Columns that go together when two points are merged."""

MAX_PATCH_ZOOM = 1.3
"""Change of a patch's size in the image at which it is taken anew."""


@dataclass(frozen=True)
class Column:
    """A column of rows of some shape. start: the value of a new point, unless it is given."""

    dtype: type
    shape: tuple[int, ...] = ()
    start: Any = 0


COLUMNS = {
    'xyz_world': Column(np.float64, (3,)),
    'stable_id': Column(np.int32),
    'alive': Column(np.bool_, start=True),
    'descriptor': Column(np.uint8, (32,)),
    'patch': Column(np.uint8, (SIDE_PX, SIDE_PX)),
    'patch_distance_m': Column(np.float32),
    'viewing_distance_m': Column(np.float32),
    'viewing_octave': Column(np.float32),
    'viewing_direction': Column(np.float32, (3,)),
    'visible_count': Column(np.int32, start=1),
    'found_count': Column(np.int32, start=1),
    'observer_count': Column(np.int32),
    'seen_through_count': Column(np.int32),
    'born': Column(np.int32),
    'seen_last': Column(np.int32),
}


class PointRows:
    """The columns of all points by name. num_ever: how many points there have been, which is the
    next stable id.
    """

    def __init__(self, num_ever: int = 0) -> None:
        self.num_ever = num_ever
        self._columns = {
            name: GrowingArray(column.shape, column.dtype) for name, column in COLUMNS.items()
        }

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return a column (P, ...), a writable view."""
        return self._columns[name].rows

    def add(self, count: int, **given: Any) -> NDArray[np.int32]:
        """Add points; returns their rows. given: values of columns."""
        size = len(self['alive'])
        free = np.flatnonzero(~self['alive'])[:count]
        fresh = count - len(free)
        rows = np.concatenate([free, size + np.arange(fresh)], dtype=np.int32)
        given['stable_id'] = self.num_ever + np.arange(count)
        for name, column in COLUMNS.items():
            self._columns[name].lengthen(fresh)
            self[name][rows] = given.get(name, column.start)
        self.num_ever += count
        return rows

    def note_tracking(self, visible: NDArray[np.integer], found: NDArray[np.integer]) -> None:
        """Count that points should have been seen in a frame, and which of them were."""
        self['visible_count'][visible] += 1
        self['found_count'][found] += 1
        self['seen_through_count'][found] = 0

    def note_seen_through(self, rows: NDArray[np.integer]) -> None:
        """Count that a keyframe saw what lies behind points."""
        self['seen_through_count'][rows] += 1

    def reliability(self, rows: NDArray[np.integer]) -> Array:
        """Return how likely points (N,) are to be found when they should be seen, in (0, 1)."""
        return np.asarray(self['found_count'][rows] / (self['visible_count'][rows] + 2.0))


Observers = tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]
"""Observations: rows of points, indices of keyframes, and their features; (E,) each."""


class GrowingArray:
    """An array that grows along its first axis; appending is amortised constant time."""

    def __init__(self, row_shape: tuple[int, ...], dtype: type) -> None:
        self._buffer: NDArray[Any] = np.zeros((1024, *row_shape), dtype)
        self._length = 0

    @property
    def rows(self) -> NDArray[Any]:
        """A view of the rows in use; writing to it writes to the array."""
        return self._buffer[: self._length]

    def extend(self, rows: NDArray[Any]) -> None:
        """Append rows (N, ...)."""
        needed = self._length + len(rows)
        if needed > len(self._buffer):
            grown = np.zeros(
                (max(needed, 2 * len(self._buffer)), *self._buffer.shape[1:]), self._buffer.dtype
            )
            grown[: self._length] = self.rows
            self._buffer = grown
        self._buffer[self._length : needed] = rows
        self._length = needed

    def lengthen(self, count: int) -> None:
        """Append rows of zeros."""
        self.extend(np.zeros((count, *self._buffer.shape[1:]), self._buffer.dtype))

    def drop(self, dropped: NDArray[np.intp]) -> None:
        """Drop rows (N,), ascending."""
        first = int(dropped[0]) if len(dropped) else self._length
        kept = np.delete(self.rows[first:], dropped - first, axis=0)
        self._length = first + len(kept)
        self._buffer[first : self._length] = kept


class Edges:
    """Who observes whom: point (E,) is the row of the point that each feature of each keyframe
    shows, keyframe by keyframe, `NO_POINT` where it shows none.
    """

    def __init__(self) -> None:
        self._point = GrowingArray((), np.int32)
        self._bounds = GrowingArray((), np.intp)
        self._bounds.lengthen(1)

    @property
    def point(self) -> NDArray[np.int32]:
        """The points, a writable view."""
        return self._point.rows

    def of(self, keyframe: int) -> NDArray[np.int32]:
        """Return what the features of a keyframe show, a writable view until keyframes are added or
        features dropped.
        """
        first, end = self._bounds.rows[keyframe : keyframe + 2]
        return self.point[first:end]

    def add(self, point: NDArray[np.int32]) -> None:
        """Add the next keyframe, with what its features show."""
        self._point.extend(point)
        self._bounds.extend(np.array([len(self.point)]))

    def keep(self, keyframe: int, rows: NDArray[np.intp]) -> None:
        """Drop the features of a keyframe but rows (N,), ascending."""
        first, end = self._bounds.rows[keyframe : keyframe + 2]
        dropped = np.delete(np.arange(first, end), rows)
        self._point.drop(dropped)
        self._bounds.rows[keyframe + 1 :] -= len(dropped)

    def at(self, keyframe: NDArray[np.integer] | int, row: NDArray[np.integer]) -> NDArray[np.intp]:
        """Return where in `point` features (N,) of keyframes, by index, are."""
        return np.asarray(self._bounds.rows[keyframe] + row)

    def to(self, wanted: NDArray[np.bool_]) -> Observers:
        """Return the observations of wanted points (P,), keyframe by keyframe."""
        found = np.flatnonzero(np.append(wanted, False)[self.point])  # `NO_POINT` is the last
        counts = self._in_each(found)
        keyframe = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
        row = (found - self._bounds.rows[keyframe]).astype(np.int32)
        return self.point[found], keyframe, row

    def count(self, wanted: NDArray[np.bool_]) -> NDArray[np.intp]:
        """Return how many of the wanted points (P,) each keyframe observes."""
        return self._in_each(np.flatnonzero(np.append(wanted, False)[self.point]))

    def _in_each(self, found: NDArray[np.intp]) -> NDArray[np.intp]:
        return np.diff(np.searchsorted(found, self._bounds.rows))


@dataclass(frozen=True)
class Retirement:
    """Where a retired keyframe was seen from the keyframe (by index) that it follows."""

    reference: int
    T_camera_reference: Array


LINK_SIGMA, LOOP_FACTOR = (0.01, 0.002), 2.0
"""Error, m and rad, of the motion between two keyframes that share points, and that of a loop in
units of it; how far from each other they stand does not matter. What is no larger than that of a
loop is no drift."""

FLOOR_SIGMA = 0.02, 0.006
"""That of a loop by the floor alone: some tens of corners within a metre say less of how far the
camera has turned, and what the mount is off tilts views from opposite sides by twice as much."""


def loop_sigma(by_floor: bool) -> tuple[float, float]:
    """Return the error of a loop, m and rad."""
    return FLOOR_SIGMA if by_floor else (LOOP_FACTOR * LINK_SIGMA[0], LOOP_FACTOR * LINK_SIGMA[1])


@dataclass(frozen=True)
class LoopEdge:
    """Where keyframe i was when it saw the place of keyframe j again: T_i_j (4, 4), of cameras.
    by_floor: by the floor alone; else they share points.
    """

    i: int
    j: int
    T_i_j: Array
    by_floor: bool = False

    @property
    def sigma(self) -> Array:
        """Its error (6,), m and rad."""
        return np.repeat(loop_sigma(self.by_floor), 3)


@dataclass(frozen=True)
class Match:
    """A keyframe that sees a place of the map again. place: the keyframe that knows it best, both
    by index. T_camera_world: (4, 4) the keyframe's camera as seen from there. rows, ids: (N,)
    features and the place's points they show, stable_ids: (N,) of these. log_ratio: of what it
    shows over chance, in nats.
    """

    keyframe: int
    place: int
    T_camera_world: Array
    rows: NDArray[np.intp]
    ids: NDArray[np.int32]
    stable_ids: NDArray[np.int32]
    log_ratio: float = math.inf


@dataclass(frozen=True)
class GroundView:
    """Corners of the floor: xy_m (N, 2) on it in the base frame, descriptor (N, 32) uint8."""

    xy_m: NDArray[np.float16]
    descriptor: NDArray[np.uint8]


NOTHING = GroundView(np.zeros((0, 2), np.float16), np.zeros((0, 32), np.uint8))


Covisible = tuple[NDArray[np.intp], NDArray[np.intp]]
"""Keyframes that observe any of some points, most shared first, and the numbers shared."""


@dataclass
class KeyframeRecord:
    """One keyframe of the map.

    The pose moves in bundle adjustment. features: None of an old one, of which the levels of the
    pyramid are left, octave (N,) uint8. observations: as measured, the disparity offset of the rig
    not taken off. retired: set when the keyframe has no features any more and only follows another
    one. point_id: (N,) int32, the row of each feature's map point, not its stable id; of a
    keyframe of a map a view of its `edges`, to be written in place.
    motion: since the keyframe before, by wheels. up: in the camera, as it was measured.
    links: indices of earlier keyframes that it shared many points with when it was made.
    ground: what it shows of the floor. is_thin: whether features that show no point are gone, so
    that rows from before do not count any more.
    """

    index: int
    frame_index: int
    stamp_ns: int
    T_camera_world: Array
    features: Features | None
    octave: NDArray[np.uint8]
    observations: Observations
    point_id: NDArray[np.int32]
    motion: RelativeMotion | None = None
    up: Up | None = None
    retired: Retirement | None = None
    links: tuple[int, ...] = ()
    ground: GroundView = NOTHING
    is_thin: bool = False

    @property
    def T_world_camera(self) -> Array:
        """The camera's pose (4, 4)."""
        return invert(self.T_camera_world)

    @property
    def seen_ids(self) -> NDArray[np.int32]:
        """The rows (N,) of the points that its features show."""
        return self.point_id[self.point_id != NO_POINT]


def _column(name: str) -> Any:
    """Return a property that is a column of the points, a writable view indexed by row."""
    return property(lambda sparse_map: sparse_map.points[name])


class SparseMap:
    """Points, keyframes and who observes whom.

    Of the points (P): xyz_world: (P, 3) positions. stable_id: (P,), ascending with age and never
    used again. alive: (P,) whether a point is part of the map. descriptor: (P, 32) as last seen by
    a keyframe, from viewing_distance_m (P,) along viewing_direction (P, 3), a unit vector in world
    axes, at the pyramid level viewing_octave (P,). patch: (P, SIDE_PX, SIDE_PX) grey levels around
    it, from patch_distance_m (P,); kept as long as its size in the image stays about the same:
    every change of patch adds an error to the position. observer_count: (P,) keyframes that observe
    it. points: all of these; edges: the observations. rig: the camera that sees all of this.
    """

    xyz_world: Array = _column('xyz_world')
    stable_id: NDArray[np.int32] = _column('stable_id')
    alive: NDArray[np.bool_] = _column('alive')
    descriptor: NDArray[np.uint8] = _column('descriptor')
    patch: NDArray[np.uint8] = _column('patch')
    patch_distance_m: Array = _column('patch_distance_m')
    viewing_distance_m: Array = _column('viewing_distance_m')
    viewing_octave: Array = _column('viewing_octave')
    viewing_direction: Array = _column('viewing_direction')
    observer_count: NDArray[np.int32] = _column('observer_count')

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.reset()

    def reset(self, num_ever: int = 0) -> None:
        """Begin again with an empty map. num_ever: the first stable id."""
        self.keyframes: list[KeyframeRecord] = []
        self.first_poses: list[Array] = []
        """T_camera_world (4, 4) of the keyframes as they came into the map."""
        self.loops: list[LoopEdge] = []
        self._retired: list[KeyframeRecord] = []
        self.points = PointRows(num_ever)
        self._links = GrowingArray((2,), np.intp)
        self._linked = 0
        self.edges = Edges()

    def restore(self, keyframe: KeyframeRecord) -> None:
        """Add a keyframe whose points are there already."""
        self._add(keyframe)
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
        keyframe.point_id[new_rows] = self.points.add(
            len(new_xyz_world),
            xyz_world=new_xyz_world,
            born=keyframe.index,
            seen_last=keyframe.index,
        )
        self._look(keyframe, self._add(keyframe), patches)

    def _add(self, keyframe: KeyframeRecord) -> NDArray[np.intp]:
        """Add a keyframe; returns its features (N,) that show a point."""
        before = self.edges.point.base
        self.keyframes.append(keyframe)
        self.first_poses.append(keyframe.T_camera_world.copy())
        self.edges.add(keyframe.point_id)
        has_moved = self.edges.point.base is not before
        self._bind(0 if has_moved else keyframe.index)
        rows = np.flatnonzero(keyframe.point_id != NO_POINT)
        self.observer_count[keyframe.point_id[rows]] += 1
        return rows

    def _bind(self, first: int) -> None:
        """Let keyframes from one on show what `edges` says: there is one truth."""
        for keyframe in self.keyframes[first:]:
            keyframe.point_id = self.edges.of(keyframe.index)

    def _look(
        self, keyframe: KeyframeRecord, rows: NDArray[np.intp], patches: NDArray[np.uint8]
    ) -> None:
        ids = keyframe.point_id[rows]
        sight = self.xyz_world[ids] - keyframe.T_world_camera[:3, 3]
        distance = np.linalg.norm(sight, axis=1)
        self.descriptor[ids] = features_of(self, keyframe).descriptor[rows]
        self.points['seen_last'][ids] = keyframe.index
        self.viewing_distance_m[ids] = distance
        self.viewing_octave[ids] = keyframe.octave[rows]
        self.viewing_direction[ids] = sight / distance[:, None]
        zoom = np.abs(np.log(np.maximum(self.patch_distance_m[ids], 1e-6) / distance))
        stale = zoom > np.log(MAX_PATCH_ZOOM)
        self.patch[ids[stale]] = patches[rows[stale]]
        self.patch_distance_m[ids[stale]] = distance[stale]

    def unlink(self, keyframe: int | NDArray[np.integer], row: NDArray[np.integer]) -> None:
        """Forget observations: features `row` (N,) that show a point, of a keyframe, or of
        keyframes (N,), by index. A point that nobody observes any more is removed.
        """
        at = self.edges.at(keyframe, row)
        ids = self.edges.point[at]
        self.edges.point[at] = NO_POINT
        np.subtract.at(self.observer_count, ids, 1)
        self.alive[ids[self.observer_count[ids] <= 0]] = False

    def retire(self, keyframe: KeyframeRecord, reference: KeyframeRecord) -> None:
        """Take a keyframe's observations out of the map and let its pose follow `reference`; its
        index and stamp stay.
        """
        self.unlink(keyframe.index, np.flatnonzero(keyframe.point_id != NO_POINT))
        self.thin_out(keyframe)
        keyframe.ground = NOTHING
        keyframe.retired = Retirement(
            reference.index, keyframe.T_camera_world @ reference.T_world_camera
        )
        self._retired.append(keyframe)

    def thin_out(self, keyframe: KeyframeRecord) -> None:
        """Forget the features of a keyframe that show no point: of an old one they will never. Of
        the others as much is kept as in a file.
        """
        rows = np.flatnonzero(keyframe.point_id != NO_POINT)
        self.edges.keep(keyframe.index, rows)
        self._bind(keyframe.index)
        keyframe.features = None
        keyframe.octave = keyframe.octave[rows]
        keyframe.observations = keyframe.observations.take(rows).compact()
        keyframe.is_thin = True

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
        gone = np.append(~self.alive, False)  # `NO_POINT` is the last
        self.edges.point[gone[self.edges.point]] = NO_POINT

    def seen_together(self, a: NDArray[np.integer], b: NDArray[np.integer]) -> NDArray[np.bool_]:
        """Return whether a keyframe observes both points of each pair (a[i], b[i]), (N,); no point
        occurs twice.
        """
        both = np.concatenate([a, b])
        point, keyframe, _ = self.edges_of(both)
        order = np.argsort(both)
        number = order[np.searchsorted(both, point, sorter=order)]
        of_b = number >= len(a)
        key = number % max(len(a), 1) * len(self.keyframes) + keyframe
        together = np.zeros(len(a), bool)
        together[np.intersect1d(key[~of_b], key[of_b]) // len(self.keyframes)] = True
        return together

    def merge(self, a: NDArray[np.integer], b: NDArray[np.integer]) -> int:
        """Make one point of each pair (a[i], b[i]), (N,), that no keyframe observes both of, with
        the id of the older one; returns how many. The better known one gives the position and the
        patch, the one seen last the look.
        """
        separate = ~self.seen_together(a, b)
        a, b = a[separate], b[separate]
        older = self.stable_id[a] < self.stable_id[b]
        kept, gone = np.where(older, a, b), np.where(older, b, a)
        better = self.observer_count[gone] > self.observer_count[kept]
        later = self.points['seen_last'][gone] > self.points['seen_last'][kept]
        for names, chosen in ((OF_POSITION, better), (OF_LOOK, later)):
            for name in names:
                self.points[name][kept[chosen]] = self.points[name][gone[chosen]]
        for name in ('visible_count', 'found_count', 'observer_count'):
            self.points[name][kept] += self.points[name][gone]
        born = self.points['born']
        born[kept] = np.minimum(born[kept], born[gone])
        self.alive[gone] = False
        new_row = np.arange(len(self.alive) + 1, dtype=np.int32)
        new_row[gone], new_row[NO_POINT] = kept, NO_POINT
        self.edges.point[:] = new_row[self.edges.point]
        return len(kept)

    def poor_points(self, settled_before: int) -> NDArray[np.intp]:
        """Return ids of points that tracking seldom finds, that are gone, or that only one keyframe
        saw although made before keyframe `settled_before`.
        """
        found = self.points['found_count']
        seldom = found < FOUND_SHARE * self.points['visible_count']
        seldom |= self.points['seen_through_count'] >= PROOF
        lonely = (self.points['born'] < settled_before) & (self.observer_count < 2)
        return np.flatnonzero(self.alive & (seldom | lonely))

    def covisible(self, ids: NDArray[np.integer]) -> Covisible:
        """Return the keyframes that observe any of the points (N,)."""
        shared = self.edges.count(_among(self, ids))
        order = np.lexsort((-np.arange(len(shared)), -shared))
        order = order[shared[order] > 0]
        return order, shared[order]

    def points_of(self, keyframe_indices: NDArray[np.integer]) -> NDArray[np.int32]:
        """Return the ascending rows of all points that the keyframes observe."""
        observed = np.zeros(len(self.alive) + 1, bool)  # one more: NO_POINT is the last
        for k in keyframe_indices:
            observed[self.keyframes[k].point_id] = True
        return np.flatnonzero(observed[:-1]).astype(np.int32)

    def edges_of(self, ids: NDArray[np.integer]) -> Observers:
        """Return all observations of the points (N,)."""
        return self.edges.to(_among(self, ids))


def _among(sparse_map: SparseMap, ids: NDArray[np.integer]) -> NDArray[np.bool_]:
    """Return which points (P,) of a map are among some (N,)."""
    wanted = np.zeros(len(sparse_map.alive), bool)
    wanted[ids] = True
    return wanted


def median_depth_m(sparse_map: SparseMap, ids: NDArray[np.integer], T_camera_world: Array) -> float:
    """Return the median depth of points (N,) before a camera."""
    depth = transform_points(T_camera_world, sparse_map.xyz_world[ids])[:, 2]
    return max(float(np.median(depth)), MIN_DEPTH_M) if len(ids) else MIN_DEPTH_M


def features_of(sparse_map: SparseMap, keyframe: KeyframeRecord) -> Features:
    """Return the features of a keyframe; those of an old one look like the points they show."""
    if keyframe.features is not None:
        return keyframe.features
    uv_px = keyframe.observations.uvd_px[:, :2].astype(np.float32)
    return Features(uv_px, keyframe.octave, sparse_map.descriptor[keyframe.point_id])
