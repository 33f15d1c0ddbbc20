"""Where the evidence of one keyframe lies in the cells, from a pose that is not the origin."""

import math

import numpy as np
import pytest

from segfloor_ros.core.grid.keyframe_evidence import KeyframeEvidence
from segfloor_ros.core.grid.mapper import EvidenceFolder
from segfloor_ros.core.grid.occupancy import ZERO, OccupancyGridSettings

POSE = (2.025, -1.025, math.pi / 2)
"""In the middle of a cell, turned to the left: what is ahead lies along y, the left along -x."""


def changed_cells(evidence: KeyframeEvidence) -> set[tuple[int, int]]:
    """Return (column, row) of the cells, of 5 cm, that are freer than before, from that of the
    base.
    """
    folder = EvidenceFolder(OccupancyGridSettings(resolution_m=0.05, footprint_radius_m=0.0))
    placed = folder.place(evidence, POSE, None)
    size = np.subtract(placed.high, placed.low)
    cells = np.full(tuple(size), ZERO, np.uint8)
    folder.fold(cells, placed)
    rows, columns = np.nonzero(cells < ZERO)
    base = (math.floor(POSE[0] / 0.05), math.floor(POSE[1] / 0.05))
    return {
        (int(column) + placed.low[1] - base[0], int(row) + placed.low[0] - base[1])
        for row, column in zip(rows, columns, strict=True)
    }


@pytest.mark.parametrize(('length_m', 'last'), [(0.3125, 6), (0.34375, 6), (0.375, 7)])
def test_a_ray_to_a_floor_point_ends_half_a_cell_before_it(length_m: float, last: int) -> None:
    """Of 6.25, 6.875 and 7.5 cells from the middle of one, half a cell is taken off."""
    evidence = KeyframeEvidence(
        first_rad=0.0,
        step_rad=0.01,
        fan_m=np.zeros(2, np.float16),
        positions_m=np.array([[length_m], [0.0]], np.float16),
        num_rays=1,
        num_contacts=0,
        thickness_m=np.zeros(0, np.float16),
        sure_range_m=5.0,
        movable_m=np.zeros((2, 0), np.float16),
    )
    assert changed_cells(evidence) == {(0, row) for row in range(last + 1)}
