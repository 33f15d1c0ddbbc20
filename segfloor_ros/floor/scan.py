"""The floor scan: how far the floor is seen without interruption, per bearing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import grey_closing, grey_opening

from segfloor_ros.camera.model import Mount, StereoCamera
from segfloor_ros.floor.observation import FloorScan
from segfloor_ros.floor.settings import FloorSegmentationSettings
from segfloor_ros.geometry import Array

RANGE_STEP_M = 0.025
_GAP_ROWS = 4.0
"""So many image rows of floor may be missing, however many metres they are."""
_CONTACT_ROWS = 2.5
"""So many rows may be missing where the floor meets what stands on it."""
_FADING_ROWS = 1.5
"""So many rows are taken off where nothing shows why the floor ends."""
_DIP_BEARINGS = 5
_SPREAD = 0.06
"""What stands upright is measured within this share of its range."""
_UPRIGHT_M = 0.08
"""So much of an upright surface must be seen to end the scan."""


class FloorScanner:
    """Makes the scans of one camera on one mount."""

    def __init__(
        self, camera: StereoCamera, mount: Mount, settings: FloorSegmentationSettings
    ) -> None:
        self._camera, self._settings = camera, settings
        self._height_m = mount.height_m
        border = _floor_on_border(camera, mount)
        bearing = np.arctan2(border[:, 1], border[:, 0])
        step = settings.scan_increment_rad
        first = np.floor(bearing.min() / step) if len(border) else 0.0
        self._angle_min = float(first * step)
        self._count = int(np.ceil(bearing.max() / step) - first) + 1 if len(border) else 1
        self._middle = (np.arange(0, settings.scan_range_m, RANGE_STEP_M)) + RANGE_STEP_M / 2
        nearest = np.full(self._count, np.inf)
        np.minimum.at(nearest, self._bearing_index(border.T), np.hypot(*border.T))
        self._nearest = nearest
        bearings = self._angle_min + step * np.arange(self._count)
        directions = np.stack([np.cos(bearings), np.sin(bearings)])
        cells = directions[:, :, None] * self._middle
        self._cells_xy = cells.reshape(2, -1).astype(np.float32)

    @property
    def cells_xy(self) -> NDArray[np.float32]:
        """Where the scan looks for floor, (2, N) in the base's x-y plane: at every bearing in
        turn all ranges.
        """
        return self._cells_xy

    def scan(
        self,
        floor: NDArray[np.bool_],
        shared: NDArray[np.bool_],
        upright_xy: NDArray[np.float32],
        density: float,
    ) -> FloorScan:
        """Return the scan of floor, (N,) at `cells_xy`, and of points that stand up, (2, M) in the
        base's x-y plane.

        A ray ends at the first thing that stands up or at the first gap in the floor longer than
        what is tolerated, and never beyond the last floor that both cameras saw: at the image's
        edge, floor that only looks alike may continue a ray but not end it. shared: (N,) which
        cells both cameras can see. density: the part of the image's pixels that the points are
        from.
        """
        shape = (self._count, len(self._middle))
        floor, seen_by_both = floor.reshape(shape), (floor & shared).reshape(shape)
        upright_m = self._upright(self._polar_counts(upright_xy), density)
        middle = self._middle
        limit = np.where(np.isnan(upright_m), np.inf, upright_m)
        seen = floor & (middle < limit[:, None])
        # A dip of a few bearings in which nothing stands up is a hole in the mask, a spike is floor
        # that has crept up a blank wall.
        reached = grey_closing(self._reached(seen, seen_by_both), size=(_DIP_BEARINGS,))
        reached = np.minimum(grey_opening(reached, size=(_DIP_BEARINGS,)), limit)
        near = np.maximum(self._settings.scan_gap_m, _SPREAD * upright_m)
        near = np.maximum(near, _CONTACT_ROWS * self._row_m(upright_m))
        with np.errstate(invalid='ignore'):
            touches = (reached > 0) & (reached >= upright_m - near)
            in_front = (reached == 0) & (upright_m <= self._nearest + near)
        faded = reached - _FADING_ROWS * self._row_m(reached)
        ranges = np.where(touches, upright_m, np.where(reached > 0, faded, np.nan))
        ranges[in_front] = 0.0
        # Where the floor ends before it, the match may be as wrong as it is far.
        upright_m = np.where(touches | in_front, upright_m, np.nan)
        return FloorScan(
            self._angle_min,
            self._settings.scan_increment_rad,
            ranges.astype(np.float32),
            upright_m.astype(np.float32),
        )

    def _tolerance(self, range_m: Array) -> Array:
        """Return how long a gap in the floor may be at a range."""
        return np.maximum(self._settings.scan_gap_m, _GAP_ROWS * self._row_m(range_m))

    def _row_m(self, range_m: Array) -> Array:
        """Return how much floor one image row shows at a range."""
        return range_m**2 / (self._height_m * self._camera.fy)

    def _reached(self, seen: NDArray[np.bool_], may_end: NDArray[np.bool_]) -> Array:
        """Return the end (N,) of the first uninterrupted stretch of floor, 0 where there is none.

        Up to the nearest floor that the image can show it is presumed.
        """
        middle = self._middle
        last = np.maximum.accumulate(np.where(seen, middle, 0.0), axis=1)
        previous = np.concatenate([np.zeros((self._count, 1)), last[:, :-1]], axis=1)
        previous = np.maximum(previous, self._nearest[:, None])
        broken = seen & (middle - previous > self._tolerance(middle))
        unbroken = np.cumsum(broken, axis=1) == 0
        return np.where(seen & unbroken & may_end, middle, 0.0).max(axis=1)

    def _upright(self, counts: NDArray[np.intp], density: float) -> Array:
        """Return the range (N,) of the nearest upright thing, NaN where there is none.

        It must show as many pixels, within the spread of its disparities, as an upright surface
        of a given height does at its range.
        """
        camera, middle = self._camera, self._middle
        wide = camera.fx * self._settings.scan_increment_rad * density
        needed = np.maximum(2.0, 0.5 * wide * _UPRIGHT_M * camera.fy / middle)
        total = np.concatenate([np.zeros((self._count, 1)), np.cumsum(counts, axis=1)], axis=1)
        first = np.arange(len(middle))
        end = np.minimum(np.ceil(middle * (1 + _SPREAD) / RANGE_STEP_M), len(middle)).astype(int)
        within = total[:, end] - total[:, first]
        enough = within >= needed
        begin = np.where(enough.any(axis=1), enough.argmax(axis=1), 0)
        rows = np.arange(self._count)
        half = total[rows, begin] + 0.5 * within[rows, begin]
        centre = (total[:, 1:] >= half[:, None]).argmax(axis=1)
        return np.where(enough.any(axis=1), middle[centre], np.nan)

    def _bearing_index(self, xy: NDArray[np.floating]) -> NDArray[np.intp]:
        bearing = np.arctan2(xy[1], xy[0])
        offset = (bearing - self._angle_min) / self._settings.scan_increment_rad
        return np.clip(np.rint(offset), 0, self._count - 1).astype(np.intp)

    def _polar_counts(self, xy: NDArray[np.float32]) -> NDArray[np.intp]:
        n, m = self._count, len(self._middle)
        ranges = np.hypot(xy[0], xy[1])
        near = ranges < self._settings.scan_range_m
        cell = self._bearing_index(xy[:, near]) * m
        cell += np.minimum((ranges[near] / RANGE_STEP_M).astype(np.intp), m - 1)
        return np.bincount(cell, minlength=n * m).reshape(n, m)


def _floor_on_border(camera: StereoCamera, mount: Mount) -> Array:
    """Return where the rays along the image's left, right and lower border meet the floor, (N, 2)
    in the base's x-y plane.
    """
    columns = np.arange(camera.width, dtype=np.float64)
    rows = np.arange(camera.height, dtype=np.float64)
    uv = np.concatenate(
        [
            np.stack([columns, np.full(camera.width, camera.height - 1.0)], 1),
            np.stack([np.zeros(camera.height), rows], 1),
            np.stack([np.full(camera.height, camera.width - 1.0), rows], 1),
        ]
    )
    T_base_left = mount.T_base_left
    rays = camera.back_project(uv, np.ones(len(uv))) @ T_base_left[:3, :3].T
    rays = rays[rays[:, 2] < -1e-3]
    return T_base_left[:2, 3] + rays[:, :2] * (mount.height_m / -rays[:, 2:])
