"""Stretches of pixels along the rows of a picture, and the pixels of a picture by number.

There are far fewer stretches than pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Runs:
    """The stretches of a picture of `shape` (R, W): row, first column and the column after the
    last one, each (N,) intp, in the order of the pixels.
    """

    shape: tuple[int, int]
    row: NDArray[np.intp]
    first: NDArray[np.intp]
    stop: NDArray[np.intp]

    @classmethod
    def of(cls, picture: NDArray[np.bool_]) -> Runs:
        """Return the stretches of a picture (R, W) bool."""
        height, width = picture.shape
        apart = np.zeros(height * (width + 1) + 1, np.bool_)
        apart[:-1].reshape(height, width + 1)[:, 1:] = picture
        edges = np.flatnonzero(apart[1:] != apart[:-1]) + 1
        row, first = np.divmod(edges[::2], width + 1)
        first -= 1
        return cls((height, width), row, first, first + edges[1::2] - edges[::2])

    def before(self, values: NDArray[np.uint8], outside: int) -> NDArray[np.uint8]:
        """Return the values (R, W) of the pixels right before the stretches, (N,)."""
        found = values[self.row, np.maximum(self.first - 1, 0)]
        return np.where(self.first > 0, found, np.uint8(outside))

    def after(self, values: NDArray[np.uint8], outside: int) -> NDArray[np.uint8]:
        """Return the values (R, W) of the pixels right after the stretches, (N,)."""
        last = self.shape[1] - 1
        found = values[self.row, np.minimum(self.stop, last)]
        return np.where(self.stop <= last, found, np.uint8(outside))

    def painted(self, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return the picture (R, W) of the chosen ones (N,) of the stretches."""
        height, width = self.shape
        start = self.row[chosen] * width + self.first[chosen]
        length = self.stop[chosen] - self.first[chosen]
        edges = np.zeros(2 * len(start) + 2, np.intp)
        edges[1:-1:2], edges[2:-1:2], edges[-1] = start, start + length, height * width
        inside = np.arange(len(edges) - 1) % 2 == 1
        return np.repeat(inside, np.diff(edges)).reshape(height, width)


def pixels_where(picture: NDArray[np.bool_]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return rows and columns (N,) of the pixels that are set, as np.nonzero does; faster."""
    at = np.flatnonzero(picture).astype(np.int32)
    rows, columns = np.divmod(at, np.int32(picture.shape[1]))
    return rows, columns
