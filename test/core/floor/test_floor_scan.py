"""Scans of points placed by hand."""

import dataclasses

import numpy as np
import pytest
from floor_scenes import CAMERA, MOUNT

from segfloor_ros.core.floor.scan import FloorScanner
from segfloor_ros.core.floor.settings import FloorSegmentationSettings

SETTINGS = FloorSegmentationSettings()


def fan(first_m, last_m, bearings_deg=(-10, 10), per_m=100):
    """Points every centimetre along bearings every quarter of a degree, (2, N)."""
    ranges = np.arange(first_m, last_m, 1 / per_m)
    bearings = np.radians(np.arange(*bearings_deg, 0.25))
    r, b = np.meshgrid(ranges, bearings)
    return np.stack([(r * np.cos(b)).ravel(), (r * np.sin(b)).ravel()]).astype(np.float32)


def scan(*stretches_m, upright=None, feet=None, blind_from_deg=90.0, movable=None):
    """The scan of floor in stretches of range within 10 degrees of straight ahead; to the left of
    blind_from_deg one camera alone sees it. upright, feet: (2, N), what stands, and where blank
    faces do; movable: what is of a class that moves.
    """
    scanner = FloorScanner(CAMERA, MOUNT, SETTINGS)
    x, y = scanner.cells_xy
    ranges, bearings_deg = np.hypot(x, y), np.degrees(np.arctan2(y, x))
    floor = np.zeros(len(x), bool)
    for first_m, last_m in stretches_m:
        floor |= (ranges > first_m) & (ranges < last_m) & (np.abs(bearings_deg) < 10)
    nothing = np.zeros((2, 0), np.float32)
    points, lines = (nothing if given is None else given for given in (upright, feet))
    return scanner.scan(floor, bearings_deg < blind_from_deg, points, lines, 0.5, movable)


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


@pytest.mark.parametrize('distance_m', [0.8, 1.5, 3.0])
def test_a_noisy_wall_is_placed_without_bias(distance_m):
    # Disparities with an error of half a pixel, as the matcher makes them.
    rng = np.random.default_rng(4)
    true = np.repeat(fan(distance_m, distance_m + 0.005), 60, axis=1)
    disparity_m = CAMERA.disparity_times_depth
    noise_px = rng.normal(0, 0.5, true.shape[1]).astype(np.float32)
    wall = true / (1 + noise_px * distance_m / disparity_m)
    result = scan((0.35, distance_m - 0.05), upright=wall)
    placed_m = result.obstacle_m[np.abs(result.bearings_rad) < np.radians(9)]
    assert np.median(placed_m) == pytest.approx(distance_m, rel=0.004)
    assert np.std(placed_m) < result.error_per_m * distance_m**2


@pytest.mark.parametrize(('focal', 'baseline', 'range_max_m'), [(1, 1, 1), (4, 1, 2), (2, 8, 4)])
def test_the_range_follows_the_camera(focal, baseline, range_max_m):
    # Errors of depth shrink with focal length times baseline; the range grows with its root.
    def made_by(camera):
        scanner = FloorScanner(camera, MOUNT, SETTINGS)
        nothing = np.zeros(scanner.cells_xy.shape[1], bool)
        none = np.zeros((2, 0), np.float32)
        made = scanner.scan(nothing, nothing, none, none, 0.5)
        return made, np.hypot(*scanner.cells_xy).max()

    other = dataclasses.replace(
        CAMERA, fx=focal * CAMERA.fx, baseline_m=baseline * CAMERA.baseline_m
    )
    (usual, usual_m), (changed, changed_m) = made_by(CAMERA), made_by(other)
    assert changed.range_max_m / usual.range_max_m == pytest.approx(range_max_m, rel=1e-5)
    assert changed_m / usual_m == pytest.approx(range_max_m, rel=0.02)
    assert changed.error_per_m == pytest.approx(usual.error_per_m / range_max_m**2, rel=1e-5)


def test_a_gap_ends_the_scan():
    result = scan((0.35, 1.5), (2.2, 4.0))
    assert 1.3 < at(result, result.ranges_m) <= 1.5


def test_a_lone_match_does_not_end_the_scan():
    lone = np.array([[1.0], [0.0]], np.float32)
    result = scan((0.35, 3.0), upright=lone)
    assert at(result, result.ranges_m) > 2.6


def test_what_is_of_a_class_that_moves_ends_the_floor_and_is_no_obstacle():
    result = scan((0.35, 3.0), movable=np.repeat(fan(2.0, 2.02, (-5, 5)), 60, axis=1))
    assert 1.8 < at(result, result.ranges_m) < 2.0
    assert np.isnan(at(result, result.obstacle_m))
    assert at(result, result.movable_m) == pytest.approx(2.01, abs=0.03)
    assert np.isnan(at(result, result.movable_m, 8.0))
    assert scan((0.35, 3.0)).movable_m is None


def test_right_in_front_is_zero():
    front = np.repeat(fan(0.45, 0.455), 60, axis=1)
    result = scan(upright=front)
    assert at(result, result.ranges_m) == 0.0
    assert at(result, result.obstacle_m) == pytest.approx(0.45, abs=0.03)


def test_floor_that_one_camera_sees_does_not_end_a_ray():
    result = scan((0.35, 3.0), blind_from_deg=4.0)
    assert at(result, result.ranges_m) > 2.6
    assert np.isnan(at(result, result.ranges_m, 7.0))


def test_the_floor_ends_at_the_foot_of_a_blank_face():
    result = scan((0.35, 2.05), feet=fan(2.0, 2.005))
    assert at(result, result.ranges_m) == pytest.approx(2.0, abs=0.03)
    assert at(result, result.obstacle_m) == pytest.approx(2.0, abs=0.03)


def test_what_stands_in_front_of_it_is_nearer():
    board = np.repeat(fan(1.5, 1.505), 40, axis=1)
    result = scan((0.35, 2.05), upright=board, feet=fan(2.0, 2.005))
    assert at(result, result.obstacle_m) == pytest.approx(1.5, abs=0.03)


@pytest.mark.parametrize(('gap_deg', 'reaches_m'), [(8, 1.0), (16, 3.0)])
def test_nothing_is_seen_through_a_gap_too_narrow_for_a_robot(gap_deg, reaches_m):
    half = gap_deg / 2
    sides = [fan(1.0, 1.005, bearings_deg=ends) for ends in ((-14, -half), (half, 14))]
    result = scan((0.35, 3.2), upright=np.repeat(np.hstack(sides), 60, axis=1))
    assert at(result, result.ranges_m) == pytest.approx(reaches_m, abs=0.25)
