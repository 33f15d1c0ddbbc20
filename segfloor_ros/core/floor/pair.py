"""A rectified pair as floor is looked for in it, and its texture.

Texture, beyond the noise of the image, says where a disparity means something.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.model import is_disparity
from segfloor_ros.core.camera.pixels import Disparity, noise_grey, union
from segfloor_ros.core.contracts import MOVING, NO_EVIDENCE
from segfloor_ros.core.floor.disparity.matching import equal_exposure
from segfloor_ros.core.floor.disparity.profile import STEP_PX

_SIGMA_PX = 2.0
_MIN_TEXTURE_GREY = 0.2
"""Below this slope of the image along a row, per pixel, a disparity says nothing."""
_NOISE_TEXTURE = 0.1
"""Texture per grey level of noise that is surely no noise: its own is 0.04."""
TEXTURE_WINDOW_PX = 11
"""Over so wide a square texture is measured."""
EDGE_SLOPE = 24
"""Sobel response of the weakest edge that counts: 3 grey levels per row."""


@dataclass(frozen=True)
class Pair:
    """A pair as floor is looked for in it: `left`, `right` and `said` as in
    `FloorSegmentation.process`, where a depth camera has what a right one would see, and what it
    measured. moving: mask (H, W), 255 where what is seen does not count. part: of the image that
    can show floor, in the columns that are used, (R, W). noise_grey: of the left image. enough:
    texture that is no noise; texture: (R, W).
    """

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    measured: NDArray[np.float32] | None
    moving: NDArray[np.uint8] | None
    said: NDArray[np.uint8] | None
    part: tuple[slice, slice]
    noise_grey: float
    enough: float
    texture: NDArray[np.float32]

    @classmethod
    def of(
        cls,
        left: NDArray[np.uint8],
        right: NDArray[Any],
        moving: NDArray[np.uint8] | None,
        said: NDArray[np.uint8] | None,
        part: tuple[slice, slice],
    ) -> Pair:
        """Return a pair, or an image and its disparity, with the texture of its part."""
        measured = np.nan_to_num(right, nan=0.0) if is_disparity(right) else None
        right = equal_exposure(left, right) if measured is None else seen_from_right(left, right)
        if said is not None:
            moving = union(moving, np.where(said == MOVING, np.uint8(255), np.uint8(0)))
        left_rows = left[part[0]]
        noise = noise_grey(left_rows)
        enough = enough_texture(noise)
        texture = texture_grey(left_rows, TEXTURE_WINDOW_PX)[:, part[1]]
        if measured is not None:
            # Depth is measured on plain surfaces, too; a hole in it tells nothing.
            texture = np.where(measured[part] > 0, np.float32(100 * enough), np.float32(0))
        return cls(left, right, measured, moving, said, part, noise, enough, texture)

    @property
    def first_row(self) -> int:
        """The first row of the image that can show floor."""
        return int(self.part[0].start)

    @property
    def left_rows(self) -> NDArray[np.uint8]:
        """Whole rows of the left image, (R, image width)."""
        return self.left[self.part[0]]

    @cached_property
    def textured(self) -> NDArray[np.bool_]:
        """Where a disparity means something, (R, W)."""
        return self.texture > self.enough

    @cached_property
    def slope(self) -> NDArray[np.int16]:
        """`row_slope` of the left image, (R, W)."""
        return row_slope(self.left[self.part])

    @cached_property
    def picture_slope(self) -> NDArray[np.float32]:
        """How grey levels change from pixel to pixel, at half the resolution of the image."""
        return image_slope(self.left_rows)

    @property
    def said_there(self) -> NDArray[np.uint8] | None:
        """What a network says of the part, (R, W)."""
        return None if self.said is None else self.said[self.part]

    def without_hidden(self, mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return a mask (R, W) with no evidence where the left image shows nothing that counts."""
        hidden = np.False_ if self.moving is None else self.moving[self.part] > 0
        return np.where(hidden, np.uint8(NO_EVIDENCE), mask)


def texture_grey(image: NDArray[np.uint8], window_px: int) -> NDArray[np.float32]:
    """Return the mean absolute slope (H, W) along the row in grey levels per pixel.

    Slopes are taken on a scale of two pixels, where sensor noise has averaged out; only slopes
    along the row tell a stereo pair anything.
    """
    radius = int(3 * _SIGMA_PX)
    x = np.arange(-radius, radius + 1, dtype=np.float64)
    smooth = cv2.getGaussianKernel(len(x), _SIGMA_PX).ravel()
    slope = x * smooth
    slope /= (x * slope).sum()
    # sepFilter2D correlates: a positive slope gives a positive response.
    response = cv2.sepFilter2D(image, cv2.CV_32F, slope, smooth)
    return cv2.blur(np.abs(response), (window_px, window_px))


def enough_texture(noise_grey: float) -> float:
    """Return the texture, in grey levels per pixel, that is surely no noise."""
    return max(_MIN_TEXTURE_GREY, _NOISE_TEXTURE * noise_grey)


def row_slope(image: NDArray[np.uint8]) -> NDArray[np.int16]:
    """Return how steep the image (H, W) is from row to row, as Sobel's response: 8 times the grey
    levels per row.
    """
    smooth = cv2.GaussianBlur(image, (3, 5), 0)
    slope: NDArray[np.int16] = np.abs(
        cv2.Sobel(smooth, cv2.CV_16S, 0, 1, borderType=cv2.BORDER_REPLICATE)
    )
    return slope


def image_slope(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return how grey levels change from pixel to pixel of whole image rows (R, image width) at
    half the resolution in both directions.
    """
    smooth = cv2.blur(image, (5, 5))[::STEP_PX, ::STEP_PX]
    across = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8)
    along = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8)
    # cv2.magnitude rounds by where its arrays lie in memory, so from run to run.
    return np.sqrt(across * across + along * along)


def seen_from_right(left: NDArray[np.uint8], disparity: Disparity) -> NDArray[np.uint8]:
    """Return the right image (H, W) as the virtual right camera would see it: what is nearer hides
    what is farther; what no depth is known of is as in the left image.
    """
    right = left.copy()
    rows, columns = np.nonzero(np.isfinite(disparity))
    shift = disparity[rows, columns]
    order = np.argsort(shift, kind='stable')
    rows, columns = rows[order], columns[order]
    target = np.rint(columns - shift[order]).astype(np.intp)
    inside = target >= 0
    right[rows[inside], target[inside]] = left[rows[inside], columns[inside]]
    return right
