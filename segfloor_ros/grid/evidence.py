"""What one keyframe says about the floor around it, compact and in the keyframe's base frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.cloud.labels import FLOOR, OBSTACLE, LabelledPoints
from segfloor_ros.floor.observation import FloorScan
from segfloor_ros.geometry import Array, invert, transform_points
from segfloor_ros.grid.settings import OccupancyGridSettings
from segfloor_ros.slam.results import KeyframeFeatures

QUARTILE = 0.675
"""Quartiles of a normal distribution lie this many sigmas from its mean."""


@dataclass(frozen=True)
class KeyframeEvidence:
    """Free spokes and hits of one keyframe, in metres and radians in its base's x-y plane.

    fan: (S, 2) float32, unit vectors of neighbouring bearings of the floor scan. fan_m: (S,)
    float32, how far the floor is free along them. rays: (R, 2) float32 and rays_m: (R,), the same
    for single rays to floor points that reach farther than the fan. hits: (H, 2) float32,
    positions of obstacles.
    """

    fan: NDArray[np.float32]
    fan_m: NDArray[np.float32]
    rays: NDArray[np.float32]
    rays_m: NDArray[np.float32]
    hits: NDArray[np.float32]


def gather_evidence(
    points: LabelledPoints,
    features: KeyframeFeatures,
    T_map_base: Array,
    scan: FloorScan,
    settings: OccupancyGridSettings,
) -> KeyframeEvidence:
    """Return what the keyframe at T_map_base (4, 4) says, by its features and its floor scan."""
    floor, obstacles = _seen_points(points, features, T_map_base)
    if not settings.use_points:
        floor, obstacles = floor[:0], obstacles[:0]
    fan, fan_m, contacts = _fan(scan, settings)
    if not settings.use_scan:
        fan, fan_m, contacts = fan[:0], fan_m[:0], contacts[:0]
    rays, rays_m = _rays(floor, scan if settings.use_scan else None, settings)
    hits = np.concatenate([obstacles, contacts])
    hits = hits[np.linalg.norm(hits, axis=1) <= hit_range_m(settings)]
    return KeyframeEvidence(fan, fan_m, rays, rays_m, hits.astype(np.float32))


def hit_range_m(settings: OccupancyGridSettings) -> float:
    """Return up to which distance an obstacle is placed well enough to mark a cell."""
    if settings.range_error_per_m == 0:
        return settings.max_range_m
    certain = float(np.sqrt(settings.max_hit_error_m / settings.range_error_per_m))
    return min(settings.max_range_m, certain)


def ray_length_limit(lengths_m: Array) -> float:
    """Return the length above which a ray of this keyframe is an outlier: Q3 + 1.5 IQR with
    Q1, Q3 = mean -/+ 0.675 sigma (Segfloor, 2022).
    """
    quarter = QUARTILE * float(lengths_m.std())
    return float(lengths_m.mean()) + quarter + 1.5 * 2 * quarter


def _seen_points(
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
    return in_base[label == FLOOR, :2], in_base[label == OBSTACLE, :2]


def _fan(
    scan: FloorScan, settings: OccupancyGridSettings
) -> tuple[NDArray[np.float32], NDArray[np.float32], Array]:
    """Return unit vectors (S, 2), free lengths (S,) and contacts (C, 2) of the scan."""
    bearing = scan.bearings_rad
    directions = np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
    seen_m = np.nan_to_num(scan.ranges_m.astype(np.float64))
    free_m = np.minimum(_certain(seen_m, settings), settings.max_range_m)
    contacts = np.zeros((0, 2))
    if scan.obstacle_m is not None:
        hit = np.isfinite(scan.obstacle_m)
        contacts = directions[hit] * scan.obstacle_m[hit, None]
    return directions.astype(np.float32), free_m.astype(np.float32), contacts


def _certain(range_m: Array, settings: OccupancyGridSettings) -> Array:
    """Return ranges (N,) shortened by their error."""
    return np.maximum(range_m - settings.range_error_per_m * range_m**2, 0.0)


def _rays(
    floor: Array, scan: FloorScan | None, settings: OccupancyGridSettings
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return unit vectors (R, 2) and free lengths (R,) of the rays to floor points (N, 2).

    Rays within the scan's free area add nothing, and rays that pass through what the scan saw
    standing there are wrong.
    """
    length = np.linalg.norm(floor, axis=1)
    usable = (length > 0.05) & (length <= settings.max_range_m)
    floor, length = floor[usable], length[usable]
    if len(length):
        usable = length <= ray_length_limit(length)
        floor, length = floor[usable], length[usable]
    free_m = _certain(length, settings)
    if scan is not None and len(scan.ranges_m):
        scanned_m, standing_m = _scan_at(scan, floor)
        usable = (free_m > _certain(scanned_m, settings)) & (length < standing_m)
        floor, length, free_m = floor[usable], length[usable], free_m[usable]
    directions = floor / length[:, None]
    return directions.astype(np.float32), free_m.astype(np.float32)


def _scan_at(scan: FloorScan, points: Array) -> tuple[Array, Array]:
    """Return the scan's range (N,), 0 where unknown, and the distance (N,) of what it saw
    standing, infinite where nothing, at the bearings of points (N, 2).
    """
    offset = np.arctan2(points[:, 1], points[:, 0]) - scan.angle_min_rad
    index = np.rint(offset / scan.angle_increment_rad).astype(np.intp)
    inside = (index >= 0) & (index < len(scan.ranges_m))
    index = np.clip(index, 0, len(scan.ranges_m) - 1)
    scanned = np.where(inside, np.nan_to_num(scan.ranges_m[index]), 0.0)
    if scan.obstacle_m is None:
        return scanned, np.full(len(points), np.inf)
    standing = scan.obstacle_m[index]
    return scanned, np.where(inside & np.isfinite(standing), standing, np.inf)
