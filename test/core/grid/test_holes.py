"""Rays of free cells, and what little is undecided in the middle of them."""

import numpy as np
import pytest

from segfloor_ros.core.grid.mapper import draw_rays
from segfloor_ros.core.grid.occupancy import (
    FREE,
    FREE_FROM,
    OCCUPIED,
    OCCUPIED_FROM,
    UNKNOWN,
    ZERO,
    LogOddsRaster,
    OccupancyGridSettings,
    render,
    steps,
)

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


@pytest.mark.parametrize('short', [0.0, 0.5, 2.0])
def test_a_ray_ends_as_much_before_its_point_as_it_should(short) -> None:
    raster = np.zeros((20, 20), np.uint8)
    draw_rays(raster, np.array([2.5, 3.5]), np.array([[10.0, 0.0], [0.0, 12.0]]), short)
    expected = np.zeros_like(raster)
    # From the middle of column 2, row 3: to 12.5 along the row and to 15.5 along the column.
    expected[3, 2 : int(12.5 - short) + 1] = 1
    expected[3 : int(15.5 - short) + 1, 2] = 1
    np.testing.assert_array_equal(raster, expected)
