"""The floor scan: how far the floor is seen without interruption, per bearing.

Boards and table tops end a robot's way although the floor goes on below them, and a wall that is
blank near the floor may have something to be seen higher up: what stands or hangs in the way above
the horizon is matched at half the resolution, which is enough for that.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.camera.pixels import SUBPIXEL, shrunk
from segfloor_ros.core.camera.shrinking import shrunk_image
from segfloor_ros.core.contracts import RANGE_MAX_ERROR_M, SAME_SURFACE_SHARE, FloorScan, Mount
from segfloor_ros.core.floor.disparity.matching import (
    COARSE_BLOCK_PX,
    MEAN_NOISE,
    NOISE_PX,
    RUN_UP_ROWS,
    SPECKLE_PX,
    DisparityMatcher,
)
from segfloor_ros.core.floor.disparity.profile import STEP_PX, histogram
from segfloor_ros.core.floor.pair import Pair, texture_grey
from segfloor_ros.core.floor.settings import FloorSegmentationSettings
from segfloor_ros.core.geometry import Array, transform_points

RANGE_STEP_M = 0.025
_INCREMENT_RAD = 0.0087266
"""Half a degree between two bearings."""
_GAP_STEPS = 5
"""A gap in the floor as long as so many steps are high is no gap to the robot."""
_CONTACT_ROWS = 2.5
"""So many rows may be missing where the floor meets what stands on it."""
_FADING_ROWS = 1.5
"""So many rows are taken off where nothing shows why the floor ends."""
_DIP_BEARINGS = 5
_NARROW_M, _GAP_BEARINGS = 0.2, (5, 9, 17, 33)
"""Gaps between things are closed up to this width, in these numbers of bearings."""
_UPRIGHT_M = 0.08
"""So much of an upright surface must be seen to end the scan."""
_LOG_STEP = 0.01
_SPREAD_BINS = round(SAME_SURFACE_SHARE / _LOG_STEP)
_NEAREST_M = 0.1
_MEDIAN_ROUNDS = 3

_SEEN_BEFORE_M = 0.5
"""What is nearer than this has been seen before."""
_TEXTURE_WINDOW_PX = 7
_BOARD_SHARE = 0.04
"""So much of a board must have texture of its own: its ends have."""


class FloorScanner:
    """Makes the scans of one camera on one mount. cells_xy: where it looks for floor, (2, N) in the
    base's x-y plane: at every bearing in turn all ranges.
    """

    def __init__(
        self, camera: StereoCamera, mount: Mount, settings: FloorSegmentationSettings
    ) -> None:
        self._camera, self._gap_m = camera, _GAP_STEPS * settings.step_height_m
        self._height_m = mount.height_m
        border = _floor_on_border(camera, mount)
        bearing = np.arctan2(border[:, 1], border[:, 0])
        # Whole in single precision, as a message carries it.
        step = self._step = float(np.float32(_INCREMENT_RAD))
        first = np.floor(bearing.min() / step) if len(border) else 0.0
        self._angle_min = float(np.float32(first * step))
        self._count = int(np.ceil(bearing.max() / step) - first) + 1 if len(border) else 1
        noise_px = MEAN_NOISE * NOISE_PX
        # Depth from disparity: an error of the disparity d grows to Z^2 / (f b) times as much.
        range_max_m = math.sqrt(RANGE_MAX_ERROR_M * camera.disparity_times_depth / noise_px)
        self._range_max_m = float(np.float32(range_max_m))
        range_m = settings.scan_range_m or range_max_m
        self._middle = np.arange(0, range_m, RANGE_STEP_M) + RANGE_STEP_M / 2
        decades = np.log(range_m / _NEAREST_M)
        self._log_bins = np.arange(math.ceil(decades / _LOG_STEP))
        nearest = np.full(self._count, np.inf)
        np.minimum.at(nearest, self._bearing_index(border.T), np.hypot(*border.T))
        self._nearest = nearest
        bearings = self._angle_min + step * np.arange(self._count)
        directions = np.stack([np.cos(bearings), np.sin(bearings)])
        cells = directions[:, :, None] * self._middle
        self.cells_xy: NDArray[np.float32] = cells.reshape(2, -1).astype(np.float32)

    def scan(
        self,
        floor: NDArray[np.bool_],
        shared: NDArray[np.bool_],
        upright_xy: NDArray[np.float32],
        feet_xy: NDArray[np.float32],
        density: float,
        movable_xy: NDArray[np.float32] | None = None,
    ) -> FloorScan:
        """Return the scan of floor, (N,) at `cells_xy`, of points that stand up, (2, M) in the
        base's x-y plane, of the feet of what is blank, (2, F), and of points of what is of a class
        that moves, (2, P): nothing is free behind it, nor is it said to stand there.

        A ray ends at the first thing that stands up or at the first gap in the floor longer than
        what is tolerated, and never beyond the last floor that both cameras saw: at the image's
        edge, floor that only looks alike may continue a ray but not end it. shared: (N,) which
        cells both cameras can see. density: the part of the image's pixels that the points are
        from.
        """
        shape = (self._count, len(self._middle))
        floor, seen_by_both = floor.reshape(shape), (floor & shared).reshape(shape)
        upright_m = self._upright(upright_xy, density)
        feet_m = self._feet(feet_xy)
        # Both measure the same face equally well.
        same = np.abs(upright_m - feet_m) < SAME_SURFACE_SHARE * feet_m
        upright_m = np.where(same, 0.5 * (upright_m + feet_m), np.fmin(upright_m, feet_m))
        middle = self._middle
        movable_m = None if movable_xy is None else self._upright(movable_xy, density)
        limit = self._limit(upright_m if movable_m is None else np.fmin(upright_m, movable_m))
        seen = floor & (middle < limit[:, None])
        # A dip of a few bearings in which nothing stands up is a hole in the mask, a spike is floor
        # that has crept up a blank wall.
        dips = np.ones((1, _DIP_BEARINGS), np.uint8)
        reached = self._reached(seen, seen_by_both)[None]
        reached = cv2.morphologyEx(reached, cv2.MORPH_CLOSE, dips)
        reached = np.minimum(cv2.morphologyEx(reached, cv2.MORPH_OPEN, dips)[0], limit)
        near = np.maximum(self._gap_m, SAME_SURFACE_SHARE * upright_m)
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
            self._step,
            ranges.astype(np.float32),
            upright_m.astype(np.float32),
            self._range_max_m,
            None if movable_m is None else movable_m.astype(np.float32),
        )

    def _limit(self, upright_m: Array) -> Array:
        """Return how far floor can be (N,) before what stands (N,): things and boards are seen in
        part, and no robot fits through a narrow gap.
        """
        near = 1 / np.where(np.isnan(upright_m), np.inf, upright_m)
        for bearings in _GAP_BEARINGS:
            closed = cv2.morphologyEx(
                near[None],
                cv2.MORPH_CLOSE,
                np.ones((1, bearings), np.uint8),
                borderType=cv2.BORDER_CONSTANT,
                borderValue=0,
            )[0]
            near = np.where(closed * _NARROW_M >= bearings * self._step, closed, near)
        with np.errstate(divide='ignore'):
            limit: Array = 1 / near
        return limit

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
        # So many image rows may be missing, however many metres they are.
        rows_m = (_CONTACT_ROWS + _FADING_ROWS) * self._row_m(middle)
        tolerated = np.maximum(self._gap_m, rows_m)
        broken = seen & (middle - previous > tolerated)
        unbroken = np.cumsum(broken, axis=1) == 0
        return np.where(seen & unbroken & may_end, middle, 0.0).max(axis=1)

    def _upright(self, xy: NDArray[np.float32], density: float) -> Array:
        """Return the range (N,) of the nearest upright thing, NaN where there is none, of points
        (2, M) as in `scan`.

        It must show as many pixels, within the spread of its disparities, as an upright surface
        of a given height does at its range. Its range is the median of its pixels: of those within
        the spread on both sides of it.
        """
        counts = self._polar_counts(xy)
        camera, middle = self._camera, _NEAREST_M * np.exp(_LOG_STEP * (self._log_bins + 0.5))
        wide = camera.fx * self._step * density
        needed = np.maximum(2.0, 0.5 * wide * _UPRIGHT_M * camera.fy / middle)
        last = len(middle)
        total = np.zeros((self._count, last + 1), np.int32)
        np.cumsum(counts, axis=1, out=total[:, 1:])
        within = total[:, np.minimum(self._log_bins + _SPREAD_BINS, last)] - total[:, :-1]
        enough = within >= np.ceil(needed).astype(np.int32)
        found = np.flatnonzero(enough.any(axis=1))
        total, begin = total[found], enough[found].argmax(axis=1)
        end = np.minimum(begin + _SPREAD_BINS, last)
        for _ in range(_MEDIAN_ROUNDS):
            at = _median_bin(total, begin, end)
            middle_bin = at.astype(np.intp)
            begin = np.maximum(middle_bin - _SPREAD_BINS, 0)
            end = np.minimum(middle_bin + _SPREAD_BINS + 1, last)
        upright_m = np.full(self._count, np.nan)
        upright_m[found] = _NEAREST_M * np.exp(_LOG_STEP * _median_bin(total, begin, end))
        return upright_m

    def _feet(self, xy: NDArray[np.float32]) -> Array:
        """Return the mean range (N,) of points (2, F) by bearing, NaN where there is none."""
        at = self._bearing_index(xy)
        count = np.bincount(at, minlength=self._count)
        total = np.bincount(at, np.hypot(xy[0], xy[1]), minlength=self._count)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    def _bearing_index(self, xy: NDArray[np.floating]) -> NDArray[np.intp]:
        bearing = np.arctan2(xy[1], xy[0])
        offset = (bearing - self._angle_min) / self._step
        return np.clip(np.rint(offset), 0, self._count - 1).astype(np.intp)

    def _polar_counts(self, xy: NDArray[np.float32]) -> NDArray[np.intp]:
        """Return how many points (2, M) lie at every bearing in bins of the same share of the
        range.
        """
        shape = self._count, len(self._log_bins)
        ranges = np.maximum(np.hypot(xy[0], xy[1]), _NEAREST_M)
        bins = (np.log(ranges * (1 / _NEAREST_M)) * (1 / _LOG_STEP)).astype(np.intp)
        near = bins < shape[1]
        return histogram(self._bearing_index(xy[:, near]), bins[near], shape)


def _median_bin(total: NDArray[np.int32], begin: NDArray[np.intp], end: NDArray[np.intp]) -> Array:
    """Return where, in bins (N,), half of what lies in the bins from begin to end (N,) is passed.

    total: (N, M + 1), how much lies in all bins before one.
    """
    rows = np.arange(len(total))
    half = 0.5 * (total[rows, begin] + total[rows, end])
    middle = (total[:, 1:] >= half[:, None]).argmax(axis=1)
    before, after = total[rows, middle], total[rows, middle + 1]
    return middle + (half - before) / np.maximum(after - before, 1.0)


def _floor_on_border(camera: StereoCamera, mount: Mount) -> Array:
    """Return where the rays along the image's left, right and lower border meet the floor, (N, 2)
    in the base's x-y plane.
    """
    columns, rows = np.arange(camera.width), np.arange(camera.height)
    borders = (columns, rows[-1]), (columns[0], rows), (columns[-1], rows)
    uv = np.hstack([np.broadcast_arrays(*border) for border in borders]).T.astype(np.float64)
    T_base_left = mount.T_base_left
    rays = camera.back_project(uv, np.ones(len(uv))) @ T_base_left[:3, :3].T
    rays = rays[rays[:, 2] < -1e-3]
    return T_base_left[:2, 3] + rays[:, :2] * (mount.height_m / -rays[:, 2:])


class OverheadMatcher:
    """Finds surfaces above the horizon and below the robot's height."""

    def __init__(
        self, camera: StereoCamera, num_disparities: int, settings: FloorSegmentationSettings
    ) -> None:
        self._camera, self._settings = camera, settings
        nearest_px = min(num_disparities, camera.disparity_times_depth / _SEEN_BEFORE_M)
        searched = math.ceil(nearest_px / (STEP_PX * SUBPIXEL)) * SUBPIXEL
        self._matcher = DisparityMatcher(searched, COARSE_BLOCK_PX, SPECKLE_PX // STEP_PX**2)

    def positions(self, pair: Pair, mount: Mount) -> NDArray[np.float32]:
        """Return where in the base's x-y plane something is in the way, (2, N), by the rows of a
        pair above those that can show floor; every fourth pixel at most tells. mount: of this
        frame.
        """
        camera, horizon_row = self._camera, pair.first_row
        reach = (self._settings.robot_height_m - mount.height_m) / _SEEN_BEFORE_M * camera.fy
        first = max(0, horizon_row - int(max(reach, 0.0))) // STEP_PX * STEP_PX
        last = first + (horizon_row - first) // STEP_PX * STEP_PX
        if last - first < RUN_UP_ROWS:
            return np.zeros((2, 0), np.float32)
        rows = slice(first, last)
        left, right = (shrunk_image(image[rows], STEP_PX) for image in (pair.left, pair.right))
        size = left.shape[::-1]
        if pair.measured is None:
            disparity = self._matcher.compute(left, right)
            # A slope along the row gets steeper as the image gets smaller.
            textured = texture_grey(left, _TEXTURE_WINDOW_PX) > STEP_PX * pair.enough
            known = (disparity > 0) & ~_fringes(disparity)
            certain = _with_boards(disparity, known, known & textured)
        else:
            disparity = shrunk(pair.measured[rows], size)
            certain = disparity > 0
        if pair.moving is not None:
            certain &= cv2.resize(pair.moving[rows], size, interpolation=cv2.INTER_NEAREST) == 0
        v, u = np.nonzero(certain)
        disparity_px = STEP_PX * disparity[v, u].astype(np.float64)
        centre = 0.5 * (STEP_PX - 1)
        uv_px = np.stack([STEP_PX * u + centre, STEP_PX * v + first + centre], axis=1)
        return self.in_the_way(uv_px, disparity_px, mount)

    def in_the_way(self, uv_px: Array, disparity_px: Array, mount: Mount) -> NDArray[np.float32]:
        """Return those of the pixels (N, 2) as positions (2, M) whose height concerns the robot."""
        camera, settings = self._camera, self._settings
        depth_m = camera.disparity_times_depth / disparity_px
        in_base = transform_points(mount.T_base_left, camera.back_project(uv_px, depth_m))
        height_m = in_base[:, 2]
        way = (height_m > settings.step_height_m) & (height_m < settings.robot_height_m)
        return in_base[way, :2].T.astype(np.float32)


def _with_boards(
    disparity: NDArray[np.float32], known: NDArray[np.bool_], certain: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return what is certain (H, W) and all of each board: above and below it
    something farther is seen. known: where the disparity counts.

    The edge and the grain of a board run along the rows and match anywhere. Its ends do not, and
    the matching carries their disparity along the board.
    """
    near = disparity * np.float32(1 - SAME_SURFACE_SHARE)
    farther = np.where(disparity > 0, disparity, np.float32(np.inf))
    board = known & (np.minimum.accumulate(farther, axis=0) < near)
    board &= np.minimum.accumulate(farther[::-1], axis=0)[::-1] < near
    for axis in (0, 1):
        step = np.abs(np.diff(disparity, axis=axis, prepend=0))
        board &= step <= SAME_SURFACE_SHARE * np.maximum(disparity, 1)
    count, label = cv2.connectedComponents(board.astype(np.uint8), connectivity=4)
    size = np.bincount(label[board], minlength=count)
    share = np.bincount(label[board & certain], minlength=count) / np.maximum(size, 1)
    found: NDArray[np.bool_] = certain | (board & (share >= _BOARD_SHARE)[label])
    return found


def _fringes(disparity: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which pixels (H, W) have a farther neighbour in their row: there the block that is
    matched still holds the nearer surface, which makes things wider than they are.
    """
    known = np.where(disparity > 0, disparity, np.float32(np.inf))
    farthest = cv2.erode(known, np.ones((1, 3), np.uint8))
    return farthest < disparity * np.float32(1 - SAME_SURFACE_SHARE)
