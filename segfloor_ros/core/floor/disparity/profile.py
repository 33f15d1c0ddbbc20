"""The v-disparity of the pixels that can show floor, without what is upright, and the floor profile
that is fitted to it: floor disparity as a function of the image row, a uniform cubic B-spline.

Labayrade, Aubert, Tarel, Real Time Obstacle Detection in Stereovision on Non Flat Road Geometry
Through V-disparity Representation (2002); Hu, Uchimura, U-V-Disparity (2005); Wedel, Badino, Rabe,
Loose, Franke, Cremers, B-Spline Modeling of Road Surfaces With an Application to Free-Space
Estimation (2009).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.camera.pixels import SUBPIXEL
from segfloor_ros.core.contracts import Mount, VDisparity
from segfloor_ros.core.floor.disparity.matching import (
    COARSE_ABOVE_PX,
    NOISE_PX,
    RUN_UP_ROWS,
    SAME_PX,
)
from segfloor_ros.core.gauss_newton import gauss_newton
from segfloor_ros.core.geometry import Array

SEGMENTS = 5
_CONTROLS = SEGMENTS + 3
BINS_PER_PX = 2
PITCH_SIGMA_RAD, HEIGHT_SIGMA = 0.006, 0.01
"""How far pitch and height, as a share of it, may swing about the mount, one sigma."""
_LINE = ((2.7, 200.0), (1.8, 200.0))
_SPLINE = 2 * ((2.7, 0.02),) + 4 * ((1.8, 0.02),)
"""Width of Tukey's biweight in pixels, and how strongly the spline resists bending, by iteration: a
line, near the plane that is known, then a spline, which grows along the floor where that bends."""
_CORRELATED_PIXELS = 200.0
"""Neighbouring disparities err together: so many of them count as one measurement."""
_LEAST_SUPPORT = 1 / NOISE_PX**2
"""Less than one measurement says nothing about how a floor bends."""

_WIDE_PX = 480
"""Of wider images every other column is used: neighbours say the same."""

STEP_PX = 2
"""Every so many pixels of the image, in rows and columns, are compared, and filled, alike."""
_NEAR_M, _FAR_M = 0.05, 1000.0
"""Depths are between these."""

_OBSTACLE_M = 0.2
"""An upright surface of this height is taken out before the profile is fitted."""
_RISE_TOLERANCE = 0.75


@dataclass(frozen=True)
class FloorLine:
    """A plane floor in v-disparity: `d = slope * (v - horizon)` at the de-rolled row v.

    The de-rolled row of pixel (u, v) is `v + shear * (u - cx)`; a plane's disparity depends on it
    alone, whatever the roll. metres_per_row: a point with disparity d that lies one row above the
    floor's row of that disparity is `metres_per_row / d` metres above the floor.
    """

    slope: float
    horizon: float
    shear: float
    metres_per_row: float

    @classmethod
    def of(cls, camera: StereoCamera, mount: Mount) -> FloorLine:
        """Return the line of a plane floor seen from `mount`."""
        up = mount.up_in_camera
        scale = camera.disparity_times_depth
        return cls(
            slope=float(-up[1] / camera.fy * scale / mount.height_m),
            horizon=float(camera.cy - camera.fy * up[2] / up[1]),
            shear=float(up[0] / camera.fx * camera.fy / up[1]),
            metres_per_row=float(-up[1] / camera.fy * scale),
        )

    def rolled_rows(self, camera: StereoCamera) -> float:
        """Return how many rows lie between de-rolled rows and those of the image, at most."""
        return abs(self.shear) * max(camera.cx, camera.width - camera.cx)


def first_floor_row(camera: StereoCamera, mount: Mount) -> int:
    """Return the first row of the image that can show the floor, with a run-up for the matcher."""
    line = FloorLine.of(camera, mount)
    top = math.floor(line.horizon - line.rolled_rows(camera)) - RUN_UP_ROWS
    return int(np.clip(top, 0, max(0, camera.height - 2 * RUN_UP_ROWS)))


def last_fine_row(camera: StereoCamera, mount: Mount) -> int:
    """Return the last row in which the floor may be so far that it is matched in full."""
    line = FloorLine.of(camera, mount)
    last = line.horizon + COARSE_ABOVE_PX / line.slope + line.rolled_rows(camera)
    return int(np.clip(last, first_floor_row(camera, mount) + RUN_UP_ROWS, camera.height))


@dataclass(frozen=True)
class FloorProfile:
    """The fitted profile. line: the prior. first_row, rows: the de-rolled rows it is sampled on.

    disparity_px: (R,) float64 strictly increasing, at rows first_row, first_row + 1, ...
    support: number of pixels that carry the fit.
    """

    line: FloorLine
    first_row: float
    disparity_px: Array
    support: float

    @cached_property
    def _nodes(self) -> tuple[Array, Array]:
        """Rows and disparities between which the profile is straight; it goes on as the line."""
        rows = self.first_row + np.arange(len(self.disparity_px) + 1.0)
        rows[-1] += 1e5  # no floor is seen so far below the image
        last_px = self.disparity_px[-1] + self.line.slope * (rows[-1] - rows[-2])
        return rows, np.append(self.disparity_px, last_px)

    def at_rows(self, rows: Array | NDArray[np.integer]) -> Array:
        """Return the floor's disparity at de-rolled rows (…), NaN above the first row."""
        profile: Array = np.interp(rows, *self._nodes, left=np.nan)
        return profile

    def at_pixels(self, derolled: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the floor's disparity (R, W) at many de-rolled rows, 0 above the first."""
        first = math.floor(float(derolled.min()))
        whole = np.arange(first, math.floor(float(derolled.max())) + 2)
        by_row = np.nan_to_num(self.at_rows(whole)).astype(np.float32)
        offset = derolled - np.float32(first)
        index = offset.astype(np.intp)
        share = offset - index.astype(np.float32)
        return by_row[index] * (1 - share) + by_row[index + 1] * share

    def row_of_disparity(self, disparity_px: Array) -> Array:
        """Return the de-rolled row at which the floor has a disparity."""
        rows, nodes_px = self._nodes
        before_px = np.maximum(nodes_px[0] - disparity_px, 0)
        row: Array = np.interp(disparity_px, nodes_px, rows) - before_px / self.line.slope
        return row


def spline_basis(positions: NDArray[np.floating]) -> Array:
    """Return the basis (N, 8) of the uniform cubic B-spline of five segments over [0, 5]."""
    x = np.clip(np.asarray(positions, np.float64), 0.0, SEGMENTS)
    segment = np.minimum(x.astype(np.intp), SEGMENTS - 1)
    t = x - segment
    weights = np.stack(
        [(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3], axis=1
    )
    basis = np.zeros((len(x), _CONTROLS))
    basis[np.arange(len(x))[:, None], segment[:, None] + np.arange(4)] = weights / 6
    return basis


def fit_profile(v_disparity: VDisparity, line: FloorLine, camera: StereoCamera) -> FloorProfile:
    """Fit the spline to a filtered v-disparity by iteratively reweighted least squares.

    Tukey's biweight; first as a line, then as a spline that grows along a floor that bends.
    The result rises strictly with the row and is never above the line's horizon.
    """
    counts, first_row = v_disparity.counts, v_disparity.first_row
    rows, bins = pixels_where(counts > 0)
    disparity = bins / v_disparity.bins_per_px
    height = counts.shape[0]
    start = np.clip(line.horizon, first_row, first_row + height - 1)
    to_position = SEGMENTS / max(first_row + height - 1 - start, 1.0)
    below = rows + first_row >= start
    rows, bins, disparity = rows[below], bins[below], disparity[below]
    basis = spline_basis((rows + first_row - start) * to_position)
    weight = counts[rows, bins] / (_CORRELATED_PIXELS * NOISE_PX**2)
    # The control points of a straight line lie on it, at their own abscissae.
    abscissae = start + (np.arange(_CONTROLS) - 1) / to_position
    prior = line.slope * (abscissae - line.horizon)
    information = _prior_information(prior, line, camera)
    bend = np.diff(np.eye(_CONTROLS), n=2, axis=0)

    def linearise(controls: Array, stage: tuple[float, float]) -> tuple[Array, Array, float]:
        width_px, stiffness = stage
        ratio = np.clip((disparity - basis @ controls) / width_px, -1, 1)
        robust = weight * (1 - ratio**2) ** 2
        known = information + stiffness * bend.T @ bend
        weighted = basis.T * robust
        gradient = weighted @ (disparity - basis @ controls) + known @ (prior - controls)
        return weighted @ basis + known, gradient, float(robust.sum())

    controls, _, support = gauss_newton(prior, linearise, _LINE, np.add)
    if support >= _LEAST_SUPPORT:
        controls, _, support = gauss_newton(controls, linearise, _SPLINE, np.add)
    controls = np.maximum.accumulate(controls)
    grid = np.arange(np.ceil(start), first_row + height)
    values = spline_basis((grid - start) * to_position) @ controls
    values = np.maximum(values, 0) + 1e-6 * np.arange(len(grid))
    return FloorProfile(line, float(grid[0]), values, support)


def _prior_information(prior: Array, line: FloorLine, camera: StereoCamera) -> Array:
    """Return the information (8, 8) that the mount gives on the control points.

    The pitch shifts the line, the height scales it.
    """
    jacobian = np.zeros((2, _CONTROLS))
    jacobian[0, 0] = 1 / (line.slope * camera.fy * PITCH_SIGMA_RAD)
    jacobian[1, [0, -1]] = np.array([-1.0, 1.0]) / (HEIGHT_SIGMA * (prior[-1] - prior[0]))
    return jacobian.T @ jacobian


def pixels_where(picture: NDArray[np.bool_]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return rows and columns (N,) of the pixels that are set, as np.nonzero does; faster."""
    at = np.flatnonzero(picture).astype(np.int32)
    rows, columns = np.divmod(at, np.int32(picture.shape[1]))
    return rows, columns


@dataclass(frozen=True)
class FloorView:
    """The image rows that can show floor, as seen with the mount of this very frame.

    first_row: image row of the first one. step: of the columns. columns: (W,) float32, their
    image columns. shear_px: (W,) float32, what de-rolling adds to the rows of a column.
    derolled: (R, W) float32, the de-rolled rows. Pixels of the view are (row, column) of these.
    """

    camera: StereoCamera
    mount: Mount
    line: FloorLine
    first_row: int
    step: int
    columns: NDArray[np.float32]
    shear_px: NDArray[np.float32]
    derolled: NDArray[np.float32]

    @classmethod
    def of(cls, camera: StereoCamera, mount: Mount, first_row: int) -> FloorView:
        """Return the view from `mount` of the rows from `first_row` on."""
        line = FloorLine.of(camera, mount)
        step = column_step(camera)
        columns = np.arange(0, camera.width, step, dtype=np.float32)
        shear = (line.shear * (columns - camera.cx)).astype(np.float32)
        rows = np.arange(first_row, camera.height, dtype=np.float32)
        return cls(camera, mount, line, first_row, step, columns, shear, rows[:, None] + shear)

    @cached_property
    def half(self) -> tuple[slice, slice]:
        """Every other row and column of the image, as a part of the view."""
        return np.s_[::STEP_PX, :: STEP_PX // self.step]

    def positions(
        self,
        rows: NDArray[np.number],
        columns: NDArray[np.integer],
        disparity_px: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Return where pixels of known disparity (N,) are in the base's x-y plane, (2, N)."""
        camera, T_base_left = self.camera, self.mount.T_base_left[:2].astype(np.float32)
        x = (self.columns[columns] - np.float32(camera.cx)) / np.float32(camera.fx)
        y = ((rows + (self.first_row - camera.cy)) / camera.fy).astype(np.float32)
        right, down, ahead, offset = np.split(T_base_left, 4, axis=1)
        depth = np.float32(camera.disparity_times_depth) / disparity_px
        return (right * x + down * y + ahead) * depth + offset

    def pixels_of_profile(
        self, xy_base: NDArray[np.float32], profile: FloorProfile
    ) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.floating]]:
        """Return the view's rows and columns (N,) of positions (2, N) on the floor as it bends,
        and its disparity there (N,); negative columns where they are behind the camera.
        """
        camera, T_base_left = self.camera, self.mount.T_base_left.astype(np.float32)
        R, t = T_base_left[:3, :3], T_base_left[:3, 3]
        dx, dy = xy_base[0] - t[0], xy_base[1] - t[1]
        x, depth = (R[0, i] * dx + R[1, i] * dy - R[2, i] * t[2] for i in (0, 2))
        depth = np.where(depth < _NEAR_M, np.float32(2 * _FAR_M), depth)  # or behind the camera
        disparity = np.float32(camera.disparity_times_depth) / depth
        u = x / depth * np.float32(camera.fx) + np.float32(camera.cx)
        steps = np.arange(0, int(disparity.max() * SUBPIXEL) + 2)
        row_of = profile.row_of_disparity(steps / SUBPIXEL).astype(np.float32)
        derolled = row_of[(disparity * np.float32(SUBPIXEL) + np.float32(0.5)).astype(np.int32)]
        v = derolled - np.float32(self.line.shear) * (u - np.float32(camera.cx)) - self.first_row
        columns = np.rint(u / np.float32(self.step))
        columns[depth > _FAR_M] = -1
        return np.rint(v).astype(np.int32), columns.astype(np.int32), disparity


def column_step(camera: StereoCamera) -> int:
    """Return which columns of the image are used: every one, or every other."""
    return 2 if camera.width > _WIDE_PX else 1


def surface_above(
    disparity: NDArray[np.float32],
    counted: NDArray[np.float32],
    window_px: tuple[int, int],
    gap_rows: int,
) -> tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.floating]]:
    """Return mean and variance of the disparities (R, W) of what stands right above each pixel, and
    the share of it that counts, each (R, W).

    counted: 1 where a disparity counts, else 0. window_px: columns and rows of the surface, which
    ends `gap_rows` above the pixel: below that the matcher mixes it with what it stands on.
    """
    columns, rows = window_px

    def mean_above(values: NDArray[np.float32]) -> NDArray[np.float32]:
        above = np.zeros_like(values)
        above[gap_rows:] = cv2.blur(values, window_px, anchor=(columns // 2, rows - 1))[:-gap_rows]
        return above

    share = mean_above(counted)
    safe = np.maximum(share, np.float32(1e-6))
    mean = mean_above(counted * disparity) / safe
    return mean, mean_above(counted * disparity**2) / safe - mean**2, share


def histogram(
    rows: NDArray[np.integer], columns: NDArray[np.integer], shape: tuple[int, int]
) -> NDArray[np.intp]:
    """Return how often each cell of a picture of `shape` is among rows and columns (…), which are
    broadcast; none lies outside.
    """
    cells = np.ravel(rows * shape[1] + columns)
    return np.bincount(cells, minlength=shape[0] * shape[1]).reshape(shape)


def obstacle_rows(
    disparity_px: Array, height_m: float, rows_per_m_px: float, floor_rows_per_px: float
) -> Array:
    """Return the count at which a u-disparity cell is an obstacle, per disparity.

    An upright surface of `height_m` covers `height_m * rows_per_m_px * d` rows (with
    rows_per_m_px = fy / (fx * baseline)). The floor itself puts `floor_rows_per_px` rows into
    each bin of one pixel, so the threshold never falls below twice that.
    """
    return np.maximum(height_m * rows_per_m_px * disparity_px, 2 * floor_rows_per_px + 2)


def growth(disparity: NDArray[np.float32], half: int) -> NDArray[np.float32]:
    """Return by how much disparities (R, W) grow from `half` rows above each pixel to as many below
    it, NaN at the upper and lower end.
    """
    grown = np.full_like(disparity, np.nan)
    grown[half:-half] = disparity[2 * half :] - disparity[: -2 * half]
    return grown


def rising(disparity: NDArray[np.float32], slope: float) -> NDArray[np.bool_]:
    """Tell where disparities (R, W) rise down the image as those of a floor do, (R, W).

    They are compared over as many rows as it takes a floor to rise by more than noise.

    slope: of a level floor, in pixels per row. Upright surfaces do not rise; nor does floor of
    little texture, where semi-global matching prefers level steps.
    """
    half = math.ceil(SAME_PX / slope / 2)
    return is_rise(growth(disparity, half) / np.float32(2 * half), slope)


def is_rise(rise: NDArray[np.floating], slope: float) -> NDArray[np.bool_]:
    """Return which of how much disparities grow per row are, more or less, a floor's `slope`."""
    return np.abs(rise / slope - 1) < _RISE_TOLERANCE


def filtered_v_disparity(
    view: FloorView,
    disparity: NDArray[np.float32],
    textured: NDArray[np.bool_],
    num_disparities: int,
) -> VDisparity:
    """Return the v-disparity of what is textured and not upright."""
    camera = view.camera
    # Half of the columns tell as much.
    disparity = np.ascontiguousarray(disparity[:, ::2])
    # What is nearer than any floor counts as if it were right before it: measured depth has no end.
    nearest = np.float32(num_disparities)
    disparity = np.minimum(disparity, nearest)
    bins = (disparity + np.float32(0.5)).astype(np.intp)
    num = num_disparities + 1
    rows_per_m_px = camera.fy / (camera.fx * camera.baseline_m)
    limit = obstacle_rows(np.arange(float(num)), _OBSTACLE_M, rows_per_m_px, 1 / view.line.slope)
    across = np.arange(bins.shape[1])
    upright = histogram(bins, across, (num, len(across))) > limit[:, None]
    upright[0] = False  # no match
    keep = (disparity > 0) & textured[:, ::2] & rising(disparity, view.line.slope)
    keep &= ~upright.take(bins * len(across) + across)
    rows, columns = pixels_where(keep)
    fine = (disparity[keep] * np.float32(BINS_PER_PX) + np.float32(0.5)).astype(np.intp)
    shear_px = (view.shear_px[::2] - view.shear_px[0]).take(columns)
    derolled = view.derolled[:, 0].take(rows) + shear_px
    first = math.floor(float(view.derolled.min()))
    last = math.ceil(float(view.derolled.max()))
    rows = (derolled - np.float32(first - 0.5)).astype(np.intp)
    counts = histogram(rows, fine, (last - first + 1, num * BINS_PER_PX))
    return VDisparity(counts * (2 * view.step), first, BINS_PER_PX)
