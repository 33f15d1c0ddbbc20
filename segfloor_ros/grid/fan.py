"""The area between neighbouring bearings of a floor scan, on a raster."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.floor.observation import SAME_SURFACE_SHARE
from segfloor_ros.geometry import Array

SUBPIXEL_BITS = 4
_SLANT_STEPS = 3
_MAX_SLANT = 4.0


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
        """Tell which bearings (S,) bound the fan: the outermost ones, and those that see past
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
        """Tell which points (N,), (N,), relative to the centre, lie within their wedge."""
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
