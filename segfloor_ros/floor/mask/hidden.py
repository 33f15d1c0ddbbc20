"""What of an image does not count: what moves, and the border that rectification leaves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.images import matched_in
from segfloor_ros.floor.observation import NO_EVIDENCE


def drop_hidden(
    disparity: NDArray[np.float32],
    hidden: NDArray[np.uint8] | None,
    hidden_right: NDArray[np.uint8] | None,
) -> None:
    """Set disparities (H, W) to 0 where either image shows nothing that counts."""
    if hidden is not None:
        disparity[hidden > 0] = 0
    if hidden_right is not None:
        disparity[matched_in(hidden_right, disparity)] = 0


def clear_hidden(
    mask: NDArray[np.uint8], hidden: NDArray[np.uint8] | None, columns: tuple[slice, slice]
) -> None:
    """Set a mask of the view to no evidence where the left image shows nothing that counts."""
    if hidden is not None:
        mask[hidden[columns] > 0] = NO_EVIDENCE
