"""The floor profile: floor disparity as a function of the image row, a uniform cubic B-spline.

Wedel, Badino, Rabe, Loose, Franke, Cremers, B-Spline Modeling of Road Surfaces With an
Application to Free-Space Estimation (2009).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.model import Mount, StereoCamera
from segfloor_ros.floor.disparity.matching import NOISE_PX
from segfloor_ros.floor.observation import VDisparity
from segfloor_ros.geometry import Array

SEGMENTS = 5
_CONTROLS = SEGMENTS + 3
BINS_PER_PX = 2
PITCH_SIGMA_RAD, HEIGHT_SIGMA = 0.006, 0.01
"""How far pitch and height, as a share of it, may swing about the mount, one sigma."""
_SCALE_PX = 0.6
"""Scale of the M-estimator."""
_STIFFNESS = 0.02
"""How strongly the spline resists bending."""
_SCHEDULE = (
    ((1.5, 1e4), (1.0, 1e4))  # a line, near the plane that is known
    + 2 * ((1.5, 1.0),)  # a spline, which grows along the floor where that bends
    + 4 * ((1.0, 1.0),)
)
"""Scale of the estimator and stiffness of the spline, relative to the settings, by iteration."""
_LINE_ITERATIONS = 2
_CORRELATED_PIXELS = 200.0
"""Neighbouring disparities err together: so many of them count as one measurement. What
is less says nothing about how a floor bends."""


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

    def at_rows(self, rows: Array | NDArray[np.integer]) -> Array:
        """Return the floor's disparity at de-rolled rows, NaN above the first row."""
        row = np.asarray(rows, np.float64)
        end = self.first_row + len(self.disparity_px) - 1
        grid = self.first_row + np.arange(len(self.disparity_px))
        values = np.interp(row, grid, self.disparity_px)
        values += np.maximum(row - end, 0) * self.line.slope
        profile: Array = np.where(row < self.first_row, np.nan, values).astype(np.float64)
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

    def row_of_disparity(self, disparity_px: NDArray[np.floating]) -> Array:
        """Return the de-rolled row at which the floor has a disparity."""
        d = np.asarray(disparity_px, np.float64)
        grid = self.first_row + np.arange(len(self.disparity_px))
        rows = np.interp(d, self.disparity_px, grid)
        rows += np.maximum(d - self.disparity_px[-1], 0) / self.line.slope
        return rows - np.maximum(self.disparity_px[0] - d, 0) / self.line.slope


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
    start = max(float(first_row), line.horizon)
    to_position = SEGMENTS / max(first_row + height - 1 - start, 1.0)
    below = rows + first_row >= start
    rows, bins, disparity = rows[below], bins[below], disparity[below]
    basis = spline_basis((rows + first_row - start) * to_position)
    weight = counts[rows, bins] / (_CORRELATED_PIXELS * NOISE_PX**2)
    # The control points of a straight line lie on it, at their own abscissae.
    abscissae = start + (np.arange(_CONTROLS) - 1) / to_position
    prior = line.slope * (abscissae - line.horizon)
    information = _prior_information(prior, line, camera)
    controls = prior.copy()
    bend = np.diff(np.eye(_CONTROLS), n=2, axis=0)
    scale = _SCALE_PX
    support = 0.0
    for iteration, (factor, stiffness) in enumerate(_SCHEDULE):
        if iteration == _LINE_ITERATIONS and support * NOISE_PX**2 < 1:
            break
        residual = disparity - basis @ controls
        ratio = np.clip(residual / (3 * factor * scale), -1, 1)
        robust = weight * (1 - ratio**2) ** 2
        normal = basis.T @ (basis * robust[:, None]) + information
        normal += _STIFFNESS * stiffness * bend.T @ bend
        controls = prior + np.linalg.solve(normal, basis.T @ (robust * (disparity - basis @ prior)))
        support = float(robust.sum())
    controls = np.maximum.accumulate(controls)
    grid = np.arange(np.ceil(start), first_row + height)
    values = spline_basis((grid - start) * to_position) @ controls
    values = np.maximum(values, 0) + 1e-6 * np.arange(len(grid))
    return FloorProfile(line, float(grid[0]), values, support)


def _prior_information(prior: Array, line: FloorLine, camera: StereoCamera) -> Array:
    """Return the information (8, 8) that the mount gives on the control points.

    The pitch shifts the line, the height scales it.
    """
    ends = np.array([0, _CONTROLS - 1])
    jacobian = np.zeros((2, _CONTROLS))
    jacobian[0, ends[0]] = 1.0
    jacobian[1, ends] = (-1.0, 1.0)
    sigma = np.array(
        [line.slope * camera.fy * PITCH_SIGMA_RAD, HEIGHT_SIGMA * float(prior[-1] - prior[0])]
    )
    scaled = jacobian / sigma[:, None]
    return scaled.T @ scaled


def pixels_where(picture: NDArray[np.bool_]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return rows and columns (N,) of the pixels that are set, as np.nonzero does; faster."""
    at = np.flatnonzero(picture).astype(np.int32)
    rows, columns = np.divmod(at, np.int32(picture.shape[1]))
    return rows, columns
