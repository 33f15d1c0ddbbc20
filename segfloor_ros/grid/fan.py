"""The area between neighbouring bearings of a floor scan, on a raster."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array

SUBPIXEL_BITS = 4
_JUMP_SHARE = 0.15
"""Neighbouring bearings whose ranges differ by more than this share end at different things."""


@dataclass(frozen=True)
class Fan:
    """A star-shaped area around `centre` (x, y), in cells, seen from cell (0, 0)'s corner.

    Bearing i is first_rad + i * step_rad in the raster's axes, lengths: (S,), in cells. Where two
    neighbours end at different things, the area between them ends at the nearer one.
    """

    centre: Array
    first_rad: float
    step_rad: float
    lengths: Array

    def directions(self) -> Array:
        """Return the unit vectors (S, 2) of the bearings."""
        return unit_vectors(self.first_rad + self.step_rad * np.arange(len(self.lengths)))

    def draw(self, shape: tuple[int, ...]) -> NDArray[np.uint8]:
        """Return a raster (rows, columns) that is 1 where a cell's centre lies in the fan."""
        area = np.zeros(shape, np.uint8)
        if len(self.lengths) < 2:
            return area
        left, right = self._ends()
        outline = np.concatenate([np.zeros((1, 2)), np.stack([left, right], 1).reshape(-1, 2)])
        pixels = fixed_point(self.centre + outline)
        cv2.fillPoly(area, [pixels], 1, shift=SUBPIXEL_BITS)
        # Filled shapes include every cell their border passes through: decide those by centre.
        border = np.zeros(shape, np.uint8)
        cv2.polylines(border, [pixels], True, 1, shift=SUBPIXEL_BITS)
        row, column = np.nonzero(border)
        offset = np.stack([column + 0.5, row + 0.5], axis=1) - self.centre
        area[row, column] = self._contains(offset, left, right)
        return area

    def _ends(self) -> tuple[Array, Array]:
        """Return where the S - 1 wedges end at their first and at their second bearing."""
        directions = self.directions()
        first, second = self.lengths[:-1], self.lengths[1:]
        nearer = np.minimum(first, second)
        jump = np.abs(first - second) > _JUMP_SHARE * nearer
        left = np.where(jump, nearer, first)[:, None] * directions[:-1]
        right = np.where(jump, nearer, second)[:, None] * directions[1:]
        return left, right

    def _contains(self, offset: Array, left: Array, right: Array) -> NDArray[np.bool_]:
        """Tell which points (N, 2), relative to the centre, lie within their wedge."""
        bearing = np.arctan2(offset[:, 1], offset[:, 0]) - self.first_rad
        index = np.floor(np.remainder(bearing, 2 * np.pi) / self.step_rad).astype(np.intp)
        within = index < len(left)
        index = np.where(within, index, 0)
        edge = right[index] - left[index]
        inner = offset - left[index]
        return within & (edge[:, 0] * inner[:, 1] - edge[:, 1] * inner[:, 0] >= 0)


def unit_vectors(bearing_rad: Array) -> Array:
    """Return unit vectors (N, 2) of bearings (N,)."""
    return np.stack([np.cos(bearing_rad), np.sin(bearing_rad)], axis=1)


def fixed_point(xy_cells: Array) -> NDArray[np.int32]:
    """Return OpenCV's fixed-point coordinates of positions in cells; there, whole numbers are
    the centres of pixels.
    """
    return np.rint((xy_cells - 0.5) * (1 << SUBPIXEL_BITS)).astype(np.int32)
