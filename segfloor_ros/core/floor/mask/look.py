"""How bright the floor is, and by how much what is seen differs from that.

A sun, a lamp, a lens and dust change the floor's brightness slowly: its logarithm is taken for a
quadratic of row and column. What is measured as floor may be a thing that is hardly higher: it is
fitted again without what stood out.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.floor.disparity.matching import BLOCK_PX, SIGMAS

_DIRT = 0.1
"""By such a share of its brightness a floor varies: dust, wear."""
_SAMPLED_PX, _FITS = 8, 4
"""Every such row and column, one independent of the other, tells how light falls on the floor; so
often it is asked."""
_FLAT = np.diag(np.array([1e-6, 1e-6, 1e-6, 1e-3, 1e-3, 1e-3], np.float32))


def unlike_floor(image: NDArray[np.uint8], floor: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which pixels of an image (R, W) are darker or brighter than nearly all of the floor
    (R, W) would be there.
    """
    grey = cv2.blur(image, (BLOCK_PX, BLOCK_PX)).astype(np.float32)
    return np.abs(sigmas_off_floor(grey, floor)) > SIGMAS


def sigmas_off_floor(
    grey: NDArray[np.float32], floor: NDArray[np.bool_], step: int = 1
) -> NDArray[np.float32]:
    """Return by how many standard deviations each pixel of a smooth image (R, W) is brighter than
    the floor (R, W) would be there; 0 where no floor is known. step: pixels of the camera from one
    of these to the next.
    """
    brightness = cv2.log(grey + 1)
    y, x = (np.linspace(-1, 1, size, dtype=np.float32) for size in grey.shape)
    every = _SAMPLED_PX // step
    part = np.s_[::every, ::every]
    rows, columns = np.nonzero(floor[part])
    if len(rows) == 0:
        return np.zeros_like(grey)
    terms = _quadratic(x[::every][columns], y[::every][rows])
    seen = brightness[part][rows, columns]
    counted = np.ones(len(rows), np.float32)
    for _ in range(_FITS):
        weighted = terms * counted
        weighted /= counted.sum()
        # A few pixels do not tell how it bends.
        bends = weighted @ terms.T + _FLAT
        light = np.linalg.solve(bends, weighted @ seen)
        squares = (seen - light @ terms) ** 2
        variance = float(squares @ counted) / float(counted.sum()) + _DIRT**2
        counted = (squares < SIGMAS**2 * variance).astype(np.float32)
    one, across, down, across2, both, down2 = light
    expected = (one + down * y + down2 * y * y)[:, None] + (across + both * y)[:, None] * x
    expected += across2 * x * x
    at = _quadratic(*(axis.ravel() for axis in np.meshgrid(x[::every], y[::every])))
    of_light = np.einsum('an,an->n', at, np.linalg.solve(bends, at)) / counted.sum()
    unsure = cv2.resize(1 + of_light.reshape(brightness[part].shape), grey.shape[::-1])
    # Grey levels are whole: no surface is known better.
    deviation = np.sqrt(np.float32(variance) * unsure + 1 / (grey + 1) ** 2)
    sigmas: NDArray[np.float32] = ((brightness - expected) / deviation).astype(np.float32)
    return sigmas


def _quadratic(x: NDArray[np.float32], y: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])
