"""What one keyframe says about the floor around it, compact and in the keyframe's base frame; as
arrays, for a file, and back.

The area between neighbouring bearings of a floor scan, on a raster.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.contracts import (
    CELL_M,
    POINT_FLOOR,
    POINT_OBSTACLE,
    SAME_SURFACE_SHARE,
    FloorScan,
    KeyframeFeatures,
    LabelledPoints,
)
from segfloor_ros.core.files.arrays import Arrays, joined, split
from segfloor_ros.core.geometry import Array, invert, transform_points
from segfloor_ros.core.grid.occupancy import OccupancyGridSettings

_LEAST_DEEP_M = 0.03
"""What stands on the floor is at least this deep behind the face that is seen."""


_SURE_SHARE = 0.4
"""An obstacle is placed within its cell where this share of a cell's side is one sigma."""
_FREE_ERROR_M = 0.12
"""Where the end of the floor is less certain than this, one sigma, it is not mapped by default."""

NUMBERS = {
    'first_rad': float,
    'step_rad': float,
    'sure_range_m': float,
    'num_rays': int,
    'num_contacts': int,
}
LENGTHS = {
    'fan_m': 'fan_count',
    'thickness_m': 'thickness_count',
    'positions_m': 'position_count',
    'movable_m': 'movable_count',
}
PLACES = ('positions_m', 'movable_m')
"""The arrays of a keyframe, and what holds their lengths; which of them are of (x, y)."""

SUBPIXEL_BITS = 4
_SLANT_STEPS, _MAX_SLANT = 3, 4.0
"""Bearings over which the slant of a face is measured, and the largest that counts."""


@dataclass(frozen=True)
class KeyframeEvidence:
    """Free floor and hits of one keyframe, in metres and radians in its base's x-y plane.

    Half precision, 0.05 % of the distance, is finer than distances are known, and keyframes are
    many. fan_m: (S,) float16, how far the floor is free along bearing first_rad + i * step_rad.
    positions_m: (2, M) float16; the first num_rays are the ends of single rays to floor points
    that reach farther than the fan. Then come lines along what the floor ends at, num_contacts
    ends and as many starts; the others are obstacle points at any height that concerns the robot.
    thickness_m: (num_contacts,) float16, how deep the things behind these lines are taken to be.
    sure_range_m: up to where an obstacle is placed within its cell. movable_m: (2, P) float16,
    faces of things of classes that move.
    """

    first_rad: float
    step_rad: float
    fan_m: NDArray[np.float16]
    positions_m: NDArray[np.float16]
    num_rays: int
    num_contacts: int
    thickness_m: NDArray[np.float16]
    sure_range_m: float
    movable_m: NDArray[np.float16]


def gather_evidence(
    points: LabelledPoints,
    features: KeyframeFeatures,
    T_map_base: Array,
    scan: FloorScan,
    settings: OccupancyGridSettings,
) -> KeyframeEvidence:
    """Return what the keyframe at T_map_base (4, 4) says, by its features and its floor scan."""
    if not settings.use_scan:
        nothing = np.zeros(0, np.float32)
        scan = dataclasses.replace(scan, ranges_m=nothing, obstacle_m=None)
    floor, obstacles = seen_points(points, features, T_map_base)
    if not settings.use_points:
        floor, obstacles = floor[:0], obstacles[:0]
    faces_m, hit_m = _faces(scan, settings), hit_range_m(scan, settings)
    free_m = np.minimum(_floor_end(scan, faces_m), free_range_m(scan, settings))
    rays = _rays(floor, scan, settings)
    starts, ends = _contacts(scan, faces_m)
    obstacles = obstacles[np.hypot(obstacles[:, 0], obstacles[:, 1]) <= hit_m]
    return KeyframeEvidence(
        first_rad=scan.angle_min_rad,
        step_rad=scan.angle_increment_rad,
        fan_m=free_m.astype(np.float16),
        positions_m=np.concatenate([rays, ends, starts, obstacles]).T.astype(np.float16),
        num_rays=len(rays),
        num_contacts=len(starts),
        thickness_m=_thickness_m(starts, scan),
        sure_range_m=_sure_range_m(scan, settings),
        movable_m=_movable(scan, settings),
    )


def hit_range_m(scan: FloorScan, settings: OccupancyGridSettings) -> float:
    """Return up to which distance an obstacle is placed well enough, within a cell or a usual one,
    to mark cells.
    """
    limit_m = free_range_m(scan, settings)
    if scan.error_per_m == 0:
        return limit_m
    error_m = max(settings.resolution_m, CELL_M)
    return min(limit_m, math.sqrt(error_m / scan.error_per_m))


def _sure_range_m(scan: FloorScan, settings: OccupancyGridSettings) -> float:
    """Return up to which distance the end of the floor is placed within its cell."""
    limit_m = hit_range_m(scan, settings)
    if scan.error_per_m == 0:
        return limit_m
    return min(limit_m, math.sqrt(_SURE_SHARE * settings.resolution_m / scan.error_per_m))


def free_range_m(scan: FloorScan, settings: OccupancyGridSettings) -> float:
    """Return up to which distance floor is marked free: as set, or where the scan's error becomes
    that of a map still worth having.
    """
    if settings.max_range_m > 0:
        return settings.max_range_m
    if scan.error_per_m == 0:
        return math.inf
    return math.sqrt(_FREE_ERROR_M / scan.error_per_m)


def ray_length_limit(lengths_m: Array) -> float:
    """Return the length above which a ray of this keyframe is an outlier: Q3 + 1.5 IQR with the
    quartiles of a normal distribution (Segfloor, 2022).
    """
    quarter = NormalDist().inv_cdf(0.75) * float(lengths_m.std())
    return float(lengths_m.mean()) + quarter + 1.5 * 2 * quarter


def seen_points(
    points: LabelledPoints, features: KeyframeFeatures, T_map_base: Array
) -> tuple[Array, Array]:
    """Return floor and obstacle points that the keyframe sees, (N, 2) each in its base frame."""
    if len(points.point_id) == 0:
        return np.zeros((0, 2)), np.zeros((0, 2))
    row = np.searchsorted(points.point_id, features.point_id)
    row = np.minimum(row, len(points.point_id) - 1)
    row = row[points.point_id[row] == features.point_id]
    in_base = transform_points(invert(T_map_base), points.xyz_map[row].astype(np.float64))
    label = points.label[row]
    return in_base[label == POINT_FLOOR, :2], in_base[label == POINT_OBSTACLE, :2]


def _floor_end(scan: FloorScan, faces_m: Array) -> Array:
    """Return how far the floor certainly reaches along the scan's bearings, (S,), 0 where unknown.

    Where it ends at a face (S,), that is the end; where it fades out, its end is as uncertain as
    its distance.
    """
    seen_m = np.nan_to_num(scan.ranges_m.astype(np.float64))
    ends = np.isfinite(faces_m) & (seen_m > 0)
    return np.where(ends, faces_m, _certain(seen_m, scan))


def _faces(scan: FloorScan, settings: OccupancyGridSettings) -> Array:
    """Return where, along the scan's bearings, faces begin that are placed well enough, (S,), NaN
    elsewhere.

    A cell into which something reaches by more than a share of its side is occupied, but cells
    are decided by their centres: faces are taken to stand that much nearer.
    """
    if scan.obstacle_m is None or len(scan.obstacle_m) == 0:
        return np.full(len(scan.ranges_m), np.nan)
    standing_m = scan.obstacle_m.astype(np.float64)
    standing_m[~(standing_m <= hit_range_m(scan, settings))] = np.nan
    nearer_m = (0.5 - settings.occupied_share) * settings.resolution_m
    return np.maximum(standing_m - nearer_m * slant(standing_m, scan.angle_increment_rad), 0.0)


def _contacts(scan: FloorScan, faces_m: Array) -> tuple[Array, Array]:
    """Return the faces (S,) that the scan's bearings end at as lines: starts (C, 2) and ends
    (C, 2) in the base frame.

    A line joins neighbouring bearings where they see the same surface, and is a point elsewhere.
    """
    near = np.flatnonzero(np.isfinite(faces_m))
    distance_m = faces_m[near]
    start = (unit_vectors(scan.bearings_rad[near]) * distance_m).T
    joined = np.zeros(len(near), np.bool_)
    joined[:-1] = (np.diff(near) == 1) & ~find_jumps(distance_m)
    end = np.where(joined[:, None], np.roll(start, -1, axis=0), start)
    return start, end


def _movable(scan: FloorScan, settings: OccupancyGridSettings) -> NDArray[np.float16]:
    """Return where, in the base frame, faces (2, P) of things of classes that move stand."""
    faces_m = _faces(dataclasses.replace(scan, obstacle_m=scan.movable_m), settings)
    near = np.flatnonzero(np.isfinite(faces_m))
    return (unit_vectors(scan.bearings_rad[near]) * faces_m[near]).astype(np.float16)


def _thickness_m(faces: Array, scan: FloorScan) -> NDArray[np.float16]:
    """Return how deep (C,) to mark behind faces (C, 2): two sigma of their distance, and no less
    than things that stand have.
    """
    error_m = scan.error_per_m * (faces**2).sum(axis=1)
    return np.maximum(2 * error_m, _LEAST_DEEP_M).astype(np.float16)


def _certain(range_m: Array, scan: FloorScan) -> Array:
    """Return ranges (N,) shortened by their error."""
    return np.maximum(range_m - scan.error_per_m * range_m**2, 0.0)


def _rays(floor: Array, scan: FloorScan, settings: OccupancyGridSettings) -> Array:
    """Return the ends (R, 2) of the rays to floor points (N, 2), shortened by their error.

    Rays within the scan's free area add nothing, and rays that pass through what the scan saw
    standing there are wrong.
    """
    length_m = np.hypot(floor[:, 0], floor[:, 1])
    usable = (length_m > 0) & (length_m <= free_range_m(scan, settings))
    if usable.any():
        usable &= length_m <= ray_length_limit(length_m[usable])
    scanned_m, standing_m = _scan_at(scan, floor)
    usable &= (length_m > scanned_m) & (length_m < standing_m)
    floor, length_m = floor[usable], length_m[usable]
    return floor * (_certain(length_m, scan) / length_m)[:, None]


def _scan_at(scan: FloorScan, points: Array) -> tuple[Array, Array]:
    """Return the scan's range (N,), 0 where unknown, and the distance (N,) of what it saw
    standing, infinite where nothing, at the bearings of points (N, 2).
    """
    if len(scan.ranges_m) == 0:
        return np.zeros(len(points)), np.full(len(points), np.inf)
    offset = np.arctan2(points[:, 1], points[:, 0]) - scan.angle_min_rad
    index = np.rint(offset / scan.angle_increment_rad).astype(np.intp)
    inside = (index >= 0) & (index < len(scan.ranges_m))
    index = np.clip(index, 0, len(scan.ranges_m) - 1)
    scanned = np.where(inside, np.nan_to_num(scan.ranges_m[index]), 0.0)
    standing = np.full(len(points), np.nan)
    for seen_m in (scan.obstacle_m, scan.movable_m):
        if seen_m is not None:
            standing = np.fmin(standing, seen_m[index])
    return scanned, np.where(inside & np.isfinite(standing), standing, np.inf)


def evidence_to_arrays(evidence: list[KeyframeEvidence]) -> Arrays:
    """Return the evidence of keyframes (K) as arrays."""
    numbers = [[float(getattr(e, name)) for name in NUMBERS] for e in evidence]
    arrays: Arrays = {'numbers': np.array(numbers, np.float64).reshape(-1, len(NUMBERS))}
    for name, lengths in LENGTHS.items():
        empty = np.zeros((0, 2) if name in PLACES else 0, np.float16)
        arrays[name], arrays[lengths] = joined([getattr(e, name).T for e in evidence], empty)
    return arrays


def evidence_from_arrays(arrays: Arrays) -> list[KeyframeEvidence]:
    """Return what `evidence_to_arrays` took, also of an earlier release. Raises KeyError or
    ValueError for other arrays.
    """
    count = len(arrays['numbers'])
    arrays = {'movable_m': np.zeros((0, 2)), 'movable_count': np.zeros(count, np.int64), **arrays}
    parts = [split(arrays[name], arrays[lengths]) for name, lengths in LENGTHS.items()]
    evidence = []
    for row, *of_one in zip(arrays['numbers'].tolist(), *parts, strict=True):
        values: dict[str, Any] = {n: NUMBERS[n](v) for n, v in zip(NUMBERS, row, strict=True)}
        for name, array in zip(LENGTHS, of_one, strict=True):
            values[name] = np.ascontiguousarray(array.T)
        evidence.append(KeyframeEvidence(**values))
    return evidence


@dataclass(frozen=True)
class Fan:
    """A star-shaped area around `centre` (x, y), in cells, x along columns and y along rows.

    Bearing i is first_rad + i * step_rad; directions: (2, S), their unit vectors; lengths: (S,),
    how far the area reaches. jumps: (S - 1,) bool, where a bearing and the next one end at
    different things; there, the area between them ends at the nearer one.
    """

    centre: Array
    first_rad: float
    step_rad: float
    directions: Array
    lengths: Array
    jumps: NDArray[np.bool_]

    def draw(self, shape: tuple[int, ...]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Return two rasters (rows, columns): the first is 1 where a cell's centre lies in the
        fan, the second where any part of the cell does.
        """
        area = np.zeros(shape, np.uint8)
        if len(self.lengths) < 2:
            return area, area.copy()
        left, right = self._ends()
        outline = np.zeros((2, 2 * left.shape[1] + 1))
        outline[:, 1::2], outline[:, 2::2] = left, right
        pixels = fixed_point(self.centre[:, None] + outline)
        # Filled shapes include every cell their border passes through: decide those by centre.
        cv2.fillPoly(area, [pixels], 1, shift=SUBPIXEL_BITS)
        touched = area.copy()
        border = np.zeros(shape, np.uint8)
        cv2.polylines(border, [pixels], True, 1, shift=SUBPIXEL_BITS)
        at = cv2.findNonZero(border)
        if at is not None:
            column, row = at.reshape(-1, 2).T
            x, y = column + (0.5 - self.centre[0]), row + (0.5 - self.centre[1])
            area[row, column] = self._contains(x, y, left, right)
        return area, touched

    def shadow(self, shape: tuple[int, ...], start: Array) -> NDArray[np.uint8] | None:
        """Return a raster that is 1 in all cells farther than `start` (S,) along a bearing, or on
        the border of that; None where `start` lies beyond the fan.
        """
        hidden = start < self.lengths
        if not hidden.any():
            return None
        wedge = np.flatnonzero(hidden[:-1] | hidden[1:])
        inner = self.directions * np.minimum(start, self.lengths)
        outer = self.directions * (self.lengths + 1)
        corners = [inner[:, wedge], outer[:, wedge], outer[:, wedge + 1], inner[:, wedge + 1]]
        quads = self.centre[:, None, None] + np.stack(corners, axis=2)
        area = np.zeros(shape, np.uint8)
        pixels = fixed_point(quads.reshape(2, -1)).reshape(-1, 4, 2)
        cv2.fillPoly(area, list(pixels), 1, shift=SUBPIXEL_BITS)
        return area

    def edges(self) -> NDArray[np.bool_]:
        """Return which bearings (S,) bound the fan: the outermost ones, and those that see past
        something. A single bearing that reaches farther than both its neighbours does not.
        """
        first, second = self.lengths[:-1], self.lengths[1:]
        past_next = np.append(self.jumps & (first > second), True)
        past_previous = np.append(True, self.jumps & (second > first))
        return past_next ^ past_previous

    def _ends(self) -> tuple[Array, Array]:
        """Return where the S - 1 wedges end at their first and second bearing, (2, S - 1) each."""
        first, second = self.lengths[:-1], self.lengths[1:]
        nearer = np.minimum(first, second)
        left = np.where(self.jumps, nearer, first) * self.directions[:, :-1]
        right = np.where(self.jumps, nearer, second) * self.directions[:, 1:]
        return left, right

    def _contains(self, x: Array, y: Array, left: Array, right: Array) -> NDArray[np.bool_]:
        """Return which points (N,), (N,), relative to the centre, lie within their wedge."""
        bearing = np.remainder(np.arctan2(y, x) - self.first_rad, math.tau)
        index = (bearing * (1 / self.step_rad)).astype(np.intp)
        within = index < left.shape[1]
        index *= within
        edge_x, edge_y = right - left
        beyond = edge_x * left[1] - edge_y * left[0]
        side = edge_x[index] * y - edge_y[index] * x
        return within & (side >= beyond[index])


def find_jumps(lengths: Array) -> NDArray[np.bool_]:
    """Tell where neighbouring lengths (S,) end at different things, (S - 1,)."""
    first, second = lengths[:-1], lengths[1:]
    return np.abs(first - second) > SAME_SURFACE_SHARE * np.minimum(first, second)


def slant(range_m: Array, step_rad: float) -> Array:
    """Return how much longer (S,) the way through a face along its bearing is than straight across
    it, from the ranges (S,) to faces on neighbouring bearings, NaN where there is none.
    """
    rise = np.full((2, len(range_m)), np.nan)
    change = (range_m[_SLANT_STEPS:] - range_m[:-_SLANT_STEPS]) / (_SLANT_STEPS * step_rad)
    rise[0, :-_SLANT_STEPS] = change / range_m[:-_SLANT_STEPS]
    rise[1, _SLANT_STEPS:] = change / range_m[_SLANT_STEPS:]
    rise[~(np.abs(rise) <= SAME_SURFACE_SHARE / step_rad)] = np.nan
    known = np.isfinite(rise)
    mean = np.where(known, rise, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return np.minimum(np.sqrt(1 + mean**2), _MAX_SLANT)


def unit_vectors(bearing_rad: Array) -> Array:
    """Return unit vectors (2, N) of bearings (N,)."""
    directions = np.empty((2, len(bearing_rad)))
    np.cos(bearing_rad, out=directions[0])
    np.sin(bearing_rad, out=directions[1])
    return directions


def fixed_point(xy_cells: Array) -> NDArray[np.int32]:
    """Return OpenCV's fixed-point coordinates (N, 2) of positions (2, N) in cells; there, whole
    numbers are the centres of pixels.
    """
    scaled = xy_cells * (1 << SUBPIXEL_BITS) - (1 << SUBPIXEL_BITS - 1)
    pixels = np.empty((xy_cells.shape[1], 2), np.int32)
    np.rint(scaled.T, out=pixels, casting='unsafe')
    return pixels


def nearest_cells(
    column: NDArray[np.integer], row: NDArray[np.integer], fan: Fan
) -> NDArray[np.float64]:
    """Return the distance (S,) in cells to the nearest of some cells along a fan's bearings.

    column, row: (N,). A cell covers the bearings within half a cell of its centre; bearings that
    no cell covers are infinite.
    """
    x, y = column + (0.5 - fan.centre[0]), row + (0.5 - fan.centre[1])
    distance: Array = np.sqrt(x * x + y * y)
    bearing = np.remainder(np.arctan2(y, x) - fan.first_rad, math.tau) * (1 / fan.step_rad)
    half_width = (0.5 / fan.step_rad) / np.maximum(distance, 0.5)
    first = np.ceil(bearing - half_width).astype(np.intp)
    count = np.floor(bearing + half_width).astype(np.intp) - first + 1
    start = np.cumsum(count) - count
    index = np.arange(count.sum()) + np.repeat(first - start, count)
    nearest = np.full(int(np.ceil(math.tau / fan.step_rad)), np.inf)
    np.minimum.at(nearest, index % len(nearest), np.repeat(distance, count))
    return nearest[: len(fan.lengths)]
