"""The cells in which a keyframe sees something standing."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array
from segfloor_ros.grid.fan import SUBPIXEL_BITS, fixed_point
from segfloor_ros.grid.placing import PlacedEvidence


def draw_hits(free: NDArray[np.uint8], placed: PlacedEvidence) -> NDArray[np.uint8]:
    """Return a raster like `free` that is 1 in the cells that hold an obstacle.

    What is seen is an obstacle's near face. A cell that the face leaves mostly free stays free,
    and the cell behind it is the occupied one. Contacts without such a cell mark none; points
    hang above free floor then, and mark the cell below them.
    """
    hits = np.zeros_like(free)
    _draw_bands(hits, placed)
    hits[free > 0] = 0
    step = 0.5 * _outward(placed.points, placed.base)
    candidates = np.stack([placed.points, placed.points + step, placed.points + 2 * step], axis=1)
    column, row = candidates.astype(np.intp)
    choice = (free[row, column] == 0).argmax(axis=0)
    point = np.arange(len(choice))
    hits[row[choice, point], column[choice, point]] = 1
    return hits


def _draw_bands(hits: NDArray[np.uint8], placed: PlacedEvidence) -> None:
    """Mark what stands behind the faces: a cell, and what the error of the distance may add."""
    start, end = placed.contacts[:, ::2], placed.contacts[:, 1::2]
    if start.size == 0:
        return
    along = end - start
    num_along = int(np.abs(along).max()) + 2
    faces = start[:, :, None] + along[:, :, None] * np.linspace(0, 1, num_along)
    layers = np.arange(0.5, placed.thickness.max())
    depth = np.minimum(layers, placed.thickness[:, None] - 0.5)
    behind = _outward(start, placed.base)[:, :, None] * depth
    column, row = (faces[:, :, :, None] + behind[:, :, None, :]).astype(np.intp)
    hits[row, column] = 1


def draw_rays(raster: NDArray[np.uint8], base: Array, offset: Array, short: float) -> None:
    """Set the cells that rays from the base to base + offset (2, N) cross to 1.

    The rays end `short` cells before that.
    """
    length = np.sqrt((offset**2).sum(axis=0))
    ends = base[:, None] + offset * (np.maximum(length - short, 0) / np.maximum(length, 1e-9))
    lines = np.stack([np.broadcast_to(base[:, None], ends.shape), ends], axis=2)
    pixels = fixed_point(lines.reshape(2, -1)).reshape(-1, 2, 2)
    if len(pixels):
        cv2.polylines(raster, list(pixels), False, 1, shift=SUBPIXEL_BITS)


def _outward(positions: Array, base: Array) -> Array:
    """Return unit vectors (2, N) from the base to positions (2, N)."""
    offset = positions - base[:, None]
    return offset / np.maximum(np.sqrt((offset**2).sum(axis=0)), 1.0)
