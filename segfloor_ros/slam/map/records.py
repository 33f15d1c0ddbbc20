"""What is known of map points, by column; the row of a point that is gone goes to a new one.

An array that grows.

A keyframe of the map, and what ties it to others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import Up
from segfloor_ros.files.saved_map import Arrays, check_lengths
from segfloor_ros.geometry import Array, invert
from segfloor_ros.slam.rig import Observations
from segfloor_ros.slam.sensors.body_motion import RelativeMotion
from segfloor_ros.slam.tracking.features import Features
from segfloor_ros.slam.tracking.patch_alignment import SIDE_PX


@dataclass(frozen=True)
class Column:
    """A column of rows of some shape. in_file: the type that is exact enough for a file; None for
    what follows from the rest. start: the value of a new point, unless it is given.
    """

    dtype: type
    in_file: type | None
    shape: tuple[int, ...] = ()
    start: Any = 0


COLUMNS = {
    'xyz_world': Column(np.float64, np.float64, (3,)),
    'stable_id': Column(np.int32, np.int32),
    'alive': Column(np.bool_, None, start=True),
    'descriptor': Column(np.uint8, np.uint8, (32,)),
    'patch': Column(np.uint8, np.uint8, (SIDE_PX, SIDE_PX)),
    'patch_distance_m': Column(np.float64, np.float32),
    'viewing_distance_m': Column(np.float64, np.float32),
    'viewing_octave': Column(np.float64, np.float32),
    'viewing_direction': Column(np.float64, np.float32, (3,)),
    'visible_count': Column(np.int32, np.int32, start=1),
    'found_count': Column(np.int32, np.int32, start=1),
    'observer_count': Column(np.int32, None),
    'seen_through_count': Column(np.int32, np.int32),
    'born': Column(np.int32, np.int32),
    'seen_last': Column(np.int32, np.int32),
}

OF_KEYFRAMES = ('born', 'seen_last')
"""Columns that hold indices of keyframes."""


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

    def to_arrays(self, rows: NDArray[np.intp]) -> Arrays:
        """Return what a file holds of some rows (N,)."""
        arrays: Arrays = {
            f'point_{name}': self[name][rows].astype(column.in_file)
            for name, column in COLUMNS.items()
            if column.in_file is not None
        }
        return arrays | {'num_ever': np.array([self.num_ever])}

    def from_arrays(self, arrays: Arrays, first_keyframe: int) -> None:
        """Add what `to_arrays` returned, behind points that are all alive; its keyframes are
        counted from first_keyframe on. Raises KeyError or ValueError for other arrays.
        """
        kept = [name for name, column in COLUMNS.items() if column.in_file is not None]
        check_lengths({name: arrays[f'point_{name}'] for name in kept})
        rows = self.add(len(arrays['point_stable_id']))
        for name in kept:
            self[name][rows] = arrays[f'point_{name}']
        for name in OF_KEYFRAMES:
            self[name][rows] += first_keyframe
        self.num_ever = int(arrays['num_ever'][0])


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

    def keep(self, chosen: NDArray[np.bool_]) -> None:
        """Drop the rows that are not chosen (N,)."""
        kept = self.rows[chosen]
        self._buffer[: len(kept)] = kept
        self._length = len(kept)


class Edges:
    """Observations (E,): the row of a point, the index of a keyframe, and its feature."""

    def __init__(self) -> None:
        self._columns = [GrowingArray((), np.int32) for _ in range(3)]

    @property
    def point(self) -> NDArray[np.int32]:
        """The points, a writable view."""
        return self._columns[0].rows

    @property
    def keyframe(self) -> NDArray[np.int32]:
        """The keyframes that observe them."""
        return self._columns[1].rows

    @property
    def row(self) -> NDArray[np.int32]:
        """Their features in these."""
        return self._columns[2].rows

    def add(self, ids: NDArray[np.int32], keyframe: int, rows: NDArray[np.intp]) -> None:
        """Add what a keyframe observes."""
        columns: tuple[NDArray[Any], ...] = ids, np.full(len(ids), keyframe, np.int32), rows
        for column, values in zip(self._columns, columns, strict=True):
            column.extend(values)

    def drop(self, dropped: NDArray[np.bool_]) -> None:
        """Drop observations (E,)."""
        for column in self._columns:
            column.keep(~dropped)


@dataclass(frozen=True)
class Retirement:
    """Where a retired keyframe was seen from the keyframe (by index) that it follows."""

    reference: int
    T_camera_reference: Array


@dataclass(frozen=True)
class LoopEdge:
    """Where keyframe i was when it saw the place of keyframe j again: T_i_j (4, 4), of cameras."""

    i: int
    j: int
    T_i_j: Array


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


@dataclass
class KeyframeRecord:
    """One keyframe of the map.

    The pose moves in bundle adjustment. observations: as measured, the disparity offset of the rig
    not taken off. retired: set when the keyframe has no features any more and only follows another
    one. point_id: (N,) int32, the row of each feature's map point, not its stable id.
    motion: since the keyframe before, by wheels. up: in the camera, as it was measured.
    links: indices of earlier keyframes that it shared many points with when it was made.
    """

    index: int
    frame_index: int
    stamp_ns: int
    T_camera_world: Array
    features: Features
    observations: Observations
    point_id: NDArray[np.int32]
    motion: RelativeMotion | None = None
    up: Up | None = None
    retired: Retirement | None = None
    links: tuple[int, ...] = ()

    @property
    def T_world_camera(self) -> Array:
        """The camera's pose (4, 4)."""
        return invert(self.T_camera_world)
