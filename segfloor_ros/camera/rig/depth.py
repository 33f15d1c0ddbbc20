"""Whether measured depth belongs to its image, by edges: things end in the depth where they end in
the image. The edges of the depth are laid over those of the image, shifted, larger or smaller, and
moved as the image moved within a lag: where they fit best is how depth and image lie to each other,
in space and in time.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array

WIDTH_PX = 320
"""Images are shrunk to about this width."""

REACH_PX = 16
SCALES = (0.92, 0.96, 1.0, 1.04, 1.08)
LAGS = (-2.0, -1.0, 0.0, 1.0, 2.0)
"""What is tried: shifts of shrunk pixels, sizes, and lags in frames."""

BESIDE_PX = 2
"""Edges of depth are off by so much in a camera that is aligned: holes lie beside them."""

STEP_RATIO = 1.15
"""Two disparities of one surface differ by less from pixel to pixel."""

NOWHERE_PX = 1e6
"""Disparity that nothing has."""

MIN_EDGE_PX = 200
MIN_LOOKS, MAX_LOOKS = 4, 15

SURE_MISFIT, BETTER = 3.0, 1.15
"""Something else than "aligned" must fit better by this factor, and by so many standard
deviations of what the looks differ by."""


@dataclass(frozen=True)
class DepthFit:
    """How depth lies to its image: lag in frames, positive where the depth is late; shift_px from
    its edges to those of the image, and how much larger (1: not at all) it must be to fit.
    """

    lag: float
    shift_px: float
    scale: float


class DepthCheck:
    """Collects how image and depth fit, one look after the other."""

    def __init__(self) -> None:
        self._looks: deque[tuple[Array, Array]] = deque(maxlen=MAX_LOOKS)
        self._factor = 1

    def look(
        self, image: NDArray[np.uint8], before: NDArray[np.uint8], disparity: NDArray[np.float32]
    ) -> None:
        """Take in a grey image (H, W), the one a frame before, and the disparity (H, W) that is
        measured with it, 0 where there is none.
        """
        self._factor = factor = max(1, round(image.shape[1] / WIDTH_PX))
        size = image.shape[1] // factor, image.shape[0] // factor
        small, earlier = (
            cv2.resize(i, size, interpolation=cv2.INTER_AREA) for i in (image, before)
        )
        edges = cv2.resize(_steps(disparity), size, interpolation=cv2.INTER_AREA)
        corners = cv2.goodFeaturesToTrack(small, 200, 0.01, 5)
        if edges.sum() < MIN_EDGE_PX / factor or corners is None:
            return
        then, found, _ = cv2.calcOpticalFlowPyrLK(small, earlier, corners, np.empty(0))
        moved = (corners - then)[np.asarray(found).ravel() > 0, 0]
        if len(moved):
            contours = _contours(small)
            fits = np.stack([_fit(contours, _zoomed(edges, scale)) for scale in SCALES])
            self._looks.append((np.median(moved, axis=0), fits))

    def misfit(self) -> DepthFit | None:
        """Return how depth lies to its image, where it is sure that it does not belong there."""
        if len(self._looks) < MIN_LOOKS:
            return None
        near = np.s_[REACH_PX - BESIDE_PX : REACH_PX + BESIDE_PX + 1]
        aligned, _, _ = _best(self._fits(SCALES.index(1.0), 0.0)[:, near, near])
        tried = ((s, lag, *_best(self._fits(s, lag))) for s in range(len(SCALES)) for lag in LAGS)
        s, lag, best, row, column = max(tried, key=lambda one: one[2].mean())
        gain = best - aligned
        sigma = gain.std(ddof=1) / np.sqrt(len(gain))
        if best.mean() < BETTER * aligned.mean() or gain.mean() <= SURE_MISFIT * sigma:
            return None
        shift_px = self._factor * float(np.hypot(row - REACH_PX, column - REACH_PX))
        return DepthFit(lag, shift_px, SCALES[s])

    def _fits(self, scale: int, lag: float) -> Array:
        """Return the fit (L, 2 R + 1, 2 R + 1) of all looks for all shifts of depth that is late by
        `lag` frames.
        """
        return np.stack([_moved(fits[scale], -lag * moved) for moved, fits in self._looks])


def _best(fits: Array) -> tuple[Array, int, int]:
    """Return the fit (L,) of all looks at the shift that is best for all, its row and column."""
    mean = fits.mean(axis=0)
    row, column = np.unravel_index(mean.argmax(), mean.shape)
    return fits[:, row, column], int(row), int(column)


def _steps(disparity: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return where things end in depth, 0 or 1 (H, W)."""
    known = np.isfinite(disparity) & (disparity > 0)
    square = np.ones((3, 3), np.uint8)
    near = cv2.dilate(np.where(known, disparity, 0).astype(np.float32), square)
    far = cv2.erode(np.where(known, disparity, NOWHERE_PX).astype(np.float32), square)
    is_known = (near > 0) & (far < NOWHERE_PX)
    return (is_known & (near > STEP_RATIO * far + 0.5)).astype(np.float32)


def _contours(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return how much of an edge each pixel of an image (H, W) is, against its neighbourhood."""
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0).astype(np.float32)
    edge = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    edge = np.minimum(edge, np.percentile(edge, 95)).astype(np.float32)
    edge -= cv2.blur(edge, (2 * REACH_PX - 1, 2 * REACH_PX - 1))
    return np.asarray(edge / max(float(edge.std()), 1e-3), np.float32)


def _zoomed(edges: NDArray[np.float32], scale: float) -> NDArray[np.float32]:
    height, width = edges.shape
    zoom = np.array([[scale, 0, (1 - scale) * width / 2], [0, scale, (1 - scale) * height / 2]])
    return np.asarray(cv2.warpAffine(edges, zoom, (width, height), flags=cv2.INTER_NEAREST))


def _fit(contours: NDArray[np.float32], edges: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the mean contour below edges for all shifts up to `REACH_PX`, (2 R + 1, 2 R + 1)."""
    inner = edges[REACH_PX:-REACH_PX, REACH_PX:-REACH_PX]
    fit = cv2.matchTemplate(contours, inner, cv2.TM_CCORR) / max(float(inner.sum()), 1.0)
    return np.asarray(fit, np.float32)


def _moved(fit: NDArray[np.float32], by_px: Array) -> NDArray[np.float32]:
    shift = np.column_stack([np.eye(2), by_px])
    moved = cv2.warpAffine(fit, shift, fit.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved)
