"""How far one can look from the base before the first occupied cell, by bearing."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array

TURN = 2 * np.pi


class Horizon:
    """Distances of the nearest occupied cells around a base, in cells.

    Bearing i of the full turn is first_rad + i * step_rad. occupied: (rows, columns) uint8, base:
    (x, y) in its cells.
    """

    def __init__(
        self, occupied: NDArray[np.uint8], base: Array, first_rad: float, step_rad: float
    ) -> None:
        self._first_rad, self._step_rad = first_rad, step_rad
        self._nearest = np.full(int(np.ceil(TURN / step_rad)), np.inf)
        at = cv2.findNonZero(occupied)
        if at is None:
            return
        column, row = at.reshape(-1, 2).T
        x, y = column + (0.5 - base[0]), row + (0.5 - base[1])
        distance = np.sqrt(x * x + y * y)
        bearing = self._bearing(x, y)
        half_width = (0.5 / step_rad) / np.maximum(distance, 0.5)
        first = np.ceil(bearing - half_width).astype(np.intp)
        count = np.floor(bearing + half_width).astype(np.intp) - first + 1
        start = np.cumsum(count) - count
        index = np.arange(count.sum()) + np.repeat(first - start, count)
        index %= len(self._nearest)
        np.minimum.at(self._nearest, index, np.repeat(distance, count))

    def along_fan(self, count: int) -> Array:
        """Return the distances (count,) along the first bearings."""
        return self._nearest[:count]

    def towards(self, offset: Array) -> Array:
        """Return the distances (N,) in the directions of points (2, N) relative to the base."""
        index = np.rint(self._bearing(offset[0], offset[1])).astype(np.intp)
        return self._nearest[index % len(self._nearest)]

    def _bearing(self, x: Array, y: Array) -> Array:
        turned = np.arctan2(y, x) - self._first_rad
        return np.remainder(turned, TURN) * (1 / self._step_rad)
