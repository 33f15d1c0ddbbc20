"""From evidence to the published grid."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.grid.log_odds import CHUNK, QUANTUM, ZERO, LogOddsRaster, steps
from segfloor_ros.grid.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from segfloor_ros.grid.settings import OccupancyGridSettings

_UNREACHED, _REACHED = 1, 2


def render(
    raster: LogOddsRaster, path_xy_m: NDArray[np.float64], settings: OccupancyGridSettings
) -> OccupancyGrid:
    """Return the grid of a raster; path_xy_m: (K, 2), where the base has been."""
    first, cells = _touched(raster)
    state = _trinary(cells, settings)
    if settings.connected_only:
        at = np.floor(path_xy_m / settings.resolution_m).astype(np.intp)
        state[_unreached(state, at[:, 1] - first[0], at[:, 0] - first[1])] = UNKNOWN
    if settings.opening_cells > 1:
        state[_narrow(state, settings.opening_cells)] = UNKNOWN
    if settings.probabilistic:
        state = np.where(state == UNKNOWN, UNKNOWN, _percent(cells)).astype(np.int8)
    origin = (first[1] * settings.resolution_m, first[0] * settings.resolution_m)
    return OccupancyGrid(state, settings.resolution_m, origin)


def _touched(raster: LogOddsRaster) -> tuple[tuple[int, int], NDArray[np.uint8]]:
    """Return the first cell and the cells of the blocks that hold any evidence."""
    touched = raster.cells != ZERO
    rows, columns = np.flatnonzero(touched.any(axis=1)), np.flatnonzero(touched.any(axis=0))
    if len(rows) == 0:
        return raster.first_cell, np.full((1, 1), ZERO, np.uint8)
    low = (rows[0] // CHUNK * CHUNK, columns[0] // CHUNK * CHUNK)
    high = (-(-(rows[-1] + 1) // CHUNK) * CHUNK, -(-(columns[-1] + 1) // CHUNK) * CHUNK)
    first = (raster.first_cell[0] + int(low[0]), raster.first_cell[1] + int(low[1]))
    return first, raster.cells[low[0] : high[0], low[1] : high[1]]


def _trinary(cells: NDArray[np.uint8], settings: OccupancyGridSettings) -> NDArray[np.int8]:
    values = np.full(256, UNKNOWN, np.int8)
    values[: ZERO - steps(settings.free_log_odds_needed) + 1] = FREE
    values[ZERO + steps(settings.occupied_log_odds) :] = OCCUPIED
    return cv2.LUT(cells, values.view(np.uint8)).view(np.int8)


def _percent(cells: NDArray[np.uint8]) -> NDArray[np.int8]:
    log_odds = (np.arange(256) - ZERO) * QUANTUM
    percent = np.rint(100 / (1 + np.exp(-log_odds))).astype(np.int8)
    return cv2.LUT(cells, percent.view(np.uint8)).view(np.int8)


def _unreached(
    state: NDArray[np.int8], rows: NDArray[np.intp], columns: NDArray[np.intp]
) -> NDArray[np.bool_]:
    """Return the free cells that are not joined to the path, given as rows and columns (K,).

    Floor is seen from the path along lines of floor, so an area without a link to it was seen
    through something, e.g. a wall.
    """
    part = (state == FREE).astype(np.uint8)
    inside = (rows >= 0) & (rows < state.shape[0]) & (columns >= 0) & (columns < state.shape[1])
    rows, columns = rows[inside], columns[inside]
    # One byte a cell, and as many rounds as there are separate areas that the path touches.
    while True:
        waiting = np.flatnonzero(part[rows, columns] == _UNREACHED)
        if len(waiting) == 0:
            return part == _UNREACHED
        seed = (int(columns[waiting[0]]), int(rows[waiting[0]]))
        cv2.floodFill(part, None, seed, _REACHED, flags=4)


def _narrow(state: NDArray[np.int8], size: int) -> NDArray[np.bool_]:
    """Return the free cells that a morphological opening of this size (cells) removes."""
    free = (state == FREE).astype(np.uint8)
    opened = cv2.morphologyEx(free, cv2.MORPH_OPEN, np.ones((size, size), np.uint8))
    return (free > 0) & (opened == 0)
