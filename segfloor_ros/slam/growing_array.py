"""An array that grows."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


class GrowingArray:
    """An array that grows along its first axis; appending is amortised constant time."""

    def __init__(self, row_shape: tuple[int, ...], dtype: type) -> None:
        self._buffer: NDArray[Any] = np.zeros((1024, *row_shape), dtype)
        self._length = 0

    @property
    def rows(self) -> NDArray[Any]:
        """A view of the rows in use; writing to it writes to the array."""
        return self._buffer[: self._length]

    def extend(self, rows: NDArray[Any]) -> None:
        """Append rows (N, ...)."""
        needed = self._length + len(rows)
        if needed > len(self._buffer):
            grown = np.zeros(
                (max(needed, 2 * len(self._buffer)), *self._buffer.shape[1:]), self._buffer.dtype
            )
            grown[: self._length] = self.rows
            self._buffer = grown
        self._buffer[self._length : needed] = rows
        self._length = needed

    def lengthen(self, count: int) -> None:
        """Append rows of zeros."""
        self.extend(np.zeros((count, *self._buffer.shape[1:]), self._buffer.dtype))

    def keep(self, chosen: NDArray[np.bool_]) -> None:
        """Drop the rows that are not chosen (N,)."""
        kept = self.rows[chosen]
        self._buffer[: len(kept)] = kept
        self._length = len(kept)
