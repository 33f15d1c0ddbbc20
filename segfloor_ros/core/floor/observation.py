"""The settings of floor segmentation, and what it hands to the next stages about one keyframe."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.settings import RobotSettings, setting

FLOOR, NO_EVIDENCE, MOVING, NOT_FLOOR = 255, 127, 64, 0
"""Pixels of a mask. What moves is in what a network says alone: neither floor nor in the way."""

RANGE_MAX_ERROR_M = 0.3
SAME_SURFACE_SHARE = 0.06
"""Ranges, or disparities, that differ by more than this share are those of two surfaces."""

CELL_M = 0.05
"""Side of a usual cell of a map. A ray ends so far before what stands up, so that it does not clear
the cell of that.
"""


@dataclass(frozen=True)
class FloorScan:
    """How far the floor was seen without interruption, per bearing, from the base's origin in
    the base's x-y plane. Bearing i is angle_min_rad + i * angle_increment_rad, counter-
    clockwise from x forward. ranges_m: (N,) float32 in metres; 0 where something stands right
    in front, NaN where the image shows nothing about that bearing. obstacle_m: (N,) float32,
    distance at which the nearest upright thing was measured on that bearing, NaN where none
    was; None from a source that does not tell. range_max_m: the range whose error, one sigma, is
    `RANGE_MAX_ERROR_M`; errors grow with the square of the range. movable_m: (N,) float32, as
    obstacle_m, of what a network says to be of a class that moves: it does not end the floor. None
    without a network.
    """

    angle_min_rad: float
    angle_increment_rad: float
    ranges_m: NDArray[np.float32]
    obstacle_m: NDArray[np.float32] | None = None
    range_max_m: float = math.inf
    movable_m: NDArray[np.float32] | None = None

    @property
    def bearings_rad(self) -> NDArray[np.float64]:
        """Bearings (N,) in radians."""
        steps = np.arange(len(self.ranges_m), dtype=np.float64)
        return self.angle_min_rad + self.angle_increment_rad * steps

    def ends(self) -> NDArray[np.float64]:
        """Return where the finite ranges end, (M, 3) in the base's x-y plane."""
        known = np.isfinite(self.ranges_m)
        bearings, ranges = self.bearings_rad[known], self.ranges_m[known]
        x, y = ranges * np.cos(bearings), ranges * np.sin(bearings)
        return np.stack([x, y, np.zeros_like(x)], axis=1)

    @property
    def error_per_m(self) -> float:
        """The error of a range, one sigma, is this times the square of the range."""
        return RANGE_MAX_ERROR_M / self.range_max_m**2


@dataclass(frozen=True)
class VDisparity:
    """How often each disparity occurs per row, without what is upright or blank: counts (R, B),
    row i being the de-rolled image row first_row + i, bin j the disparity j / bins_per_px.
    """

    counts: NDArray[np.integer]
    first_row: int
    bins_per_px: int


@dataclass(frozen=True)
class FloorObservation:
    """The floor seen in one rectified stereo pair.
    disparity_px: (H, W) float32, 0 where there is no match, and where something moves, unless a
    network knows it. mask: (H, W) uint8 of `FLOOR`,
    `NO_EVIDENCE` and `NOT_FLOOR`. profile_px: (H,) float64, the floor's disparity at each image row
    in the de-rolled image (NaN above the horizon). scan: the compact free-space scan.
    v_disparity: what the profile was fitted to.
    """

    disparity_px: NDArray[np.float32]
    mask: NDArray[np.uint8]
    profile_px: NDArray[np.float64]
    scan: FloorScan
    max_disparity_px: float
    v_disparity: VDisparity


def free_ranges(scan: FloorScan) -> NDArray[np.float32]:
    """Return how far the floor is surely free per bearing, (N,) in metres, as REP-117 has it: inf
    where it is free as far as the camera can tell, -inf where something stands right in front, NaN
    where nothing is known.

    Where a ray ends at something upright, one sigma of its range and a cell's width are taken off.
    """
    ranges = scan.ranges_m.astype(np.float64)
    obstacle = scan.obstacle_m
    if obstacle is not None:
        touches = np.isfinite(obstacle) & (ranges > 0)
        ranges -= np.where(touches, scan.error_per_m * ranges**2 + CELL_M, 0.0)
    beyond = scan.ranges_m >= scan.range_max_m
    ranges[beyond] = np.inf
    ranges[scan.ranges_m == 0] = -np.inf
    ranges[(ranges <= 0) & np.isfinite(ranges)] = -np.inf
    return ranges.astype(np.float32)


def near_obstacles(scan: FloorScan) -> tuple[NDArray[np.float32], float]:
    """Return how far away something stands or walks per bearing, (N,) in metres, inf where nothing
    is known to, and how far that is told: as far as its error, one sigma, is half a cell.
    """
    reach_m = scan.range_max_m * math.sqrt(CELL_M / 2 / RANGE_MAX_ERROR_M)
    nearest = np.full(len(scan.ranges_m), np.inf, np.float32)
    if scan.obstacle_m is not None:
        near = scan.obstacle_m < reach_m
        nearest[near] = scan.obstacle_m[near]
    return nearest, reach_m


@dataclass(frozen=True)
class FloorSegmentationSettings(RobotSettings):
    """Disparity, floor profile, mask and scan."""

    num_disparities: int = setting(
        0,
        'Disparities searched, a multiple of 16; 0 derives it from camera and mount.',
        unit='px',
        within=(0, 512),
    )
    disparity_above_horizon: bool = setting(
        False, 'Match the rows above the horizon too; the floor does not need them.'
    )
    scan_range_m: float = setting(
        0.0,
        'Longest range of the floor scan; 0 derives it from focal length and baseline.',
        within=(0.0, 60.0),
    )
