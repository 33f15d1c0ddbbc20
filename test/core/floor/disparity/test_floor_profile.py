"""The spline, the line of a plane floor, and the fit through clutter."""

import numpy as np
import pytest
from floor_scenes import CAMERA

from segfloor_ros.core.contracts import Mount, VDisparity
from segfloor_ros.core.floor.disparity.profile import (
    BINS_PER_PX,
    SEGMENTS,
    FloorLine,
    fit_profile,
    spline_basis,
)
from segfloor_ros.core.floor.settings import FloorSegmentationSettings

SETTINGS = FloorSegmentationSettings()


@pytest.mark.parametrize('roll_deg', [0.0, 5.0, -5.0])
def test_points_of_the_floor_project_onto_the_line(roll_deg):
    mount = Mount(0.3, np.radians(7.0), np.radians(roll_deg), forward_m=0.2, yaw_rad=0.1)
    line = FloorLine.of(CAMERA, mount)
    on_floor = np.array([[1.0, 0.3, 0.0], [2.5, -0.8, 0.0], [6.0, 1.0, 0.0]])
    T = mount.T_base_left
    u, v, u_right = CAMERA.project((on_floor - T[:3, 3]) @ T[:3, :3]).T
    derolled = v + line.shear * (u - CAMERA.cx)
    assert np.allclose(line.slope * (derolled - line.horizon), u - u_right, atol=1e-9)


def test_rows_above_the_floor_are_metres_above_it():
    mount = Mount(0.3, np.radians(7.0), np.radians(4.0))
    line = FloorLine.of(CAMERA, mount)
    above = np.array([[2.0, 0.4, 0.10]])
    T = mount.T_base_left
    u, v, u_right = CAMERA.project((above - T[:3, 3]) @ T[:3, :3])[0]
    disparity = u - u_right
    row_of_floor = line.horizon + disparity / line.slope
    derolled = v + line.shear * (u - CAMERA.cx)
    assert line.metres_per_row / disparity * (row_of_floor - derolled) == pytest.approx(0.10)


def test_basis_sums_to_one_and_reproduces_lines():
    positions = np.linspace(0, SEGMENTS, 101)
    basis = spline_basis(positions)
    assert np.allclose(basis.sum(axis=1), 1.0)
    assert np.allclose(basis @ (np.arange(8) - 1.0), positions)


def counts_of(rows, disparity, shape, weight=40):
    counts = np.zeros(shape, int)
    np.add.at(counts, (rows, np.rint(disparity * BINS_PER_PX).astype(int)), weight)
    return counts


def test_fit_follows_the_floor_past_an_upright_surface():
    line = FloorLine.of(CAMERA, Mount(0.3, np.radians(7.0)))
    first = 200
    rows = np.arange(20, 280)
    floor = line.slope * (rows + first - line.horizon)
    counts = counts_of(rows, floor, (280, 260))
    wall_rows = np.arange(0, 160)
    counts += counts_of(wall_rows, np.full(160, 25.0), counts.shape, weight=60)
    profile = fit_profile(VDisparity(counts, first, BINS_PER_PX), line, CAMERA)
    assert np.abs(profile.at_rows(rows + first) - floor).max() < 0.3
    assert np.all(np.diff(profile.disparity_px) > 0)


def test_profile_is_inverted_and_unknown_above_the_horizon():
    line = FloorLine.of(CAMERA, Mount(0.3, np.radians(7.0)))
    counts = counts_of(np.arange(20, 280), np.zeros(260) + 1, (280, 260), weight=0)
    profile = fit_profile(VDisparity(counts, 200, BINS_PER_PX), line, CAMERA)
    rows = np.array([230.0, 300.5, 470.0, 500.0])
    assert np.allclose(profile.row_of_disparity(profile.at_rows(rows)), rows, atol=1e-3)
    assert np.isnan(profile.at_rows(np.array([line.horizon - 2]))).all()
    # Without data the profile is the plane that is known.
    assert np.allclose(profile.at_rows(rows), line.slope * (rows - line.horizon), atol=1e-2)
