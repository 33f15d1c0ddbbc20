"""From evidence to the published grid."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.grid.log_odds import (
    CHUNK,
    FREE_FROM,
    OCCUPIED_FROM,
    QUANTUM,
    ZERO,
    LogOddsRaster,
    steps,
)
from segfloor_ros.grid.map_file import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from segfloor_ros.grid.settings import OccupancyGridSettings

_NOTHING, _UNREACHED, _REACHED, _STANDING = range(4)
"""What a cell is while the map is drawn."""
_HOLE_M2 = 0.01
"""Table legs are smaller than this, what one can fail to see from all sides is not."""


def render(
    raster: LogOddsRaster, path_xy_m: NDArray[np.float64], settings: OccupancyGridSettings
) -> OccupancyGrid:
    """Return the grid of a raster; path_xy_m: (K, 2), where the base has been."""
    first, cells = _touched(raster)
    kinds = cv2.LUT(cells, _kinds())
    at = np.floor(path_xy_m / settings.resolution_m).astype(np.intp)
    _reach(kinds, at[:, 1] - first[0], at[:, 0] - first[1])
    _fill_holes(kinds, settings.resolution_m)
    if settings.opening_cells > 1:
        kinds[_narrow(kinds, settings.opening_cells)] = _NOTHING
    values = np.full(256, UNKNOWN, np.int8)
    values[_REACHED], values[_STANDING] = FREE, OCCUPIED
    state = cv2.LUT(kinds, values.view(np.uint8)).view(np.int8)
    if settings.probabilistic:
        state = np.where(state == UNKNOWN, UNKNOWN, _percent(cells)).astype(np.int8)
    origin = (first[1] * settings.resolution_m, first[0] * settings.resolution_m)
    return OccupancyGrid(state, settings.resolution_m, origin)


def _touched(raster: LogOddsRaster) -> tuple[tuple[int, int], NDArray[np.uint8]]:
    """Return the first cell and the cells of the blocks that hold any evidence, or of one."""
    cells = raster.cells
    if cells.size == 0:
        return raster.first_cell, np.full((1, 1), ZERO, np.uint8)
    row, column = raster.first_cell
    rows, columns = (_empty_blocks(part) for part in (cells, cells.T))
    if rows == (cells.shape[0], 0):
        return raster.first_cell, cells[:1, :1]
    held = cells[rows[0] : cells.shape[0] - rows[1], columns[0] : cells.shape[1] - columns[1]]
    return (row + rows[0], column + columns[0]), held


def _empty_blocks(cells: NDArray[np.uint8]) -> tuple[int, int]:
    """Return how many rows of blocks without any evidence there are before the others and after
    them, in cells; all of them and none where there is no evidence at all.
    """
    height = cells.shape[0]

    def holds(start: int) -> bool:
        return bool((cells[start : start + CHUNK] != ZERO).any())

    starts = range(0, height, CHUNK)
    before = next(filter(holds, starts), height)
    last = next(filter(holds, reversed(starts)), height - CHUNK)
    return before, height - CHUNK - last


def _kinds() -> NDArray[np.uint8]:
    """Return what each of the 256 values of evidence makes of a cell."""
    kinds = np.full(256, _NOTHING, np.uint8)
    kinds[: ZERO - steps(FREE_FROM) + 1] = _UNREACHED
    kinds[ZERO + steps(OCCUPIED_FROM) :] = _STANDING
    return kinds


def _percent(cells: NDArray[np.uint8]) -> NDArray[np.int8]:
    log_odds = (np.arange(256) - ZERO) * QUANTUM
    percent = np.rint(100 / (1 + np.exp(-log_odds))).astype(np.int8)
    return cv2.LUT(cells, percent.view(np.uint8)).view(np.int8)


def _reach(kinds: NDArray[np.uint8], rows: NDArray[np.intp], columns: NDArray[np.intp]) -> None:
    """Mark the free cells that are joined to the path, given as rows and columns (K,).

    Floor is seen from the path along lines of floor, so an area without a link to it was seen
    through something, e.g. a wall.
    """
    inside = (rows >= 0) & (rows < kinds.shape[0]) & (columns >= 0) & (columns < kinds.shape[1])
    rows, columns = rows[inside], columns[inside]
    # As many rounds as there are separate areas that the path touches.
    while True:
        waiting = np.flatnonzero(kinds[rows, columns] == _UNREACHED)
        if len(waiting) == 0:
            return
        seed = (int(columns[waiting[0]]), int(rows[waiting[0]]))
        cv2.floodFill(kinds, None, seed, _REACHED, flags=4)


def _fill_holes(kinds: NDArray[np.uint8], resolution_m: float) -> None:
    """Free what little is undecided in the middle of free cells. What stands there would be
    occupied: looks from all sides agree on it.
    """
    blocked = (kinds != _REACHED).astype(np.uint8)
    _, label, stats, _ = cv2.connectedComponentsWithStats(blocked, connectivity=8)
    first, size = stats[:, :2], stats[:, 2:4]
    inside = (first > 0).all(axis=1) & (first + size < blocked.shape[::-1]).all(axis=1)
    small = stats[:, cv2.CC_STAT_AREA] <= max(1, round(_HOLE_M2 / resolution_m**2))
    for hole in np.flatnonzero(inside & small):
        column, row, width, height = stats[hole, :4]
        part = np.s_[row : row + height, column : column + width]
        there, cells = label[part] == hole, kinds[part]
        if not (cells[there] == _STANDING).any():
            cells[there] = _REACHED


def _narrow(kinds: NDArray[np.uint8], size: int) -> NDArray[np.bool_]:
    """Return the free cells that a morphological opening of this size (cells) removes."""
    free = (kinds == _REACHED).astype(np.uint8)
    opened = cv2.morphologyEx(free, cv2.MORPH_OPEN, np.ones((size, size), np.uint8))
    return (free > 0) & (opened == 0)
