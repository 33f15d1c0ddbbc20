"""Scans of points placed by hand."""

import numpy as np
import pytest
from floor_scenes import CAMERA, MOUNT

from segfloor_ros.floor.scan import FloorScanner
from segfloor_ros.floor.settings import FloorSegmentationSettings

SETTINGS = FloorSegmentationSettings()


def fan(first_m, last_m, bearings_deg=(-10, 10), per_m=100):
    """Points every centimetre along bearings every quarter of a degree, (2, N)."""
    ranges = np.arange(first_m, last_m, 1 / per_m)
    bearings = np.radians(np.arange(*bearings_deg, 0.25))
    r, b = np.meshgrid(ranges, bearings)
    return np.stack([(r * np.cos(b)).ravel(), (r * np.sin(b)).ravel()]).astype(np.float32)


def scan(*stretches_m, upright=None, blind_from_deg=90.0):
    """The scan of floor in stretches of range within 10 degrees of straight ahead; to the left of
    blind_from_deg one camera alone sees it.
    """
    scanner = FloorScanner(CAMERA, MOUNT, SETTINGS)
    x, y = scanner.cells_xy
    ranges, bearings_deg = np.hypot(x, y), np.degrees(np.arctan2(y, x))
    floor = np.zeros(len(x), bool)
    for first_m, last_m in stretches_m:
        floor |= (ranges > first_m) & (ranges < last_m) & (np.abs(bearings_deg) < 10)
    points = np.zeros((2, 0), np.float32) if upright is None else upright
    return scanner.scan(floor, bearings_deg < blind_from_deg, points, 0.5)


def at(result, values, bearing_deg=0.0):
    return values[np.abs(result.bearings_rad - np.radians(bearing_deg)).argmin()]


def test_bearings_cover_the_field_of_view():
    # 90 degrees across; the lower corners, seen past the robot's flanks, reach a little farther.
    bearings = np.degrees(scan((0.6, 1.0)).bearings_rad)
    assert 43 < -bearings[0] < 60
    assert 43 < bearings[-1] < 60


def test_floor_ends_where_it_fades_out():
    result = scan((0.35, 3.0))
    assert 2.6 < at(result, result.ranges_m) <= 3.0
    assert np.isnan(at(result, result.obstacle_m))


def test_nothing_is_known_where_nothing_was_seen():
    result = scan((0.35, 3.0))
    assert np.isnan(at(result, result.ranges_m, 30.0))


def test_a_wall_ends_the_scan_where_it_stands():
    wall = np.repeat(fan(2.0, 2.005), 40, axis=1)
    result = scan((0.35, 1.95), (2.05, 4.0), upright=wall)
    assert at(result, result.ranges_m) == pytest.approx(2.0, abs=0.03)
    assert at(result, result.obstacle_m) == pytest.approx(2.0, abs=0.03)


def test_a_gap_ends_the_scan():
    result = scan((0.35, 1.5), (2.2, 4.0))
    assert 1.3 < at(result, result.ranges_m) <= 1.5


def test_a_lone_match_does_not_end_the_scan():
    lone = np.array([[1.0], [0.0]], np.float32)
    result = scan((0.35, 3.0), upright=lone)
    assert at(result, result.ranges_m) > 2.6


def test_right_in_front_is_zero():
    front = np.repeat(fan(0.45, 0.455), 60, axis=1)
    result = scan(upright=front)
    assert at(result, result.ranges_m) == 0.0
    assert at(result, result.obstacle_m) == pytest.approx(0.45, abs=0.03)


def test_floor_that_one_camera_sees_does_not_end_a_ray():
    result = scan((0.35, 3.0), blind_from_deg=4.0)
    assert at(result, result.ranges_m) > 2.6
    assert np.isnan(at(result, result.ranges_m, 7.0))
