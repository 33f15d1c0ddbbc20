"""u- and v-disparity counted by hand."""

import numpy as np
import pytest
from floor_scenes import CAMERA, MOUNT

from segfloor_ros.core.floor.disparity.profile import (
    FloorView,
    filtered_v_disparity,
    histogram,
    obstacle_rows,
    rising,
)


def test_u_disparity_counts_per_column():
    bins = np.array([[0, 2, 3], [1, 2, 3], [1, 2, 0], [1, 0, 1]])
    counts = histogram(bins, np.arange(3), (4, 3))
    assert counts.tolist() == [[1, 1, 1], [3, 0, 1], [0, 3, 0], [0, 0, 2]]


def test_v_disparity_counts_per_row():
    counts = histogram(np.array([0, 0, 2, 2, 2]), np.array([1, 1, 3, 0, 3]), (3, 4))
    assert counts.tolist() == [[0, 2, 0, 0], [0, 0, 0, 0], [1, 0, 0, 2]]


def test_an_obstacle_must_cover_the_rows_its_height_covers():
    # 0.2 m at 6 px, fx = fy, baseline 0.12 m: depth is 0.12 f / 6, so it covers
    # 0.2 f / (0.02 f) = 10 rows. The floor puts 2 rows in a bin: below 2 * 2 + 2 nothing counts.
    rows = obstacle_rows(np.array([1.0, 6.0, 12.0]), 0.2, 1 / 0.12, 2.0)
    assert np.allclose(rows, [6.0, 10.0, 20.0])


def test_only_what_rises_as_a_floor_does_is_kept():
    slope = 0.25  # px per row: compared over 4 rows
    rows = np.arange(40, dtype=np.float32)[:, None]
    floor = np.tile(5 + slope * rows, (1, 3))
    upright = np.full_like(floor, 9.0)
    steps = np.floor(floor / 4) * 4  # as the matcher draws floor without texture
    assert rising(floor, slope)[2:-2].all()
    assert rising(floor / 2, slope)[2:-2].all()  # the lower end of a ramp
    assert not rising(upright, slope).any()
    assert rising(steps, slope)[2:-2].mean() < 0.3


@pytest.mark.parametrize(('period', 'share'), [(12, 0.0), (60, 0.93)])
def test_what_covers_as_many_rows_as_an_obstacle_is_not_counted(period, share):
    # Steps one above the other, each rising as the floor does: a disparity covers 20 or 4 times the
    # 2.5 rows of the floor, and a thing of 20 cm 33 to 41 rows at 20 to 25 px.
    view = FloorView.of(CAMERA, MOUNT, 240)
    rows = np.arange(240)[:, None] % period
    disparity = np.broadcast_to(20 + view.line.slope * rows, view.derolled.shape)
    textured = np.ones(disparity.shape, bool)
    seen = filtered_v_disparity(view, disparity.astype(np.float32), textured, 128)
    assert seen.counts.sum() / disparity.size / view.step == pytest.approx(share, abs=0.1)
