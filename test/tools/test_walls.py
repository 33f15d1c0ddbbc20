"""`tools.walls`: how deep free cells lie behind a wall."""

import numpy as np
import pytest

from segfloor_ros.apps.evaluation.maps import MapTruth
from segfloor_ros.core.grid.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from tools.walls import FINE_M, depth_m


def test_the_depth_is_that_of_cells_centres_behind_the_face() -> None:
    # Floor up to x = 1 m in the world; the map's frame begins at x = 0.4, y = 0.3.
    true = np.full((100, 150), OCCUPIED, np.int8)
    true[:, :100] = FREE
    truth = MapTruth(OccupancyGrid(true, FINE_M, (0.0, 0.0)), (0.4, 0.3, 0.0))
    cells = np.full((4, 20), UNKNOWN, np.int8)
    cells[1, :14] = FREE
    depth = depth_m(OccupancyGrid(cells, 0.05, (0.0, 0.0)), truth)
    assert len(depth) == 14
    assert depth[:12].max() == 0
    assert depth[12:].tolist() == pytest.approx([0.025, 0.075], abs=FINE_M)
