"""The occupancy grid as data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FREE = 0
OCCUPIED = 100
UNKNOWN = -1


@dataclass(frozen=True)
class OccupancyGrid:
    """A 2D map as in nav_msgs/OccupancyGrid.

    cells: (rows, columns) int8, row 0 is the lowest y and column 0 the lowest x; 0 free to 100
    occupied, -1 unknown. resolution_m: side of a cell. origin_xy_m: the outer corner of cell (0, 0)
    in frame `map`.
    """

    cells: NDArray[np.int8]
    resolution_m: float
    origin_xy_m: tuple[float, float]
