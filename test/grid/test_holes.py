"""What little is undecided in the middle of free cells."""

import numpy as np

from segfloor_ros.grid.map_file import FREE, OCCUPIED, UNKNOWN, OccupancyGridSettings
from segfloor_ros.grid.raster import FREE_FROM, OCCUPIED_FROM, ZERO, LogOddsRaster, render, steps

PATH = np.array([[0.05, 0.05]])


def drawn(cells: np.ndarray, resolution_m: float = 0.05) -> np.ndarray:
    """Return the map of steps of evidence (rows, columns), the path in its first free cell."""
    raster = LogOddsRaster()
    raster.patch((0, 0), cells.shape)[:] = (ZERO + cells).astype(np.uint8)
    settings = OccupancyGridSettings(resolution_m=resolution_m)
    grid = render(raster, PATH * resolution_m / 0.05, settings)
    return grid.cells[: cells.shape[0], : cells.shape[1]]


def free_room() -> np.ndarray:
    return np.full((24, 24), -steps(FREE_FROM))


def test_a_hole_that_nothing_stands_in_is_free():
    cells = free_room()
    cells[10, 10:13] = (0, steps(OCCUPIED_FROM) - 1, -1)
    assert (drawn(cells)[10, 10:13] == FREE).all()


def test_what_stands_there_stays_and_so_does_what_is_beside_it():
    cells = free_room()
    cells[10, 10:12] = (steps(OCCUPIED_FROM), 0)
    assert drawn(cells)[10, 10:12].tolist() == [OCCUPIED, UNKNOWN]


def test_a_larger_hole_stays_unknown_at_every_resolution():
    cells = free_room()
    cells[10:12, 10:13] = 0
    assert (drawn(cells)[10:12, 10:13] == UNKNOWN).all()
    assert (drawn(cells, 0.02)[10:12, 10:13] == FREE).all()


def test_what_lies_at_the_edge_of_the_map_is_no_hole():
    cells = free_room()
    cells[0, 10] = 0
    assert drawn(cells)[0, 10] == UNKNOWN
