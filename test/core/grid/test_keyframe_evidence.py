"""What one keyframe says, worked out by hand."""

import numpy as np
import pytest

from segfloor_ros.core.contracts import (
    POINT_FLOOR,
    RANGE_MAX_ERROR_M,
    FloorScan,
    KeyframeFeatures,
    LabelledPoints,
)
from segfloor_ros.core.grid.keyframe_evidence import (
    Fan,
    find_jumps,
    gather_evidence,
    slant,
    unit_vectors,
)
from segfloor_ros.core.grid.occupancy import OccupancyGridSettings

ERROR_PER_M = 0.01
BLIND = FloorScan(
    0.0, 0.01, np.zeros(0, np.float32), None, (RANGE_MAX_ERROR_M / ERROR_PER_M) ** 0.5
)


def rays_to(points_m: np.ndarray) -> np.ndarray:
    """Return the lengths of the rays to floor points (N, 2) that a keyframe at the origin sees."""
    ids = np.arange(len(points_m), dtype=np.int32)
    xyz = np.column_stack([points_m, np.zeros(len(points_m))]).astype(np.float32)
    labels = np.full(len(ids), POINT_FLOOR, np.uint8)
    points = LabelledPoints(ids, xyz, labels, np.ones(len(ids), np.float32))
    features = KeyframeFeatures(np.zeros((len(ids), 2), np.float32), ids, xyz)
    settings = OccupancyGridSettings(max_range_m=50.0)
    found = gather_evidence(points, features, np.eye(4), BLIND, settings)
    return np.hypot(*found.positions_m[:, : found.num_rays].astype(np.float64))


def test_rays_much_longer_than_the_others_of_the_keyframe_are_dropped() -> None:
    # Mean 2.2 m, deviation 0.98 m: Q3 + 1.5 IQR is 2.2 + 4 * 0.675 * 0.98 = 4.85 m.
    bearing = np.linspace(-0.5, 0.5, 25)
    near = 2.0 * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
    assert len(rays_to(np.concatenate([near, [[7.0, 0.0]]]))) == 25
    # Among its like the same one is kept.
    assert len(rays_to(np.concatenate([near, 3.5 * near]))) == 50


@pytest.mark.parametrize('length_m', [1.0, 3.0])
def test_rays_end_one_sigma_short_of_their_point(length_m: float) -> None:
    (ray_m,) = rays_to(np.array([[0.0, length_m]]))
    assert ray_m == pytest.approx(length_m - ERROR_PER_M * length_m**2, rel=1e-3)


NO_POINTS = LabelledPoints(
    np.zeros(0, np.int32), np.zeros((0, 3), np.float32), np.zeros(0, np.uint8), np.zeros(0)
)
NO_FEATURES = KeyframeFeatures(
    np.zeros((0, 2), np.float32), np.zeros(0, np.int32), np.zeros((0, 3), np.float32)
)


def test_rays_through_what_the_scan_saw_standing_on_their_bearing_are_dropped() -> None:
    """The scan's bearings do not begin ahead: to the left of its middle something stands."""
    step = float(np.radians(1.0))
    ranges = np.where(np.arange(90) < 30, 0.5, 2.0).astype(np.float32)
    standing = np.where(np.arange(90) < 30, np.nan, 2.0).astype(np.float32)
    scan = FloorScan(float(np.radians(-20.0)), step, ranges, standing, BLIND.range_max_m)
    bearing = np.radians([0.0, 30.0])
    xyz = 3 * np.stack([np.cos(bearing), np.sin(bearing), [0, 0]], axis=1).astype(np.float32)
    ids = np.arange(2, dtype=np.int32)
    points = LabelledPoints(ids, xyz, np.full(2, POINT_FLOOR, np.uint8), np.ones(2, np.float32))
    features = KeyframeFeatures(np.zeros((2, 2), np.float32), ids, xyz)
    settings = OccupancyGridSettings(max_range_m=50.0)
    found = gather_evidence(points, features, np.eye(4), scan, settings)
    assert found.num_rays == 1
    x, y = found.positions_m[:, 0].astype(np.float64)
    assert x > 2.5 and y == pytest.approx(0.0, abs=1e-3)


def test_faces_with_bearings_between_them_that_saw_none_are_not_joined() -> None:
    step = float(np.radians(1.0))
    range_m = np.array([2, 2, np.nan, np.nan, np.nan, 2, 2], np.float32)
    scan = FloorScan(0.0, step, np.full(7, 2, np.float32), range_m, 10.0)
    found = gather_evidence(NO_POINTS, NO_FEATURES, np.eye(4), scan, OccupancyGridSettings())
    assert (found.num_rays, found.num_contacts) == (0, 4)
    ends, starts = (part.astype(np.float64) for part in np.split(found.positions_m, [4], axis=1))
    lengths_m = np.hypot(*(ends - starts[:, :4]))
    np.testing.assert_allclose(lengths_m, [2 * step, 0, 2 * step, 0], atol=0.005)


def test_a_lone_longer_bearing_is_no_edge_of_the_fan() -> None:
    """The ends are, and on either side of a gap the bearing that sees past what is nearer."""
    lengths = np.array([2.0, 2, 5, 2, 2, 6, 6, 3])
    directions = unit_vectors(0.1 * np.arange(8))
    fan = Fan(np.zeros(2), 0.0, 0.1, directions, lengths, find_jumps(lengths))
    assert fan.edges().tolist() == [True, False, False, False, False, True, True, True]


def wall_askew(bearing_rad: np.ndarray) -> np.ndarray:
    """Return the ranges of a wall along x at y = 1 m."""
    return 1.0 / np.sin(bearing_rad)


def test_the_way_through_a_face_askew_is_longer_than_across_it() -> None:
    bearing = np.radians(np.arange(25.0, 120.0, 0.5))
    expected = 1 / np.sin(bearing)
    np.testing.assert_allclose(slant(wall_askew(bearing), np.radians(0.5)), expected, rtol=0.06)


def test_faces_are_moved_by_the_same_distance_across_them() -> None:
    # A share of 0.2 of a cell of 5 cm: 1.5 cm nearer than the middle.
    bearing = np.radians(np.arange(30.0, 100.0, 0.5))
    range_m = wall_askew(bearing).astype(np.float32)
    scan = FloorScan(float(bearing[0]), float(np.radians(0.5)), range_m, range_m, 10.0)
    settings = OccupancyGridSettings(occupied_share=0.2)
    evidence = gather_evidence(NO_POINTS, NO_FEATURES, np.eye(4), scan, settings)
    starts = evidence.positions_m[:, evidence.num_rays + evidence.num_contacts :]
    np.testing.assert_allclose(starts[1].astype(np.float64), 1.0 - 0.015, atol=0.003)
