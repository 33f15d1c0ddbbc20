"""The normal equations of a bundle adjustment of many keyframes, most of which share no point.

As in `normal_equations`, but the complement is a sparse matrix (Konolige, Sparse Sparse Bundle
Adjustment, BMVC 2010).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from segfloor_ros.geometry import Array


def solve_complement(
    U: Array,
    Y: Array,
    starts: NDArray[np.intp],
    point: NDArray[np.intp],
    y: Array,
    rhs: Array,
    between: tuple[tuple[int, int, Array], ...],
) -> tuple[Array, Array, Array]:
    """Solve (U - Y Y^T) x = rhs - Y y for several right-hand sides (..., R).

    U: (K, 6, 6), Y: (M, 6, 3) by blocks, those of camera k from starts[k] to starts[k + 1], point:
    (M,) their columns. y: (P, 3, R), rhs: (K, 6, R). between: further blocks off the diagonal.
    Returns x (6 K, R), the right-hand side (6 K, R) and y - Y^T x (P, 3, R).
    """
    count, size = len(U), y.shape[0]
    blocks = sparse.bsr_array((Y, point, starts), shape=(6 * count, 3 * size))
    S = sparse.bsr_array((U, np.arange(count), np.arange(count + 1)), shape=(6 * count,) * 2)
    S = S - blocks @ blocks.T
    if between:
        j, k = (np.array([link[side] for link in between]) for side in (0, 1))
        tied = np.stack([link[2] for link in between])
        rows = (6 * j[:, None, None] + np.arange(6)[:, None] + np.zeros(6, int)).ravel()
        columns = (6 * k[:, None, None] + np.zeros((6, 1), int) + np.arange(6)).ravel()
        off = sparse.coo_array((tied.ravel(), (rows, columns)), shape=S.shape)
        S = S + off + off.T
    flat = y.reshape(3 * size, -1)
    reduced = rhs.reshape(6 * count, -1) - blocks @ flat
    x = splu(S.tocsc()).solve(reduced)
    return x, reduced, (flat - blocks.T @ x).reshape(y.shape)
