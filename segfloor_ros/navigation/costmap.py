"""What a robot may drive over, and the shortest ways across it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra

from segfloor_ros.geometry import Array
from segfloor_ros.grid.map_file import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

Mask = NDArray[np.bool_]
Cells = NDArray[np.int64]


def room_around(free_of_obstacles: Mask, cell_m: float) -> Array:
    """Return how far each cell (rows, columns) is from the nearest obstacle, in metres. What is
    beyond the border is not one.
    """
    mask = free_of_obstacles.astype(np.uint8)
    if mask.all():
        return np.full(mask.shape, np.inf)
    return np.asarray(cv2.distanceTransform(mask, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) * cell_m)


def graph_of(places: Mask, cell_m: float, weight: Array) -> csr_array:
    """Return the symmetric graph of steps between the eight neighbours of places, in the order of
    `np.argwhere(places)`: the length of a step times the weight of the place where it begins.
    """
    index = np.full(np.array(places.shape) + 2, -1, np.int32)
    index[1:-1, 1:-1][places] = np.arange(places.sum())
    here = index[1:-1, 1:-1][places]
    rows, columns, costs = [], [], []
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
        shifted = index[1 + dy : index.shape[0] - 1 + dy, 1 + dx : index.shape[1] - 1 + dx][places]
        linked = shifted >= 0
        rows += [here[linked], shifted[linked]]
        columns += [shifted[linked], here[linked]]
        costs += [np.hypot(dy, dx) * cell_m * weight[linked]] * 2
    size = int(places.sum())
    entries = (np.concatenate(costs), (np.concatenate(rows), np.concatenate(columns)))
    return coo_array(entries, shape=(size, size)).tocsr()


@dataclass(frozen=True)
class Ways:
    """The shortest ways from one place. cells (N, 2): rows and columns of all places. cost (N,):
    of the way to each, inf where there is none. before (N,): the place before it, -1 at the start.
    """

    cells: Cells
    cost: Array
    before: NDArray[np.int32]

    @classmethod
    def from_place(cls, graph: csr_array, cells: Cells, start: int) -> Ways:
        """Find the shortest way to every place (Dijkstra)."""
        cost, before = dijkstra(graph, indices=[start], return_predecessors=True)
        return cls(cells, cost[0], before[0])

    def to(self, goal: int) -> list[int]:
        """Return the places after the start up to the goal."""
        way: list[int] = []
        while self.before[goal] >= 0:
            way.append(goal)
            goal = int(self.before[goal])
        return way[::-1]


class Costmap:
    """A map as a robot of some radius may drive on it.

    obstacles: points (N, 2) in the map that are in the way, too. driven: points (M, 2) where the
    robot has been, the last one now: floor unless the map says otherwise. blind_m: around the
    first of them it cannot see the floor. comfort_m: nearer to an obstacle than this a way counts
    more, up to three times.
    """

    def __init__(
        self,
        grid: OccupancyGrid,
        radius_m: float,
        comfort_m: float,
        obstacles: Array,
        driven: Array,
        blind_m: float,
    ) -> None:
        self.grid = grid
        trodden = self._discs(driven, radius_m) | self._discs(driven[:1], blind_m)
        marked = np.zeros(trodden.shape, bool)
        marked[tuple(self._on_map(self.cells_of(obstacles)).T)] = True
        standing = (grid.cells >= OCCUPIED) | (marked & ~trodden)
        standing &= ~self._discs(driven[-1:], radius_m)
        self.free = ((grid.cells == FREE) | trodden) & ~standing
        unknown = np.pad((grid.cells == UNKNOWN) & ~trodden, 1, constant_values=True)
        dark = cv2.morphologyEx(unknown.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        self.dark = dark[1:-1, 1:-1] > 0
        """What is unknown, but for slits that the map leaves along walls."""
        self._dark_m = room_around(dark == 0, grid.resolution_m)[1:-1, 1:-1]
        standing_m = room_around(~standing, grid.resolution_m)
        self.room_m = np.minimum(standing_m, self._dark_m)
        self._radius_m = radius_m
        self.places = self.free & (self.room_m > radius_m)
        self._cells = np.argwhere(self.places)
        self._index = np.full(self.places.shape, -1, np.int64)
        self._index[self.places] = np.arange(len(self._cells))
        tightness = np.clip((comfort_m - standing_m) / (comfort_m - radius_m), 0, 1)
        self._graph = graph_of(self.places, grid.resolution_m, 1 + 2 * tightness[self.places])

    def cells_of(self, points: Array) -> Cells:
        """Return rows and columns (N, 2) of points (N, 2) in the map."""
        xy = (np.reshape(points, (-1, 2)) - self.grid.origin_xy_m) / self.grid.resolution_m
        return np.floor(xy[:, ::-1]).astype(np.int64)

    def points_of(self, cells: Cells) -> Array:
        """Return the middles (N, 2) of cells in the map."""
        return np.array(self.grid.origin_xy_m) + (cells[:, ::-1] + 0.5) * self.grid.resolution_m

    def ways_from(self, point: Array, reach_m: float) -> Ways | None:
        """Return the ways from the place nearest to a point (2,); None where none is in reach."""
        if not len(self._cells):
            return None
        start, away_m = self.nearest_place(point)
        return Ways.from_place(self._graph, self._cells, start) if away_m <= reach_m else None

    def nearest_place(self, point: Array) -> tuple[int, float]:
        """Return the number of the place nearest to a point (2,), and how far it is in metres."""
        away_m = np.hypot(*(self.points_of(self._cells) - point).T)
        nearest = int(np.argmin(away_m))
        return nearest, float(away_m[nearest])

    def least_room_m(self, start: Array, end: Array) -> float:
        """Return how near what may be in the way comes to the straight line between points (2,)."""
        count = 2 + int(2 * np.hypot(*(end - start)) / self.grid.resolution_m)
        cells = self._on_map(self.cells_of(np.linspace(start, end, count)))
        return float(self.room_m[tuple(cells.T)].min(initial=np.inf))

    def numbers_of(self, cells: Cells) -> NDArray[np.int64]:
        """Return the numbers (N,) of places at cells (N, 2)."""
        return np.asarray(self._index[tuple(cells.T)])

    def _on_map(self, cells: Cells) -> Cells:
        return cells[((cells >= 0) & (cells < self.grid.cells.shape)).all(axis=1)]

    def _discs(self, points: Array, radius_m: float) -> Mask:
        """Return the cells around points."""
        mask = np.zeros(self.grid.cells.shape, np.uint8)
        for row, column in self.cells_of(points).tolist():
            cv2.circle(mask, (column, row), round(radius_m / self.grid.resolution_m), 1, -1)
        return mask > 0

    def frontiers(self) -> list[Cells]:
        """Return the places next to what is unknown, (N, 2) for each connected stretch of them."""
        near_m = self._radius_m + 2 * self.grid.resolution_m
        border = (self.places & (self._dark_m <= near_m)).astype(np.uint8)
        count, labels = cv2.connectedComponents(border, connectivity=8)
        return [np.argwhere(labels == label) for label in range(1, count)]
