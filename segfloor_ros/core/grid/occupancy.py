"""The occupancy grid: its settings, its data, and the evidence it is made of.

Cells of evidence lie on an unbounded raster; the grid that is published is rendered from them.

Evidence is kept in whole steps of `QUANTUM` log-odds, 128 steps above zero being 128 of uint8:
integers, so that the same observations give the same cells on every machine.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.geometry import Array
from segfloor_ros.core.settings import StageSettings, setting

OCCUPIED_THRESH, FREE_THRESH = 0.65, 0.196
FREE_PIXEL, OCCUPIED_PIXEL, UNKNOWN_PIXEL = 254, 0, 205

FREE, OCCUPIED, UNKNOWN = 0, 100, -1
"""Cells, as nav_msgs/OccupancyGrid has them."""

PICTURE_PX = 1000
"""Side of a picture of a map for people, about."""

Cells = NDArray[np.int64]
"""Rows and columns (..., 2)."""

FINE = 0.25
"""Share of a cell that its raster does not show: so far apart are samples of a ray, and keyframes
or maps that move by less are not followed."""

_NOTHING, _UNREACHED, _REACHED, _STANDING = range(4)
"""What a cell is while the map is drawn."""
_HOLE_M2 = 0.01
"""Table legs are smaller than this, what one can fail to see from all sides is not."""

QUANTUM = 0.05
HIT, MISS = 0.7, 0.4
"""Evidence of one keyframe that sees an obstacle, or floor, in a cell."""
OCCUPIED_FROM, FREE_FROM = 1.2, MISS
"""Cells with more evidence than this are occupied, and rays end there; one look at floor makes a
cell free."""
SURE = OCCUPIED_FROM + HIT
"""Occupied cells with more evidence than this are not beside what is seen now, but in its way."""
MOST, LEAST = SURE + QUANTUM, -2.0
"""Limits of the evidence: how much it takes to clear what has left, and to mark what has come. Once
something is sure, one look at floor makes it doubtful: more would keep what people leave.
"""
ZERO = 128
CHUNK = 64
"""The stored part grows by whole blocks of this many cells."""


def enlarged(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a picture (H, W, 3) of a map, a pixel a cell, with whole pixels as large as fit."""
    zoom = max(1, PICTURE_PX // max(picture.shape[:2]))
    return np.repeat(np.repeat(picture, zoom, axis=0), zoom, axis=1)


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

    def cells_of(self, points: Array) -> Cells:
        """Return rows and columns (..., 2) of points (..., 2) in `map`, on the grid or beyond."""
        xy = (np.asarray(points) - self.origin_xy_m) / self.resolution_m
        return np.floor(xy[..., ::-1]).astype(np.int64)

    def centres_of(self, cells: Cells) -> Array:
        """Return the middles (..., 2) in `map` of cells, rows and columns (..., 2)."""
        return np.array(self.origin_xy_m) + (cells[..., ::-1] + 0.5) * self.resolution_m

    def holds(self, cells: Cells) -> NDArray[np.bool_]:
        """Return which cells, rows and columns (..., 2), lie on the grid."""
        return np.asarray(((cells >= 0) & (cells < self.cells.shape)).all(axis=-1))

    @property
    def all_cells(self) -> Cells:
        """Rows and columns (rows * columns, 2) of all cells, row by row."""
        return np.indices(self.cells.shape).reshape(2, -1).T

    @property
    def states(self) -> NDArray[np.int8]:
        """The cells (rows, columns) as map files store them: `FREE`, `OCCUPIED` or `UNKNOWN`."""
        states = np.full(self.cells.shape, UNKNOWN, np.int8)
        states[(self.cells >= FREE) & (self.cells < 100 * FREE_THRESH)] = FREE
        states[self.cells > 100 * OCCUPIED_THRESH] = OCCUPIED
        return states

    @property
    def extent_m(self) -> tuple[float, float, float, float]:
        """Left, right, lower and upper border in `map`."""
        (rows, columns), (x, y) = self.cells.shape, self.origin_xy_m
        return (x, x + columns * self.resolution_m, y, y + rows * self.resolution_m)

    @property
    def picture(self) -> NDArray[np.uint8]:
        """The cells as a picture (rows, columns) in the grey levels of map_server: its first row is
        their last.
        """
        pixels = np.full(self.cells.shape, UNKNOWN_PIXEL, np.uint8)
        pixels[self.states == FREE], pixels[self.states == OCCUPIED] = FREE_PIXEL, OCCUPIED_PIXEL
        return pixels[::-1]

    def away_m(self, where: NDArray[np.bool_]) -> Array:
        """Return how far each cell (rows, columns) is from the nearest of some cells, infinite
        where there are none; nothing is beyond the border.
        """
        others = (~where).astype(np.uint8)
        if others.all():
            return np.full(where.shape, np.inf)
        away = cv2.distanceTransform(others, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        return np.asarray(away * self.resolution_m)

    def area_m2(self, where: NDArray[np.bool_]) -> float:
        """Return the area of some cells (rows, columns)."""
        return float(where.sum() * self.resolution_m**2)


@dataclass(frozen=True)
class OccupancyGridSettings(StageSettings):
    """Cells, ranges and evidence of the map."""

    resolution_m: float = setting(0.05, 'Side of a cell.', within=(0.01, 0.2))
    max_range_m: float = setting(
        0.0,
        'Longest ray that marks free cells; 0 is as far as the camera can tell where floor ends.',
        within=(0.0, 50.0),
        live=True,
    )
    occupied_share: float = setting(
        0.2,
        'A cell into which an obstacle reaches by more than this share of its side is occupied.',
        within=(0.0, 0.5),
    )
    use_points: bool = setting(
        True, 'Obstacle points mark cells, and rays to floor points mark free cells.'
    )
    use_scan: bool = setting(True, 'The floor scan marks free cells and what it ended at.')
    as_published: bool = setting(False, 'Map points alone, in two binary layers, as published.')
    footprint_radius_m: float = setting(
        0.15,
        'The base has driven over the floor this far around it; 0 leaves it to what was seen.',
        within=(0.0, 2.0),
    )
    opening_cells: int = setting(
        0,
        'Post-process: free areas narrower than this become unknown (opening); 0 is off.',
        within=(0, 21),
        live=True,
    )
    probabilistic: bool = setting(
        False, 'Publish 0 to 100 by probability in place of free, occupied and unknown.', live=True
    )


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


def steps(log_odds: float) -> int:
    """Return the number of steps (at least one) of a positive amount of log-odds."""
    return max(1, round(log_odds / QUANTUM))


class LogOddsRaster:
    """uint8 cells around the origin of `map`: cell (i, j) covers x from j * resolution and y from
    i * resolution, for any integers i, j.
    """

    def __init__(self) -> None:
        self.first_cell = (0, 0)
        self.cells = np.zeros((0, 0), np.uint8)

    def patch(self, low: tuple[int, int], high: tuple[int, int]) -> NDArray[np.uint8]:
        """Return the cells from `low` (row, column) up to, not including, `high`, to be written
        to; the raster grows as needed.
        """
        self._include(low, high)
        row, column = low[0] - self.first_cell[0], low[1] - self.first_cell[1]
        return self.cells[row : row + high[0] - low[0], column : column + high[1] - low[1]]

    def _include(self, low: tuple[int, int], high: tuple[int, int]) -> None:
        first, last = self.first_cell, self._end()
        if first[0] <= low[0] and first[1] <= low[1] and high[0] <= last[0] and high[1] <= last[1]:
            return
        if self.cells.size == 0:
            first, last = low, high
        new_first = tuple(CHUNK * (min(a, b) // CHUNK) for a, b in zip(first, low, strict=True))
        new_last = tuple(-CHUNK * (-max(a, b) // CHUNK) for a, b in zip(last, high, strict=True))
        shape = (new_last[0] - new_first[0], new_last[1] - new_first[1])
        cells = np.full(shape, ZERO, np.uint8)
        if self.cells.size:
            row, column = self.first_cell[0] - new_first[0], self.first_cell[1] - new_first[1]
            rows, columns = self.cells.shape
            cells[row : row + rows, column : column + columns] = self.cells
        self.first_cell, self.cells = (new_first[0], new_first[1]), cells

    def _end(self) -> tuple[int, int]:
        return (self.first_cell[0] + self.cells.shape[0], self.first_cell[1] + self.cells.shape[1])
