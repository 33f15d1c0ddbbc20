"""How far the floor is free per bearing, of one frame: what clears a local costmap."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.floor.observation import FloorScan

MARGIN_M = 0.05
"""A ray ends so far before what stands up, so that it does not clear the cell of that."""


def free_ranges(scan: FloorScan) -> NDArray[np.float32]:
    """Return how far the floor is surely free per bearing, (N,) in metres, as REP-117 has it: inf
    where it is free as far as the camera can tell, -inf where something stands right in front, NaN
    where nothing is known.

    Where a ray ends at something upright, one sigma of its range and a cell's width are taken off.
    """
    ranges = scan.ranges_m.astype(np.float64)
    obstacle = scan.obstacle_m
    if obstacle is not None:
        touches = np.isfinite(obstacle) & (ranges > 0)
        ranges -= np.where(touches, scan.error_per_m * ranges**2 + MARGIN_M, 0.0)
    beyond = scan.ranges_m >= scan.range_max_m
    ranges[beyond] = np.inf
    ranges[scan.ranges_m == 0] = -np.inf
    ranges[(ranges <= 0) & np.isfinite(ranges)] = -np.inf
    return ranges.astype(np.float32)
