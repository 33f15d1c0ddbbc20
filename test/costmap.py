"""As much of Nav2's ObstacleLayer as marks and clears (nav2_costmap_2d, obstacle_layer.cpp)."""

import numpy as np

FREE, LETHAL = 0, 254
INF_EPSILON = 1e-4


class Costmap:
    """A costmap over a rectangle, lower to upper corner (2,), in metres."""

    def __init__(self, lower: np.ndarray, upper: np.ndarray, resolution_m: float = 0.05) -> None:
        self._lower, self._resolution_m = np.asarray(lower, float), resolution_m
        columns, rows = np.ceil((upper - self._lower) / resolution_m).astype(int)
        self.cells = np.full((rows, columns), FREE, np.uint8)

    def mark(self, points: np.ndarray, origin: np.ndarray, obstacle_max_range: float) -> None:
        """Mark points (N, 2) that are within range of the sensor's origin."""
        near = np.hypot(*(points - origin).T) < obstacle_max_range
        rows, columns = self._cell(points[near])
        self.cells[rows, columns] = LETHAL

    def clear(
        self,
        T_map_base: np.ndarray,
        bearings: np.ndarray,
        ranges: np.ndarray,
        range_max: float,
        raytrace_max_range: float,
    ) -> None:
        """Clear along the rays of a LaserScan, with `inf_is_valid` and without marking.

        As the layer and laser_geometry do: inf becomes range_max - 0.0001; what is not a number, or
        not within [range_min, range_max), is left out; a ray is cut at the end of the map and at
        raytrace_max_range, and its last cell is cleared, too.
        """
        ranges = np.where(np.isposinf(ranges), range_max - INF_EPSILON, ranges)
        valid = (ranges >= 0) & (ranges < range_max)
        origin = T_map_base[:2, 3]
        for bearing, length in zip(bearings[valid], ranges[valid], strict=True):
            direction = T_map_base[:2, :2] @ [np.cos(bearing), np.sin(bearing)]
            end = origin + direction * min(length, raytrace_max_range)
            for row, column in self._line(origin, end):
                self.cells[row, column] = FREE

    def is_lethal(self, points: np.ndarray) -> np.ndarray:
        """Return which points (N, 2) lie in a marked cell."""
        rows, columns = self._cell(points)
        return self.cells[rows, columns] == LETHAL

    def _cell(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        found = np.floor((np.atleast_2d(points) - self._lower) / self._resolution_m).astype(int)
        return found[:, 1], found[:, 0]

    def _line(self, start: np.ndarray, end: np.ndarray) -> list[tuple[int, int]]:
        """Return the cells of Bresenham's line between two points that are in the map."""
        (row0,), (column0,) = self._cell(start)
        (row1,), (column1,) = self._cell(end)
        count = max(abs(row1 - row0), abs(column1 - column0)) + 1
        rows = np.rint(np.linspace(row0, row1, count)).astype(int)
        columns = np.rint(np.linspace(column0, column1, count)).astype(int)
        height, width = self.cells.shape
        inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        return list(zip(rows[inside].tolist(), columns[inside].tolist(), strict=True))
