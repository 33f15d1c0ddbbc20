"""The cells in which a keyframe sees something standing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array
from segfloor_ros.grid.placing import PlacedEvidence

_RAY_STEP = 0.25
"""Cells between two samples of a ray."""


def draw_hits(free: NDArray[np.uint8], placed: PlacedEvidence) -> NDArray[np.uint8]:
    """Return a raster like `free` that is 1 in the cells that hold an obstacle.

    What is seen is an obstacle's near face. A cell that the face leaves mostly free stays free,
    and the cell behind it is the occupied one. Contacts without such a cell mark none; points
    hang above free floor then, and mark the cell below them.
    """
    hits = np.zeros_like(free)
    draw_bands(hits, placed, placed.thickness)
    hits &= 1 - free
    step = 0.5 * placed.outward
    num = placed.faces.shape[1]
    candidates = np.empty((2, 3, num))
    candidates[:, 0], candidates[:, 1] = placed.faces, placed.faces + step
    candidates[:, 2] = candidates[:, 1] + step
    column, row = candidates.astype(np.intp)
    cell = row * free.shape[1] + column
    solid = free.ravel()[cell] == 0
    # Of cells without a solid one the first, which is the cell itself, is chosen.
    chosen = cell[solid.argmax(axis=0), np.arange(num)]
    marks = solid.any(axis=0)
    marks[len(placed.thickness) :] = True
    hits.ravel()[chosen[marks]] = 1
    return hits


def draw_bands(raster: NDArray[np.uint8], placed: PlacedEvidence, thickness: Array) -> None:
    """Set the cells behind the faces to 1, up to a depth (C,) in cells."""
    num = len(thickness)
    if num == 0:
        return
    start, outward = placed.faces[:, :num], placed.outward[:, :num]
    along = placed.ends - start
    num_along = int(np.abs(along).max()) + 2
    share = np.arange(num_along) * (1 / (num_along - 1))
    lines = start[:, :, None] + along[:, :, None] * share
    layers = np.arange(0.5, thickness.max())
    behind = outward[:, :, None] * np.minimum(layers, thickness[:, None] - 0.5)
    column, row = (lines[:, :, :, None] + behind[:, :, None, :]).astype(np.intp)
    raster[row, column] = 1


def draw_rays(raster: NDArray[np.uint8], base: Array, offset: Array, short: float) -> None:
    """Set the cells that rays from the base to base + offset (2, N) cross to 1.

    The rays end `short` cells before that. (OpenCV's lines begin and end in the middle of cells.)
    """
    length = np.maximum(np.sqrt((offset**2).sum(axis=0)) - short, 0)
    if len(length) == 0:
        return
    along = np.arange(0, length.max() + _RAY_STEP, _RAY_STEP)
    direction = offset / np.maximum(np.sqrt((offset**2).sum(axis=0)), 1e-9)
    distance = np.minimum(along, length[:, None])
    column, row = (base[:, None, None] + direction[:, :, None] * distance).astype(np.intp)
    raster[row, column] = 1
