"""How far a view reaches before the first occupied cell, by bearing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array
from segfloor_ros.grid.fan import Fan

TURN = 2 * np.pi


def nearest_cells(
    column: NDArray[np.integer], row: NDArray[np.integer], fan: Fan
) -> NDArray[np.float64]:
    """Return the distance (S,) in cells to the nearest of some cells along a fan's bearings.

    column, row: (N,). A cell covers the bearings within half a cell of its centre; bearings that
    no cell covers are infinite.
    """
    x, y = column + (0.5 - fan.centre[0]), row + (0.5 - fan.centre[1])
    distance: Array = np.sqrt(x * x + y * y)
    bearing = np.remainder(np.arctan2(y, x) - fan.first_rad, TURN) * (1 / fan.step_rad)
    half_width = (0.5 / fan.step_rad) / np.maximum(distance, 0.5)
    first = np.ceil(bearing - half_width).astype(np.intp)
    count = np.floor(bearing + half_width).astype(np.intp) - first + 1
    start = np.cumsum(count) - count
    index = np.arange(count.sum()) + np.repeat(first - start, count)
    nearest = np.full(int(np.ceil(TURN / fan.step_rad)), np.inf)
    np.minimum.at(nearest, index % len(nearest), np.repeat(distance, count))
    return nearest[: len(fan.lengths)]
