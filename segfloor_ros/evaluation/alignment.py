"""The rigid motion (no scale) that lays an estimated map on the true one.

The score of a pose counts estimated free cells on true free floor, minus those elsewhere, plus
estimated obstacles near true obstacles. It is correlated over all translations and headings on a
coarse raster (Fourier domain) and then refined by a shrinking pattern search.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2

from segfloor_ros.errors import InputError
from segfloor_ros.evaluation import raster
from segfloor_ros.evaluation.truth import Pose2d
from segfloor_ros.geometry import Array
from segfloor_ros.grid.map_file import OccupancyGrid

COARSE_CELL_M = 0.1
COARSE_HEADINGS = 120
NEAR_OBSTACLE_M = 0.05
MAX_SCORED_CELLS = 40000
REFINEMENT_STEPS_M = (0.1, 0.05, 0.025, 0.0125)
TURN_PER_METRE = 0.15
"""Radians of a refinement step that go with a metre: a lever of about 7 m."""


def find_alignment(
    estimate: OccupancyGrid, truth: OccupancyGrid, near: Pose2d | None = None
) -> Pose2d:
    """Return where the estimate's frame lies in the truth's frame.

    near: a pose to start from; without one the whole truth is searched. Raises InputError when the
    estimate has no known cell.
    """
    free, occupied = _known_points(estimate)
    if not len(free) + len(occupied):
        raise InputError('the estimated map has no known cell to align by; use --align none')
    fit = _Fit(free, occupied, truth, *_gain_images(truth))
    return _refine(fit, near or _search_everywhere(fit))


@dataclass(frozen=True)
class _Fit:
    """Free and occupied points (N, 2) of an estimate, the truth, and what each earns there."""

    free: Array
    occupied: Array
    truth: OccupancyGrid
    free_gain: Array
    occupied_gain: Array

    def score(self, pose: Pose2d) -> float:
        """Return what all points earn where the estimate's frame lies at a pose."""
        free = self._earned(self.free, self.free_gain, pose, -1.0)
        return free + self._earned(self.occupied, self.occupied_gain, pose, 0.0)

    def _earned(self, points: Array, gain: Array, pose: Pose2d, outside: float) -> float:
        moved = raster.from_frame(points, pose) - np.array(self.truth.origin_xy_m)
        cells = np.floor(moved / self.truth.resolution_m).astype(np.int64)
        height, width = gain.shape
        inside = ((cells >= 0) & (cells < (width, height))).all(axis=1)
        hit = cells[inside]
        return float(gain[hit[:, 1], hit[:, 0]].sum() + outside * (~inside).sum())


def _known_points(grid: OccupancyGrid) -> tuple[Array, Array]:
    """Return centres of free and of occupied cells, thinned evenly where there are many."""
    state = raster.states(grid).ravel()
    centres = raster.cell_centres(grid)
    thinned = []
    for wanted in (raster.FREE, raster.OCCUPIED):
        points = centres[state == wanted]
        thinned.append(points[:: max(1, len(points) // MAX_SCORED_CELLS)])
    return thinned[0], thinned[1]


def _gain_images(truth: OccupancyGrid) -> tuple[Array, Array]:
    """Return what a free and what an occupied estimated cell earn at each cell of the truth."""
    state = raster.states(truth)
    free_gain = np.where(state == raster.FREE, 1.0, -1.0)
    reach = 2 * max(1, round(NEAR_OBSTACLE_M / truth.resolution_m)) + 1
    near = cv2.dilate(
        (state == raster.OCCUPIED).astype(np.uint8), np.ones((reach, reach), np.uint8)
    )
    return free_gain, near.astype(np.float64)


def _refine(fit: _Fit, start: Pose2d) -> Pose2d:
    """Move to the best of the neighbouring poses until none is better, with shrinking steps."""
    best, best_score = start, fit.score(start)
    moves = [move for move in product((-1, 0, 1), repeat=3) if any(move)]
    for step in REFINEMENT_STEPS_M:
        improved = True
        while improved:
            centre, improved = best, False
            for dx, dy, turn in moves:
                pose = (
                    centre[0] + dx * step,
                    centre[1] + dy * step,
                    centre[2] + turn * step * TURN_PER_METRE,
                )
                score = fit.score(pose)
                if score > best_score:
                    best, best_score, improved = pose, score, True
    return best


def _search_everywhere(fit: _Fit) -> Pose2d:
    """Return the best pose over all headings and coarse translations by correlation."""
    scale = fit.truth.resolution_m / COARSE_CELL_M
    size = [max(1, round(side * scale)) for side in fit.free_gain.shape[::-1]]
    # Outside the truth nothing is free: shift the gains so that zero padding means a loss.
    free_gain = cv2.resize(fit.free_gain, size, interpolation=cv2.INTER_AREA) + 1.0
    occupied_gain = cv2.resize(fit.occupied_gain, size, interpolation=cv2.INTER_AREA)
    best, best_score = (0.0, 0.0, 0.0), -np.inf
    headings = np.linspace(-np.pi, np.pi, COARSE_HEADINGS, endpoint=False)
    # From the smallest turn on, so that a symmetric place is not turned over for nothing.
    for yaw in sorted(headings, key=abs):
        turned = raster.from_frame(np.vstack([fit.free, fit.occupied]), (0.0, 0.0, float(yaw)))
        low = np.floor(turned.min(axis=0) / COARSE_CELL_M) * COARSE_CELL_M
        counts = [_histogram(part, low, turned) for part in np.split(turned, [len(fit.free)])]
        score = _correlate([free_gain, occupied_gain], counts)
        row, column = np.unravel_index(int(np.argmax(score)), score.shape)
        if score[row, column] > best_score:
            best_score = float(score[row, column])
            offset = np.array([column, row]) - np.array(counts[0].shape[::-1]) + 1
            shift = np.array(fit.truth.origin_xy_m) + offset * COARSE_CELL_M - low
            best = (float(shift[0]), float(shift[1]), float(yaw))
    return best


def _correlate(gains: list[Array], counts: list[Array]) -> Array:
    """Return, for every shift of the counts over the gains, what they earn together; shift zero
    of the last row and column of the counts is at (0, 0) (full convolution of mirrored counts).
    """
    shape = [a + b - 1 for a, b in zip(gains[0].shape, counts[0].shape, strict=True)]
    padded = [next_fast_len(side, real=True) for side in shape]
    spectra = [
        rfft2(gain, padded) * rfft2(count[::-1, ::-1], padded)
        for gain, count in zip(gains, counts, strict=True)
    ]
    return np.asarray(irfft2(np.sum(spectra, axis=0), padded)[: shape[0], : shape[1]])


def _histogram(points: Array, low: Array, all_points: Array) -> Array:
    """Count points per coarse cell of the box that holds all points."""
    columns, rows = (np.floor((all_points.max(axis=0) - low) / COARSE_CELL_M) + 1).astype(int)
    cells = np.floor((points - low) / COARSE_CELL_M).astype(np.int64)
    flat = np.bincount(cells[:, 1] * columns + cells[:, 0], minlength=rows * columns)
    return flat.reshape(rows, columns).astype(np.float64)
