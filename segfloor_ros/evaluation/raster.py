"""Grids brought onto one raster, and the part of a floor that a drive could have seen."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.evaluation.prm import Mask
from segfloor_ros.evaluation.truth import Pose2d
from segfloor_ros.geometry import Array
from segfloor_ros.grid.occupancy import OccupancyGrid

FREE_BELOW = 20
OCCUPIED_FROM = 65
"""Occupancy values, in percent, that map files store as free and occupied."""

FREE, OCCUPIED, UNKNOWN = 0, 1, -1

BEARINGS = 361
SAME_PLACE_M = 0.1
SAME_HEADING_RAD = 0.05


def states(grid: OccupancyGrid) -> NDArray[np.int8]:
    """Return the cells (rows, columns) int8 as `FREE`, `OCCUPIED` or `UNKNOWN`."""
    result = np.full(grid.cells.shape, UNKNOWN, np.int8)
    result[(grid.cells >= 0) & (grid.cells < FREE_BELOW)] = FREE
    result[grid.cells >= OCCUPIED_FROM] = OCCUPIED
    return result


def cell_centres(grid: OccupancyGrid) -> Array:
    """Return the centres (rows * columns, 2) of a grid's cells in its frame, row by row."""
    rows, columns = np.indices(grid.cells.shape)
    cells = np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5
    return np.array(grid.origin_xy_m) + cells * grid.resolution_m


def sample_states(
    cell_states: NDArray[np.int8], grid: OccupancyGrid, points: Array
) -> NDArray[np.int8]:
    """Return the states (N,) of the cells that hold points (N, 2) of the grid's frame; `UNKNOWN`
    outside.
    """
    cells = np.floor((points - np.array(grid.origin_xy_m)) / grid.resolution_m).astype(np.int64)
    column, row = cells[:, 0], cells[:, 1]
    height, width = cell_states.shape
    inside = (row >= 0) & (column >= 0) & (row < height) & (column < width)
    result = np.full(len(points), UNKNOWN, np.int8)
    result[inside] = cell_states[row[inside], column[inside]]
    return result


def to_frame(points: Array, pose: Pose2d) -> Array:
    """Map points (N, 2) of a frame into the frame that lies in it at `pose`."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    dx, dy = points[:, 0] - pose[0], points[:, 1] - pose[1]
    return np.stack([c * dx + s * dy, c * dy - s * dx], axis=1)


def from_frame(points: Array, pose: Pose2d) -> Array:
    """Map points (N, 2) of the frame that lies at `pose` into the frame around it."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    x, y = points[:, 0], points[:, 1]
    return np.stack([pose[0] + c * x - s * y, pose[1] + s * x + c * y], axis=1)


def resample(estimate: OccupancyGrid, raster: OccupancyGrid, pose: Pose2d) -> NDArray[np.int8]:
    """Return the states of an estimate on the raster of another grid, (rows, columns) int8.

    pose: where the estimate's frame lies in the raster's frame.
    """
    points = to_frame(cell_centres(raster), pose)
    return sample_states(states(estimate), estimate, points).reshape(raster.cells.shape)


def observable(
    truth: OccupancyGrid, base_poses: Array, fov_rad: float, range_m: float
) -> tuple[Mask, Mask]:
    """Return the free cells in line of sight of some pose and the occupied cells first hit.

    base_poses: (N, 3) x, y, yaw. Sight is horizontal, `fov_rad` wide and `range_m` long.
    """
    cell_states = states(truth)
    seen = np.zeros(cell_states.shape, bool)
    hit = np.zeros(cell_states.shape, bool)
    bearings = np.linspace(-fov_rad / 2, fov_rad / 2, BEARINGS)
    distances = np.arange(0.0, range_m, truth.resolution_m / 2)
    for x, y, yaw in _distinct(base_poses):
        heading = (yaw + bearings)[:, None]
        ray_x, ray_y = x + np.cos(heading) * distances, y + np.sin(heading) * distances
        row, column = _clipped_cells(truth, ray_x, ray_y)
        state = cell_states[row, column]
        blocked = np.logical_or.accumulate(state != FREE, axis=1)
        seen[row[~blocked], column[~blocked]] = True
        first = blocked & (np.cumsum(blocked, axis=1) == 1) & (state == OCCUPIED)
        hit[row[first], column[first]] = True
    return seen & (cell_states == FREE), hit


def _clipped_cells(
    grid: OccupancyGrid, x: Array, y: Array
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return rows and columns of points; those outside fall on the border."""
    height, width = grid.cells.shape
    row = ((y - grid.origin_xy_m[1]) / grid.resolution_m).astype(np.int64)
    column = ((x - grid.origin_xy_m[0]) / grid.resolution_m).astype(np.int64)
    return np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)


def _distinct(base_poses: Array) -> Array:
    """Return the poses that differ noticeably from the one before."""
    kept = [base_poses[0]]
    for pose in base_poses[1:]:
        step = pose - kept[-1]
        if np.hypot(step[0], step[1]) >= SAME_PLACE_M or abs(step[2]) >= SAME_HEADING_RAD:
            kept.append(pose)
    return np.array(kept)
