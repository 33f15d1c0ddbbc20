"""What one keyframe says, worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from segfloor_ros.cloud.labelled_cloud import FLOOR, LabelledPoints
from segfloor_ros.floor.observation import RANGE_MAX_ERROR_M, FloorScan
from segfloor_ros.grid.keyframe_evidence import KeyframeEvidence, gather_evidence, slant
from segfloor_ros.grid.map_file import OccupancyGridSettings
from segfloor_ros.slam.results import KeyframeFeatures

ERROR_PER_M = 0.01
BLIND = FloorScan(
    0.0, 0.01, np.zeros(0, np.float32), None, (RANGE_MAX_ERROR_M / ERROR_PER_M) ** 0.5
)


def rays_to(points_m: np.ndarray) -> np.ndarray:
    """Return the lengths of the rays to floor points (N, 2) that a keyframe at the origin sees."""
    ids = np.arange(len(points_m), dtype=np.int32)
    xyz = np.column_stack([points_m, np.zeros(len(points_m))]).astype(np.float32)
    labels = np.full(len(ids), FLOOR, np.uint8)
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
    points = LabelledPoints(
        np.zeros(0, np.int32), np.zeros((0, 3), np.float32), np.zeros(0, np.uint8), np.zeros(0)
    )
    features = KeyframeFeatures(
        np.zeros((0, 2), np.float32), np.zeros(0, np.int32), np.zeros((0, 3), np.float32)
    )
    settings = OccupancyGridSettings(occupied_share=0.2)
    evidence: KeyframeEvidence = gather_evidence(points, features, np.eye(4), scan, settings)
    starts = evidence.positions_m[:, evidence.num_rays + evidence.num_contacts :]
    np.testing.assert_allclose(starts[1].astype(np.float64), 1.0 - 0.015, atol=0.003)
