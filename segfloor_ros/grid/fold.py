"""Adding one keyframe's evidence to the cells.

Keyframes are folded in one after the other, as the robot saw them: evidence is clamped (Hornung
et al., OctoMap, 2013, eq. 4), so that a bounded number of looks changes a cell's mind, and a ray
ends at what the keyframes before it have found to be occupied, until enough of them have seen
through it.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array
from segfloor_ros.grid.evidence import KeyframeEvidence
from segfloor_ros.grid.log_odds import ZERO, LogOddsRaster, steps
from segfloor_ros.grid.settings import OccupancyGridSettings

Pose2d = tuple[float, float, float]
"""x and y in metres, yaw in radians."""

_SUBPIXEL_BITS = 4
_SEARCH_STEP_M = 0.03
_JUMP_SHARE = 0.15
"""Neighbouring bearings whose ranges differ by more than this share end at different things."""


class EvidenceFolder:
    """Folds evidence into a raster, by one set of settings."""

    def __init__(self, settings: OccupancyGridSettings) -> None:
        self._settings = settings
        self._resolution_m = settings.resolution_m
        self._hit = steps(settings.hit_log_odds)
        self._free = steps(settings.free_log_odds)
        self._driven = steps(-settings.min_log_odds)
        self._most = ZERO + steps(settings.max_log_odds)
        self._least = ZERO - steps(-settings.min_log_odds)
        self._occupied = ZERO + steps(settings.occupied_log_odds)
        self._step_m = max(0.7 * settings.resolution_m, _SEARCH_STEP_M)

    def fold(
        self,
        raster: LogOddsRaster,
        evidence: KeyframeEvidence,
        pose: Pose2d,
        previous: Pose2d | None,
    ) -> None:
        """Add the evidence of a keyframe with its base at `pose`; the base came there from
        `previous` in a straight line.
        """
        x, y, yaw = pose
        turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
        base = np.array([x, y])
        spokes = np.concatenate([evidence.fan, evidence.rays]) @ turn
        lengths_m: Array = np.concatenate([evidence.fan_m, evidence.rays_m]).astype(np.float64)
        hits = base + evidence.hits @ turn
        low, high = self._bounds(base, base + spokes * lengths_m[:, None], hits, previous)
        cells = raster.patch(low, high)
        corner = np.array([low[1], low[0]]) * self._resolution_m
        lengths_m = self._blocked(cells, base - corner, spokes, lengths_m)
        free = self._draw_free(cells.shape, base - corner, spokes, lengths_m, len(evidence.fan))
        self._add(cells, free, hits - corner)
        self._drive(cells, base - corner, previous, corner)

    def _bounds(
        self, base: Array, ends: Array, hits: Array, previous: Pose2d | None
    ) -> tuple[tuple[int, int], tuple[int, int]]:
        margin = self._settings.footprint_radius_m + 2 * self._resolution_m
        corners = [base - margin, base + margin]
        if previous is not None:
            corners += [np.array(previous[:2]) - margin, np.array(previous[:2]) + margin]
        everything = np.concatenate([ends, hits, np.stack(corners)])
        low = np.floor(everything.min(axis=0) / self._resolution_m).astype(int) - 1
        high = np.floor(everything.max(axis=0) / self._resolution_m).astype(int) + 2
        return (int(low[1]), int(low[0])), (int(high[1]), int(high[0]))

    def _blocked(
        self, cells: NDArray[np.uint8], base: Array, spokes: Array, lengths_m: Array
    ) -> Array:
        """Return the lengths (S,) of spokes (S, 2), ended where a cell is already occupied.

        That cell still gets its share, so that what has left is cleared in the end.
        """
        occupied = cv2.threshold(cells, self._occupied - 1, 1, cv2.THRESH_BINARY)[1]
        if not occupied.any() or len(spokes) == 0:
            return lengths_m
        if self._resolution_m < self._step_m:
            kernel = np.ones((3, 3), np.uint8)
            occupied = cv2.dilate(occupied, kernel)
        distance_m = np.arange(self._step_m, lengths_m.max() + self._step_m, self._step_m)
        scaled = spokes.astype(np.float32) / np.float32(self._resolution_m)
        start = (base / self._resolution_m).astype(np.float32)
        along = distance_m.astype(np.float32)
        column = (start[0] + scaled[:, :1] * along).astype(np.int32)
        row = (start[1] + scaled[:, 1:] * along).astype(np.int32)
        rows, columns = occupied.shape
        np.clip(column, 0, columns - 1, out=column)
        np.clip(row, 0, rows - 1, out=row)
        block = occupied.ravel().take(row * columns + column)
        first = block.argmax(axis=1)
        end = np.where(block[:, 0] | (first > 0), distance_m[first] + self._resolution_m, np.inf)
        return np.minimum(lengths_m, end)

    def _draw_free(
        self,
        shape: tuple[int, ...],
        base: Array,
        spokes: Array,
        lengths_m: Array,
        num_fan: int,
    ) -> NDArray[np.uint8]:
        """Return the cells (rows, columns) that the spokes cover, 1 where free."""
        free = np.zeros(shape, np.uint8)
        # Drawn shapes include the cells their border passes through.
        lengths_m = np.maximum(lengths_m - 0.5 * self._resolution_m, 0.0)
        if num_fan > 1:
            outline = _fan_outline(spokes[:num_fan], lengths_m[:num_fan])
            cv2.fillPoly(free, [self._pixels(base + outline)], 1, shift=_SUBPIXEL_BITS)
        if len(spokes) > num_fan:
            ends = base + spokes[num_fan:] * lengths_m[num_fan:, None]
            lines = np.stack([np.broadcast_to(base, ends.shape), ends], axis=1)
            cv2.polylines(free, list(self._pixels(lines)), False, 1, shift=_SUBPIXEL_BITS)
        return free

    def _pixels(self, xy_m: Array) -> NDArray[np.int32]:
        """Return OpenCV's fixed-point pixel coordinates; a pixel's centre is at a whole number."""
        scaled = (xy_m / self._resolution_m - 0.5) * (1 << _SUBPIXEL_BITS)
        return np.rint(scaled).astype(np.int32)

    def _add(self, cells: NDArray[np.uint8], free: NDArray[np.uint8], hits: Array) -> None:
        """Lower the free cells and raise the cells of hits (H, 2), each once and within limits."""
        column, row = np.floor(hits.T / self._resolution_m).astype(np.intp)
        free[row, column] = 0
        np.maximum(cells, self._least, out=cells)
        lowered = cv2.subtract(cells, free * np.uint8(self._free))
        np.maximum(lowered, self._least, out=cells, where=free > 0)
        cell = np.unique(row * cells.shape[1] + column)
        row, column = np.divmod(cell, cells.shape[1])
        raised = cells[row, column].astype(np.int16) + self._hit
        cells[row, column] = np.minimum(raised, self._most).astype(np.uint8)

    def _drive(
        self, cells: NDArray[np.uint8], base: Array, previous: Pose2d | None, corner: Array
    ) -> None:
        """Free the cells below the base on its way here."""
        radius_m = self._settings.footprint_radius_m
        if radius_m == 0:
            return
        start = base if previous is None else np.array(previous[:2]) - corner
        way = self._pixels(np.stack([start, base]))
        driven = np.zeros(cells.shape, np.uint8)
        width = max(1, int(2 * radius_m / self._resolution_m) - 1)
        cv2.line(driven, way[0].tolist(), way[1].tolist(), 1, width, shift=_SUBPIXEL_BITS)
        cells[driven > 0] = self._least


def _fan_outline(fan: Array, lengths_m: Array) -> Array:
    """Return the outline (P, 2) of the area between neighbouring spokes (S, 2) of these lengths.

    Where two neighbours end at different things, the area between them ends at the nearer one.
    """
    left, right = lengths_m[:-1], lengths_m[1:]
    nearer = np.minimum(left, right)
    jump = np.abs(left - right) > _JUMP_SHARE * nearer
    left_end = np.where(jump, nearer, left)[:, None] * fan[:-1]
    right_end = np.where(jump, nearer, right)[:, None] * fan[1:]
    outline = np.stack([left_end, right_end], axis=1).reshape(-1, 2)
    return np.concatenate([np.zeros((1, 2)), outline])
