"""Cells of evidence on an unbounded raster, of which the part that was touched is stored.

Evidence is kept in whole steps of `QUANTUM` log-odds, 128 steps above zero being 128 of uint8:
integers, so that the same observations give the same cells on every machine.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

QUANTUM = 0.05
HIT, FREE = 0.7, 0.4
"""Evidence of one keyframe that sees an obstacle, or floor, in a cell."""
OCCUPIED_FROM, FREE_FROM = 1.2, 0.4
"""Cells with more evidence than this are occupied, and rays end there; with so much for floor they
are free."""
SURE = OCCUPIED_FROM + HIT
"""Occupied cells with more evidence than this are not beside what is seen now, but in its way."""
MOST, LEAST = SURE + QUANTUM, -2.0
"""Limits of the evidence: how much it takes to clear what has left, and to mark what has come. Once
something is sure, one look at floor makes it doubtful: more would keep what people leave.
"""
ZERO = 128
CHUNK = 64
"""The stored part grows by whole blocks of this many cells."""


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
        return (
            self.first_cell[0] + self.cells.shape[0],
            self.first_cell[1] + self.cells.shape[1],
        )
