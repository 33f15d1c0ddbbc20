"""ORB features spread over the image.

Rublee et al., ORB: an efficient alternative to SIFT or SURF (ICCV 2011). The strongest corners
alone would all lie on posters and shelves; the budget is dealt out over image cells instead, so
that the floor gets its share.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.slam.excluded import Region, is_inside
from segfloor_ros.slam.settings import StereoSlamSettings

OVERSAMPLING = 4
"""Corners detected per feature kept; the surplus is what the cells choose from."""

CELL_SIZE_PX = 16
"""Side of the image cells over which features are spread: about as many cells as features."""

PYRAMID_LEVELS = 8
PYRAMID_SCALE = 1.2
"""The pyramid of ORB as published: sizes up to 3.6 times as large are recognised."""


@dataclass(frozen=True)
class Features:
    """The features of one image: uv_px (N, 2) float32 at full resolution, octave (N,) uint8,
    descriptor (N, 32) uint8.
    """

    uv_px: NDArray[np.float32]
    octave: NDArray[np.uint8]
    descriptor: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.uv_px)

    def take(self, rows: NDArray[np.intp]) -> Features:
        """Return the chosen rows."""
        return Features(self.uv_px[rows], self.octave[rows], self.descriptor[rows])


class FeatureExtractor:
    """Detects oriented FAST corners on a pyramid and describes a spread selection of them."""

    def __init__(self, settings: StereoSlamSettings) -> None:
        self._budget = settings.num_features
        self._orb = cv2.ORB_create(
            nfeatures=OVERSAMPLING * settings.num_features,
            scaleFactor=PYRAMID_SCALE,
            nlevels=PYRAMID_LEVELS,
            edgeThreshold=19,
            fastThreshold=settings.fast_threshold,
        )

    def extract(self, image: NDArray[np.uint8], excluded: Region | None = None) -> Features:
        """Return the features of a grey image (H, W) outside of what is excluded."""
        corners = self._orb.detect(image, None)
        if excluded is not None and corners:
            inside = is_inside(excluded, cv2.KeyPoint_convert(corners))
            corners = [corner for corner, out in zip(corners, ~inside, strict=True) if out]
        if not corners:
            return Features(
                np.zeros((0, 2), np.float32), np.zeros(0, np.uint8), np.zeros((0, 32), np.uint8)
            )
        uv = cv2.KeyPoint_convert(corners)
        response = np.array([corner.response for corner in corners], np.float32)
        chosen = spread(uv, response, CELL_SIZE_PX, self._budget)
        kept, descriptor = self._orb.compute(image, [corners[i] for i in chosen])
        octave = np.array([corner.octave & 0xFF for corner in kept], np.uint8)
        uv = np.asarray(cv2.KeyPoint_convert(kept), np.float32).reshape(-1, 2)
        return Features(self._at_full_resolution(uv, octave, image), octave, np.asarray(descriptor))

    def _at_full_resolution(
        self, uv: NDArray[np.float32], octave: NDArray[np.uint8], image: NDArray[np.uint8]
    ) -> NDArray[np.float32]:
        """Return exact positions (N, 2). OpenCV multiplies a corner's place in its pyramid
        level by the nominal scale; but levels have whole sizes, and what scales is the
        distance from the image's outer edge, half a pixel before the first pixel's centre.
        """
        nominal = PYRAMID_SCALE ** octave.astype(np.float64)[:, None]
        size = np.array(image.shape[::-1], np.float64)
        level_size = np.rint(size / nominal)
        return (((uv / nominal) + 0.5) * (size / level_size) - 0.5).astype(np.float32)


def spread(
    uv_px: NDArray[np.float32], response: NDArray[np.float32], cell_px: int, budget: int
) -> NDArray[np.intp]:
    """Choose up to `budget` corners: first the best of every cell, then every cell's second,
    and so on.

    uv_px: (N, 2). response: (N,), larger is better. Returns ascending indices.
    """
    column, row = (uv_px // cell_px).astype(np.int64).T
    cell = row * (int(column.max()) + 1) + column
    strength = response.astype(np.float64)
    span = float(np.ptp(strength)) + 1.0  # one sort by two keys: much faster than lexsort
    order = np.argsort(cell * span - strength, kind='stable')
    sorted_cell = cell[order]
    first_of_cell = np.r_[0, np.flatnonzero(np.diff(sorted_cell)) + 1]
    run_start = np.zeros(len(order), np.int64)
    run_start[first_of_cell] = first_of_cell
    rank_in_cell = np.arange(len(order)) - np.maximum.accumulate(run_start)
    by_rank = np.argsort(rank_in_cell * span - strength[order], kind='stable')
    return np.sort(order[by_rank[:budget]])
