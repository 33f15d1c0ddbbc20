"""The true occupancy map of a world, from its solids."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.errors import InputError
from segfloor_ros.geometry import Array
from segfloor_ros.grid.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from segfloor_ros.simulation.scene import Scene
from segfloor_ros.simulation.solids import Prism

SAMPLES_PER_CELL = 5
MARGIN_M = 0.5


def floor_height_m(floors: list[Prism], points: Array) -> Array:
    """Return the height (N,) of the floor at points (N, 2): 0, or the highest slope there."""
    heights = np.zeros(len(points))
    for prism in floors:
        inside = inside_footprint(prism, points)
        heights[inside] = np.maximum(heights[inside], _top_at(prism, points[inside]))
    return heights


def inside_footprint(prism: Prism, points: Array) -> NDArray[np.bool_]:
    """Return which points (N, 2) lie in a prism's footprint."""
    corners = prism.footprint
    edges = np.roll(corners, -1, axis=0) - corners
    offsets = points[:, None] - corners[None]
    left_of = edges[:, 0] * offsets[..., 1] - edges[:, 1] * offsets[..., 0] >= -1e-9
    return np.asarray(left_of.all(axis=1))


def true_map(
    scene: Scene, obstacles: list[Prism], floors: list[Prism], start: Array
) -> OccupancyGrid:
    """Return the map: a cell is occupied when a solid in it stands between the step and the robot's
    height above the floor there, free when the rest of it can be reached from `start` (2,).

    Raises InputError when the start is on an obstacle.
    """
    standing = [prism for prism in obstacles if not prism.is_sheet]
    grid = _empty_grid(scene, standing, start)
    blocked = np.zeros(grid.cells.shape, bool)
    for prism in standing:
        rows, columns, hit = _hit_cells(grid, scene, prism, floors)
        blocked[rows, columns] |= hit
    column, row = ((start - np.array(grid.origin_xy_m)) / grid.resolution_m).astype(int)
    if blocked[row, column]:
        raise InputError(f'the path starts on an obstacle, at x {start[0]:g}, y {start[1]:g} m')
    _, labels = cv2.connectedComponents((~blocked).astype(np.uint8), connectivity=4)
    reached = labels == labels[row, column]
    cells = np.full(blocked.shape, UNKNOWN, np.int8)
    cells[blocked], cells[reached] = OCCUPIED, FREE
    return OccupancyGrid(cells, grid.resolution_m, grid.origin_xy_m)


def _empty_grid(scene: Scene, obstacles: list[Prism], start: Array) -> OccupancyGrid:
    """Return a grid around everything, in phase with the outermost corner of the solids."""
    size = scene.resolution_m
    drive = np.vstack([start[None], np.array(scene.path.waypoints)])
    corners = np.vstack([p.footprint for p in obstacles]) if obstacles else drive
    anchor = corners.min(axis=0) - scene.raster_phase * size
    everything = np.vstack([corners, drive])
    low = anchor - np.ceil((anchor - everything.min(axis=0) + MARGIN_M) / size) * size
    columns, rows = np.ceil((everything.max(axis=0) + MARGIN_M - low) / size).astype(int)
    cells = np.full((rows, columns), UNKNOWN, np.int8)
    return OccupancyGrid(cells, size, (float(low[0]), float(low[1])))


def _hit_cells(
    grid: OccupancyGrid, scene: Scene, prism: Prism, floors: list[Prism]
) -> tuple[slice, slice, NDArray[np.bool_]]:
    """Return rows, columns, and in which of their cells a sample point lies in a prism at the
    robot's height.
    """
    origin, size = np.array(grid.origin_xy_m), grid.resolution_m
    first = np.floor((prism.footprint.min(axis=0) - origin) / size).astype(int)
    last = np.floor((prism.footprint.max(axis=0) - origin) / size).astype(int) + 1
    columns, rows = last - first
    steps = (np.arange(SAMPLES_PER_CELL) + 0.5) / SAMPLES_PER_CELL
    x = (first[0] + np.arange(columns)[:, None] + steps).ravel() * size + origin[0]
    y = (first[1] + np.arange(rows)[:, None] + steps).ravel() * size + origin[1]
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    hit = inside_footprint(prism, points)
    ground_m, top_m = floor_height_m(floors, points[hit]), _top_at(prism, points[hit])
    below = float(prism.bottom_m.min()) < ground_m + scene.robot_height_m
    hit[hit] = below & (top_m > ground_m + scene.step_height_m)
    shape = (rows, SAMPLES_PER_CELL, columns, SAMPLES_PER_CELL)
    cells = np.asarray(hit.reshape(shape).any(axis=(1, 3)))
    return slice(first[1], last[1]), slice(first[0], last[0]), cells


def _top_at(prism: Prism, points: Array) -> Array:
    """Return the height (N,) of a prism's top, a plane, at points (N, 2)."""
    design = np.column_stack([prism.footprint, np.ones(len(prism.footprint))])
    plane = np.linalg.lstsq(design, prism.top_m, rcond=None)[0]
    return points @ plane[:2] + plane[2]
