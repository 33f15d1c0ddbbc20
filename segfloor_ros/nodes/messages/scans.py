"""Floor scans as ROS has them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.contracts import CELL_M, RANGE_MAX_ERROR_M, FloorScan


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
        ranges -= np.where(touches, scan.error_per_m * ranges**2 + CELL_M, 0.0)
    beyond = scan.ranges_m >= scan.range_max_m
    ranges[beyond] = np.inf
    ranges[scan.ranges_m == 0] = -np.inf
    ranges[(ranges <= 0) & np.isfinite(ranges)] = -np.inf
    return ranges.astype(np.float32)


def near_obstacles(scan: FloorScan) -> tuple[NDArray[np.float32], float]:
    """Return how far away something stands or walks per bearing, (N,) in metres, inf where nothing
    is known to, and how far that is told: as far as its error, one sigma, is half a cell.
    """
    reach_m = scan.range_max_m * math.sqrt(CELL_M / 2 / RANGE_MAX_ERROR_M)
    nearest = np.full(len(scan.ranges_m), np.inf, np.float32)
    if scan.obstacle_m is not None:
        near = scan.obstacle_m < reach_m
        nearest[near] = scan.obstacle_m[near]
    return nearest, reach_m
