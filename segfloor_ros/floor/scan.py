"""The floor scan: how far the floor is seen without interruption, per bearing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import Mount, StereoCamera
from segfloor_ros.floor.observation import FloorScan
from segfloor_ros.floor.settings import FloorSegmentationSettings
from segfloor_ros.geometry import Array, transform_points

RANGE_STEP_M = 0.025


class ScanGeometry:
    """Bearings of one camera on one mount, and what each can see of the floor."""

    def __init__(
        self, camera: StereoCamera, mount: Mount, settings: FloorSegmentationSettings
    ) -> None:
        self._camera, self._mount, self._settings = camera, mount, settings
        self.T_base_left = mount.T_base_left
        bearings = np.concatenate(self._border_bearings())
        step = settings.scan_increment_rad
        first = np.floor(np.nanmin(bearings) / step)
        self.angle_min_rad = float(first * step)
        self.count = int(np.ceil(np.nanmax(bearings) / step) - first) + 1
        self.num_ranges = int(np.ceil(settings.scan_range_m / RANGE_STEP_M))
        self.nearest_m = self._nearest_ranges()

    def _floor_points(self, uv: Array) -> Array:
        """Return where the rays of pixels (N, 2) meet the floor, NaN above the horizon."""
        rays = self._camera.back_project(uv, np.ones(len(uv)))
        down = rays @ self._mount.up_in_camera
        depth = np.where(down < -1e-3, self._mount.height_m / np.minimum(-down, -1e-9) * -1, np.nan)
        return transform_points(self.T_base_left, rays * depth[:, None])

    def _border_bearings(self) -> list[Array]:
        camera = self._camera
        rows = np.linspace(0, camera.height - 1, 64)
        columns = np.linspace(0, camera.width - 1, 64)
        borders = [
            np.stack([np.zeros(64), rows], 1),
            np.stack([np.full(64, camera.width - 1.0), rows], 1),
            np.stack([columns, np.full(64, camera.height - 1.0)], 1),
        ]
        points = [self._floor_points(border) for border in borders]
        return [np.arctan2(p[:, 1], p[:, 0]) for p in points]

    def _nearest_ranges(self) -> Array:
        """Return the range (N,) of the nearest floor that the image shows at each bearing."""
        camera = self._camera
        columns = np.arange(camera.width, dtype=np.float64)
        rows = np.arange(0, camera.height, 2, dtype=np.float64)
        uv = np.concatenate(
            [
                np.stack([columns, np.full(camera.width, camera.height - 1.0)], 1),
                np.stack([np.zeros(len(rows)), rows], 1),
                np.stack([np.full(len(rows), camera.width - 1.0), rows], 1),
            ]
        )
        points = self._floor_points(uv)
        points = points[np.isfinite(points[:, 0])]
        index = self.bearing_index(points)
        nearest = np.full(self.count, np.inf)
        np.minimum.at(nearest, index, np.hypot(points[:, 0], points[:, 1]))
        return nearest

    def bearing_index(self, points_base: Array) -> NDArray[np.intp]:
        """Return the bearing bin of points (N, 2 or 3) in the base frame."""
        bearing = np.arctan2(points_base[:, 1], points_base[:, 0])
        offset = (bearing - self.angle_min_rad) / self._settings.scan_increment_rad
        return np.clip(np.rint(offset), 0, self.count - 1).astype(np.intp)


def make_scan(
    geometry: ScanGeometry,
    floor_base: Array,
    obstacle_base: Array,
    settings: FloorSegmentationSettings,
    camera: StereoCamera,
    mount: Mount,
) -> FloorScan:
    """Return the scan of floor points and not-floor points (N, 2) in the base's x-y plane.

    A ray ends at the first not-floor evidence or at the first gap in the floor longer than what
    is tolerated, and never beyond the last floor that was measured.
    """
    n, m = geometry.count, geometry.num_ranges
    floor = _polar_counts(geometry, floor_base)
    obstacle = _polar_counts(geometry, obstacle_base)
    middle = (np.arange(m) + 0.5) * RANGE_STEP_M
    blocked = obstacle >= np.maximum(2, 0.5 * floor + 1)
    first_block = np.where(blocked.any(1), blocked.argmax(1), m)
    seen = floor > 0
    seen &= np.arange(m) < first_block[:, None]
    # The last bin that held floor, at every range; floor is presumed up to the nearest visible.
    last = np.where(seen, middle, 0.0)
    last = np.maximum.accumulate(last, axis=1)
    previous = np.maximum(
        np.concatenate([np.zeros((n, 1)), last[:, :-1]], axis=1), geometry.nearest_m[:, None]
    )
    row_m = middle**2 / (mount.height_m * camera.fy)
    tolerated = np.maximum(settings.scan_gap_m, 4 * row_m)
    broken = seen & (middle - previous > tolerated)
    first_break = np.where(broken.any(1), broken.argmax(1), m)
    reached = np.where(seen & (np.arange(m) < first_break[:, None]), middle, 0.0).max(axis=1)
    known = seen.any(1) | blocked.any(1)
    near_block = (first_block + 0.5) * RANGE_STEP_M <= geometry.nearest_m + settings.scan_gap_m
    ranges = np.where(reached > 0, reached, np.where(near_block, 0.0, np.nan))
    ranges[~known] = np.nan
    obstacle_m = np.where(blocked.any(1), (first_block + 0.5) * RANGE_STEP_M, np.nan)
    return FloorScan(
        geometry.angle_min_rad,
        settings.scan_increment_rad,
        ranges.astype(np.float32),
        obstacle_m.astype(np.float32),
    )


def _polar_counts(geometry: ScanGeometry, points_base: Array) -> NDArray[np.intp]:
    n, m = geometry.count, geometry.num_ranges
    ranges = np.hypot(points_base[:, 0], points_base[:, 1])
    near = ranges < m * RANGE_STEP_M
    cell = geometry.bearing_index(points_base[near]) * m
    cell += (ranges[near] / RANGE_STEP_M).astype(np.intp)
    return np.bincount(cell, minlength=n * m).reshape(n, m)
