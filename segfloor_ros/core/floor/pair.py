"""A rectified pair as floor is looked for in it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.camera.pixels import noise_grey
from segfloor_ros.core.contracts import NO_EVIDENCE
from segfloor_ros.core.floor.disparity.matching import stereo_view
from segfloor_ros.core.floor.mask.pixel_evidence import (
    TEXTURE_WINDOW_PX,
    enough_texture,
    row_slope,
    texture_grey,
)

_PLAIN_TO_SEE = 100.0
"""Texture of what a depth camera measured, over what is no noise."""


@dataclass(frozen=True)
class Pair:
    """A pair as floor is looked for in it: `left`, `right`, `moving` and `said` as in
    `FloorSegmentation.process`, where a depth camera has what a right one would see, and what it
    measured. part: of the image that can show floor, in the columns that are used, (R, W).
    noise_grey: of the left image. enough: texture that is no noise; texture: (R, W).
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
        right, measured = stereo_view(left, right)
        left_rows = left[part[0]]
        noise = noise_grey(left_rows)
        enough = enough_texture(noise)
        texture = texture_grey(left_rows, TEXTURE_WINDOW_PX)[:, part[1]]
        if measured is not None:
            # Depth is measured on plain surfaces, too; a hole in it tells nothing.
            plain = np.float32(_PLAIN_TO_SEE * enough)
            texture = np.where(measured[part] > 0, plain, np.float32(0))
        return cls(left, right, measured, moving, said, part, noise, enough, texture)

    @property
    def first_row(self) -> int:
        """The first row of the image that can show floor."""
        return int(self.part[0].start)

    @property
    def left_rows(self) -> NDArray[np.uint8]:
        """Whole rows of the left image, (R, image width)."""
        return self.left[self.part[0]]

    @property
    def right_rows(self) -> NDArray[np.uint8]:
        """Whole rows of the right image, (R, image width)."""
        return self.right[self.part[0]]

    @cached_property
    def textured(self) -> NDArray[np.bool_]:
        """Where a disparity means something, (R, W)."""
        return self.texture > self.enough

    @cached_property
    def slope(self) -> NDArray[np.int16]:
        """`row_slope` of the left image, (R, W)."""
        return row_slope(self.left[self.part])

    @property
    def said_there(self) -> NDArray[np.uint8] | None:
        """What a network says of the part, (R, W)."""
        return None if self.said is None else self.said[self.part]

    def without_hidden(self, mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return a mask (R, W) with no evidence where the left image shows nothing that counts."""
        hidden = np.False_ if self.moving is None else self.moving[self.part] > 0
        return np.where(hidden, np.uint8(NO_EVIDENCE), mask)
