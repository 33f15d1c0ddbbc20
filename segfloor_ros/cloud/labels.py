"""What cloud labelling hands to the grid: the sparse cloud with a label per point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

UNKNOWN = 0
FLOOR = 1
OBSTACLE = 2


@dataclass(frozen=True)
class LabelledPoints:
    """The labelled cloud as arrays over points. point_id: (N,) int32 ascending. xyz_map: (N,
    3) float32, metres. label: (N,) uint8 of `UNKNOWN`, `FLOOR`, `OBSTACLE`. confidence: (N,)
    float32 in [0, 1], how sure the label is.
    """

    point_id: NDArray[np.int32]
    xyz_map: NDArray[np.float32]
    label: NDArray[np.uint8]
    confidence: NDArray[np.float32]
