"""A scene from a map_server floor plan: walls extruded from its occupied cells."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.errors import InputError, MapError
from segfloor_ros.grid.map_file import load_map
from segfloor_ros.grid.occupancy import FREE, OCCUPIED, OccupancyGrid
from segfloor_ros.simulation.tour import plan_tour

WALL_HEIGHT_M = 2.5
FURNITURE_HEIGHTS_M = (0.4, 0.8, 1.2, 1.8)
WALL_TEXTURES = ('rough_plaster', 'bricks', 'concrete', 'books', 'goods')
FURNITURE_TEXTURES = ('wood', 'granite', 'goods', 'metal')
TEXTURE_PATCH_M = 5.0
"""Long walls change their look about this often."""

WALL_EXTENT_M = 2.5
"""Connected obstacles at least this large are walls, up to the ceiling; smaller ones furniture."""

DEFAULT_SEED = 1


def is_map_file(values: dict[str, Any]) -> bool:
    """Return whether the values of a YAML file are those of a map_server map."""
    return 'image' in values and 'resolution' in values


def scene_of_map(file: Path, overrides: dict[str, Any]) -> dict[str, Any]:
    """Return a scene's values: boxes for the occupied cells and, unless `overrides` has waypoints,
    a tour through the free space. Raises InputError naming the file.
    """
    try:
        grid = load_map(file)
    except MapError as error:
        raise InputError(str(error)) from None
    occupied = grid.cells == OCCUPIED
    if not occupied.any():
        raise InputError(f'{file}: the map has no occupied cell to build walls from')
    seed = int(overrides.get('seed', DEFAULT_SEED))
    waypoints = overrides.get('path', {}).get('waypoints')
    if waypoints is None:
        waypoints = plan_tour(grid.cells == FREE, grid.resolution_m, grid.origin_xy_m).tolist()
    return {
        'description': f'Floor plan {file.name}, walls extruded, a tour through its free space.',
        'seed': seed,
        'floor': {'texture': 'tiles'},
        'boxes': _boxes(grid, occupied, seed),
        'resolution_m': grid.resolution_m,
        'raster_phase': 0.0,
        'path': {'waypoints': waypoints},
    }


def merged_rectangles(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return rectangles (N, 4) = first row, last row + 1, first column, last column + 1 that cover
    the mask without overlap: runs along the rows, equal runs of adjacent rows joined.
    """
    edges = np.diff(np.pad(mask, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    rows, starts = np.nonzero(edges == 1)
    _, ends = np.nonzero(edges == -1)
    order = np.lexsort((rows, ends, starts))
    rows, starts, ends = rows[order], starts[order], ends[order]
    continues = (np.diff(rows) == 1) & (np.diff(starts) == 0) & (np.diff(ends) == 0)
    first = np.concatenate([[0], np.nonzero(~continues)[0] + 1])
    last = np.concatenate([first[1:] - 1, [len(rows) - 1]])
    return np.stack([rows[first], rows[last] + 1, starts[first], ends[first]], axis=1)


def _boxes(grid: OccupancyGrid, occupied: NDArray[np.bool_], seed: int) -> list[dict[str, Any]]:
    """Return one box per merged rectangle; connected obstacles share their height."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(
        occupied.astype(np.uint8), connectivity=8
    )
    rng = np.random.default_rng([seed, 5])
    extent_m = stats[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1) * grid.resolution_m
    is_wall = extent_m >= WALL_EXTENT_M
    height_m = np.where(is_wall, WALL_HEIGHT_M, rng.choice(FURNITURE_HEIGHTS_M, count))
    return [
        _box(
            grid, rectangle, float(height_m[label]), _texture(grid, rectangle, label, is_wall, seed)
        )
        for rectangle in merged_rectangles(occupied)
        for label in [labels[rectangle[0], rectangle[2]]]
    ]


def _box(
    grid: OccupancyGrid, rectangle: NDArray[np.int64], height_m: float, texture: str
) -> dict[str, Any]:
    bottom, top, left, right = (float(value) * grid.resolution_m for value in rectangle)
    x, y = grid.origin_xy_m
    return {
        'at': [x + (left + right) / 2, y + (bottom + top) / 2],
        'size': [right - left, top - bottom, height_m],
        'texture': texture,
    }


def _texture(
    grid: OccupancyGrid,
    rectangle: NDArray[np.int64],
    label: int,
    is_wall: NDArray[np.bool_],
    seed: int,
) -> str:
    """Return the look: of furniture by the piece, of walls by the place."""
    if not is_wall[label]:
        return FURNITURE_TEXTURES[int(label) % len(FURNITURE_TEXTURES)]
    patch = (rectangle[[0, 2]] * grid.resolution_m // TEXTURE_PATCH_M).astype(np.int64)
    chosen = np.random.default_rng([seed, 6, *patch]).integers(len(WALL_TEXTURES))
    return WALL_TEXTURES[int(chosen)]
