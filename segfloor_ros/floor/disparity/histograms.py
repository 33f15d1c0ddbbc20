"""u- and v-disparity, and the removal of obstacles from the latter.

Labayrie, Aubert, Tarel, Real Time Obstacle Detection in Stereovision on Non Flat Road Geometry
Through V-disparity Representation (2002); Hu, Uchimura, U-V-Disparity (2005).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.floor.mask.view import FloorView
from segfloor_ros.floor.observation import VDisparity
from segfloor_ros.floor.settings import FloorSegmentationSettings

_RISE_PX = 1.0
"""Disparities are compared over as many rows as it takes a floor to rise by this."""
_RISE_TOLERANCE = 0.75


def u_disparity(bins: NDArray[np.intp], num_bins: int) -> NDArray[np.intp]:
    """Return how often each disparity bin occurs per column, (num_bins, W).

    bins: (H, W) disparity bin per pixel; bin 0 is `no match` and stays 0.
    """
    width = bins.shape[1]
    counts = np.bincount((bins * width + np.arange(width)).ravel(), minlength=num_bins * width)
    counts = counts[: num_bins * width].reshape(num_bins, width)
    counts[0] = 0
    return counts


def obstacle_rows(
    disparity_px: NDArray[np.floating] | NDArray[np.integer],
    height_m: float,
    rows_per_m_px: float,
    floor_rows_per_px: float,
) -> NDArray[np.float64]:
    """Return the count at which a u-disparity cell is an obstacle, per disparity.

    An upright surface of `height_m` covers `height_m * rows_per_m_px * d` rows (with
    rows_per_m_px = fy / (fx * baseline)). The floor itself puts `floor_rows_per_px` rows into
    each bin of one pixel, so the threshold never falls below twice that.
    """
    return np.maximum(height_m * rows_per_m_px * disparity_px, 2 * floor_rows_per_px + 2)


def v_disparity(
    rows: NDArray[np.intp],
    bins: NDArray[np.intp],
    shape: tuple[int, int],
) -> NDArray[np.intp]:
    """Return how often each disparity bin occurs per row, `shape` = (rows, bins).

    rows, bins: (N,) of the pixels that count.
    """
    index = rows * shape[1] + bins
    return np.bincount(index, minlength=shape[0] * shape[1])[: shape[0] * shape[1]].reshape(shape)


def rising(disparity: NDArray[np.float32], slope: float) -> NDArray[np.bool_]:
    """Tell where disparities (R, W) rise down the image as those of a floor do, (R, W).

    slope: of a level floor, in pixels per row. Upright surfaces do not rise; nor does floor of
    little texture, where semi-global matching prefers level steps.
    """
    half = math.ceil(_RISE_PX / slope / 2)
    rise = np.zeros_like(disparity)
    rise[half:-half] = disparity[2 * half :] - disparity[: -2 * half]
    return np.abs(rise / np.float32(2 * half * slope) - 1) < _RISE_TOLERANCE


def filtered_v_disparity(
    view: FloorView,
    disparity: NDArray[np.float32],
    textured: NDArray[np.bool_],
    num_disparities: int,
    bins_per_px: int,
    settings: FloorSegmentationSettings,
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
    limit = obstacle_rows(
        np.arange(num),
        settings.obstacle_height_m,
        camera.fy / (camera.fx * camera.baseline_m),
        1 / view.line.slope,
    )
    upright = u_disparity(bins, num) > limit[:, None]
    width = bins.shape[1]
    keep = (disparity > 0) & textured[:, ::2] & rising(disparity, view.line.slope)
    keep &= ~upright.take(bins * width + np.arange(width))
    at = np.flatnonzero(keep)
    rows, columns = np.divmod(at.astype(np.int32), np.int32(width))
    derolled = view.derolled[:, 0].take(rows) + (view.shear_px[::2] - view.shear_px[0]).take(
        columns
    )
    first = math.floor(float(view.derolled.min()))
    last = math.ceil(float(view.derolled.max()))
    rows = (derolled - np.float32(first - 0.5)).astype(np.intp)
    fine = (disparity.take(at) * np.float32(bins_per_px) + np.float32(0.5)).astype(np.intp)
    counts = v_disparity(rows, fine, (last - first + 1, num * bins_per_px))
    return VDisparity(counts * (2 * view.step), first, bins_per_px)
