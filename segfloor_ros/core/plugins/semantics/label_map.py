"""The likeliest class of every point and cell of a map, from the labels of its keyframes.

What a keyframe saw is kept in the frame of its base, as the grid keeps its evidence, and is counted
anew where the keyframes lie now.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.contracts import (
    CELL_M,
    FLOOR,
    NO_POINT,
    NOT_FLOOR,
    KeyframeFeatures,
    KeyframePath,
    Mount,
)
from segfloor_ros.core.files.arrays import Arrays, joined, split
from segfloor_ros.core.geometry import transform_points
from segfloor_ros.core.grid.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from segfloor_ros.core.plugins.semantics.outputs import UNLABELLED

LABELS = 'labels'
"""What a saved map calls its part of what networks saw."""

STEP_PX = 4
"""Every so many pixels of a keyframe count, in both directions: cells are larger."""


SEEN_LENGTHS = {'cells': 'cell_count', 'points': 'point_count'}
"""The arrays of a keyframe, and what holds their lengths."""


@dataclass(frozen=True)
class _Seen:
    """What one keyframe saw. cells: (N, 5) int16, x and y in its base in `CELL_M`, class, whether
    it stands up, and how many pixels showed it; points: (M, 2) int32, of the map, with the class.
    """

    cells: NDArray[np.int16]
    points: NDArray[np.int32]


class LabelMap:
    """Counts labels, keyframe by keyframe. classes: names by number; those of a map that is loaded
    join them. robot_height_m: what hangs higher does not count. moves: classes of what stands where
    it has a disparity, whatever the floor mask says.
    """

    def __init__(
        self,
        camera: StereoCamera,
        classes: Sequence[str] = (),
        robot_height_m: float = math.inf,
        moves: Sequence[str] = (),
    ) -> None:
        self.classes = list(classes)
        self._camera = camera
        self._robot_height_m = robot_height_m
        self._moves = [self.classes.index(name) for name in moves]
        self._seen: dict[int, _Seen] = {}

    def add(
        self,
        stamp_ns: int,
        labels: NDArray[np.uint8],
        mask: NDArray[np.uint8],
        disparity_px: NDArray[np.float32],
        mount: Mount,
        features: KeyframeFeatures,
        reach_m: float,
    ) -> None:
        """Take in a keyframe: labels, floor mask and disparity (H, W) of its left image. What is
        farther away than reach_m does not count.
        """
        rows, columns = np.mgrid[: labels.shape[0] : STEP_PX, : labels.shape[1] : STEP_PX]
        uv = np.stack([columns.ravel(), rows.ravel()], axis=1)
        label, kind, disparity = (a[uv[:, 1], uv[:, 0]] for a in (labels, mask, disparity_px))
        rays = self._camera.back_project(uv.astype(np.float64), np.ones(len(uv)))
        T = mount.T_base_left
        with np.errstate(divide='ignore', invalid='ignore'):
            down = -T[2, 3] / (rays @ T[2, :3])
            depth_m = np.where(kind == FLOOR, down, self._camera.disparity_times_depth / disparity)
            xyz = transform_points(T, rays * depth_m[:, None])
            near = (depth_m > 0) & (np.hypot(xyz[:, 0], xyz[:, 1]) < reach_m)
        upright = (kind == NOT_FLOOR) | ((kind != FLOOR) & np.isin(label, self._moves))
        upright &= (disparity > 0) & (xyz[:, 2] < self._robot_height_m)
        kept = near & ((kind == FLOOR) | upright) & (label < len(self.classes))
        places = np.floor(xyz[kept, :2] / CELL_M)
        cells = np.column_stack([places, label[kept], upright[kept]]).astype(np.int16)
        cells, pixels = np.unique(cells, axis=0, return_counts=True)
        shows = features.point_id != NO_POINT
        at = np.rint(features.uv_px[shows]).astype(np.intp)
        limit = np.array(labels.shape[::-1]) - 1
        u, v = np.clip(at, 0, limit).T
        points = np.column_stack([features.point_id[shows], labels[v, u]]).astype(np.int32)
        self._seen[stamp_ns] = _Seen(
            np.column_stack([cells, pixels]).astype(np.int16),
            points[points[:, 1] < len(self.classes)],
        )

    def cells(self, grid: OccupancyGrid, path: KeyframePath) -> NDArray[np.uint8]:
        """Return the likeliest class of each cell of a grid, (rows, columns): of what stands there
        where it is occupied, of the floor where it is free, `UNLABELLED` elsewhere. path: where
        the keyframes lie now.
        """
        rows = [np.zeros((0, 4), np.int64)]
        for stamp_ns, T in zip(path.stamp_ns.tolist(), path.T_map_base, strict=True):
            if stamp_ns in self._seen:
                seen = self._seen[stamp_ns].cells
                xy = (seen[:, :2] + 0.5) * CELL_M @ T[:2, :2].T + T[:2, 3]
                cells = grid.cells_of(xy)
                inside = grid.holds(cells)
                cell = np.ravel_multi_index(cells[inside].T, grid.cells.shape)
                rows.append(np.column_stack([cell, seen[inside, 2:]]))
        cell, label, stands, pixels = np.concatenate(rows).T
        kinds, best = grid.cells.reshape(-1), np.full(grid.cells.size, UNLABELLED, np.uint8)
        for is_upright, is_of in enumerate((kinds == FREE, kinds == OCCUPIED)):
            of = stands == is_upright
            likeliest = _likeliest(cell[of], label[of], pixels[of], len(kinds))
            best = np.where(is_of, likeliest, best)
        return best.reshape(grid.cells.shape)

    def points(self, point_id: NDArray[np.int32]) -> NDArray[np.uint8]:
        """Return the likeliest class (N,) of points by id, ascending."""
        seen = [one.points for one in self._seen.values()]
        ids, label = np.concatenate([np.zeros((0, 2), np.int64), *seen]).T
        row = np.minimum(np.searchsorted(point_id, ids), max(len(point_id) - 1, 0))
        known = point_id[row] == ids if len(point_id) else np.zeros(0, np.bool_)
        return _likeliest(row[known], label[known], np.ones(known.sum(), int), len(point_id))

    def to_arrays(self) -> Arrays:
        """Return what the keyframes saw, for a file."""
        seen = list(self._seen.values())
        cells, cell_count = joined([one.cells for one in seen], np.zeros((0, 5), np.int16))
        points, point_count = joined([one.points for one in seen], np.zeros((0, 2), np.int32))
        names = np.frombuffer('\n'.join(self.classes).encode(), np.uint8)
        return {
            'names': names,
            'stamp_ns': np.array(list(self._seen), np.int64),
            'cells': cells,
            'cell_count': cell_count,
            'points': points,
            'point_count': point_count,
        }

    def from_arrays(self, arrays: Arrays, shift_ns: int = 0, first_id: int = 0) -> None:
        """Take in what `to_arrays` returned, with later stamps and higher ids; classes keep their
        names. Raises KeyError, IndexError or ValueError for other arrays.
        """
        names = arrays['names'].astype(np.uint8).tobytes().decode().split('\n')
        self.classes += [name for name in names if name not in self.classes]
        if len(self.classes) > UNLABELLED:
            raise ValueError('too many classes')
        number = np.array([self.classes.index(name) for name in names])
        cells = split(arrays['cells'], arrays['cell_count'])
        points = split(arrays['points'], arrays['point_count'])
        for stamp_ns, *seen in zip(arrays['stamp_ns'].tolist(), cells, points, strict=True):
            x, y, label, stands, pixels = seen[0].T
            ids, label_of = seen[1].T
            self._seen[stamp_ns + shift_ns] = _Seen(
                np.column_stack([x, y, number[label], stands, pixels]).astype(np.int16),
                np.column_stack([ids + first_id, number[label_of]]).astype(np.int32),
            )

    def labels(
        self, grid: OccupancyGrid | None, path: KeyframePath, point_id: NDArray[np.int32]
    ) -> Labels | None:
        """Return the labels of a map, None where no network has looked at it."""
        if not self.classes:
            return None
        cells = None if grid is None else self.cells(grid, path)
        return Labels(self.classes, cells, self.points(point_id))


def _likeliest(
    where: NDArray[np.integer], label: NDArray[np.integer], weight: NDArray[np.integer], count: int
) -> NDArray[np.uint8]:
    """Return the class (count,) with the most weight at each place, `UNLABELLED` where there is
    none. where, label, weight: (N,).
    """
    key, of = np.unique(where * (UNLABELLED + 1) + label, return_inverse=True)
    place, number = np.divmod(key, UNLABELLED + 1)
    order = np.lexsort((-number, np.bincount(of, weight, len(key)), place))
    best = np.full(count, UNLABELLED, np.uint8)
    best[place[order]] = number[order]  # the last one of a place stays
    return best


def numbered(grid: OccupancyGrid, cells: NDArray[np.uint8]) -> OccupancyGrid:
    """Return a grid with the numbers of classes (rows, columns) in place of its cells, unknown
    where there is none; a map has room for the first 101.
    """
    numbers = np.where(cells <= OCCUPIED, cells, UNKNOWN).astype(np.int8)
    return OccupancyGrid(numbers, grid.resolution_m, grid.origin_xy_m)


@dataclass(frozen=True)
class Labels:
    """What is known of a whole map. classes: names by number. cells: (rows, columns) of its grid,
    None where there is no grid. points: (N,) of its cloud, None where that is not known.
    """

    classes: list[str]
    cells: NDArray[np.uint8] | None
    points: NDArray[np.uint8] | None
