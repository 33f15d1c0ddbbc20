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
from segfloor_ros.grid.fan import SUBPIXEL_BITS, Fan, fixed_point
from segfloor_ros.grid.log_odds import ZERO, LogOddsRaster, steps
from segfloor_ros.grid.settings import OccupancyGridSettings

Pose2d = tuple[float, float, float]
"""x and y in metres, yaw in radians."""

_SEARCH_STEP_M = 0.03
_BEHIND_CELLS = (0.0, 0.5, 1.0)


class EvidenceFolder:
    """Folds evidence into a raster, by one set of settings."""

    def __init__(self, settings: OccupancyGridSettings) -> None:
        self._resolution_m = settings.resolution_m
        self._radius_m = settings.footprint_radius_m
        self._hit = steps(settings.hit_log_odds)
        self._free = steps(settings.free_log_odds)
        self._most = ZERO + steps(settings.max_log_odds)
        self._least = ZERO - steps(-settings.min_log_odds)
        self._occupied = ZERO + steps(settings.occupied_log_odds)
        self._search_step = max(0.7, _SEARCH_STEP_M / settings.resolution_m)

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
        placed = _Placed.at(evidence, pose, previous, self._resolution_m)
        low, high = placed.bounds(self._radius_m / self._resolution_m + 2)
        cells = raster.patch(low, high)
        placed = placed.seen_from(low)
        free = self._draw_free(cells, placed)
        hits = _hit_cells(free, placed)
        self._lower(cells, free, hits)
        self._raise(cells, hits)
        self._drive(cells, placed)

    def _draw_free(self, cells: NDArray[np.uint8], placed: _Placed) -> NDArray[np.uint8]:
        """Return the cells that this keyframe sees to be free, 1, in a raster like `cells`."""
        occupied = self._occupied_mask(cells)
        fan = placed.fan
        if occupied is not None and len(fan.lengths):
            lengths = self._blocked(occupied, placed.base, fan.directions(), fan.lengths)
            fan = Fan(fan.centre, fan.first_rad, fan.step_rad, lengths)
        free = fan.draw(cells.shape)
        if len(placed.rays):
            offset = placed.rays - placed.base
            lengths = np.hypot(offset[:, 0], offset[:, 1])
            directions = offset / np.maximum(lengths, 1e-9)[:, None]
            if occupied is not None:
                lengths = self._blocked(occupied, placed.base, directions, lengths)
            ends = placed.base + directions * np.maximum(lengths - 0.5, 0)[:, None]
            lines = np.stack([np.broadcast_to(placed.base, ends.shape), ends], axis=1)
            cv2.polylines(free, list(fixed_point(lines)), False, 1, shift=SUBPIXEL_BITS)
        return free

    def _occupied_mask(self, cells: NDArray[np.uint8]) -> NDArray[np.uint8] | None:
        """Return the cells that are occupied so far, 1; None when there are none."""
        occupied = cv2.threshold(cells, self._occupied - 1, 1, cv2.THRESH_BINARY)[1]
        if not occupied.any():
            return None
        if self._search_step > 1:
            occupied = cv2.dilate(occupied, np.ones((3, 3), np.uint8))
        return occupied

    def _blocked(
        self, occupied: NDArray[np.uint8], base: Array, directions: Array, lengths: Array
    ) -> Array:
        """Return lengths (S,) in cells, ended where a cell is occupied already.

        That cell still gets its share, so that what has left is cleared in the end.
        """
        along = np.arange(1, lengths.max() / self._search_step + 2) * self._search_step
        scaled = directions.astype(np.float32)
        distance = along.astype(np.float32)
        column = (np.float32(base[0]) + scaled[:, :1] * distance).astype(np.int32)
        row = (np.float32(base[1]) + scaled[:, 1:] * distance).astype(np.int32)
        rows, columns = occupied.shape
        np.clip(column, 0, columns - 1, out=column)
        np.clip(row, 0, rows - 1, out=row)
        block = occupied.ravel().take(row * columns + column)
        first = block.argmax(axis=1)
        found = block[np.arange(len(block)), first] > 0
        return np.minimum(lengths, np.where(found, along[first] + 1, np.inf))

    def _lower(
        self, cells: NDArray[np.uint8], free: NDArray[np.uint8], hits: NDArray[np.intp]
    ) -> None:
        free.ravel()[hits] = 0
        lowered = cv2.subtract(cells, free * np.uint8(self._free))
        np.maximum(lowered, np.uint8(self._least), out=cells)

    def _raise(self, cells: NDArray[np.uint8], hits: NDArray[np.intp]) -> None:
        row, column = np.divmod(hits, cells.shape[1])
        raised = cells[row, column].astype(np.int16) + self._hit
        cells[row, column] = np.minimum(raised, self._most).astype(np.uint8)

    def _drive(self, cells: NDArray[np.uint8], placed: _Placed) -> None:
        """Free the cells below the base on its way here."""
        if self._radius_m == 0:
            return
        way = fixed_point(np.stack([placed.previous, placed.base]))
        width = max(1, int(2 * self._radius_m / self._resolution_m) - 1)
        driven = np.zeros(cells.shape, np.uint8)
        cv2.line(driven, way[0].tolist(), way[1].tolist(), 1, width, shift=SUBPIXEL_BITS)
        cells[driven > 0] = self._least


class _Placed:
    """A keyframe's evidence in cells of a raster, x and y by column and row."""

    def __init__(
        self, fan: Fan, previous: Array, rays: Array, contacts: Array, points: Array
    ) -> None:
        self.fan, self.previous = fan, previous
        self.rays, self.contacts, self.points = rays, contacts, points

    @property
    def base(self) -> Array:
        return self.fan.centre

    @classmethod
    def at(
        cls, evidence: KeyframeEvidence, pose: Pose2d, previous: Pose2d | None, resolution_m: float
    ) -> _Placed:
        yaw = pose[2]
        base: Array = np.array(pose[:2]) / resolution_m
        turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]]) / resolution_m
        lengths = evidence.fan_m.astype(np.float64) / resolution_m
        return cls(
            Fan(base, evidence.first_rad + yaw, evidence.step_rad, lengths),
            base if previous is None else np.array(previous[:2]) / resolution_m,
            base + evidence.rays_m @ turn,
            base + evidence.contacts_m @ turn,
            base + evidence.points_m @ turn,
        )

    def bounds(self, margin: float) -> tuple[tuple[int, int], tuple[int, int]]:
        """Return first (row, column), and one beyond the last, of all the evidence touches."""
        outline = self.base + self.fan.directions() * self.fan.lengths[:, None]
        way = np.stack([self.base, self.previous])
        parts = [way - margin, way + margin, outline, self.rays, self.contacts, self.points]
        everything = np.concatenate(parts)
        low = np.floor(everything.min(axis=0)).astype(int) - 2
        high = np.floor(everything.max(axis=0)).astype(int) + 3
        return (int(low[1]), int(low[0])), (int(high[1]), int(high[0]))

    def seen_from(self, low: tuple[int, int]) -> _Placed:
        """Return the same with cell `low` (row, column) as the first one."""
        corner = np.array([low[1], low[0]], np.float64)
        fan = self.fan
        return _Placed(
            Fan(fan.centre - corner, fan.first_rad, fan.step_rad, fan.lengths),
            self.previous - corner,
            self.rays - corner,
            self.contacts - corner,
            self.points - corner,
        )


def _hit_cells(free: NDArray[np.uint8], placed: _Placed) -> NDArray[np.intp]:
    """Return the cells, as ascending indices without repetition, that hold an obstacle.

    What is seen is an obstacle's near face. A cell that the face leaves mostly free stays free,
    and the cell behind it is the occupied one. Contacts without such a cell mark none; points
    hang above free floor then, and mark the cell below them.
    """
    hits = np.concatenate([placed.contacts, placed.points])
    offset = hits - placed.base
    direction = offset / np.maximum(np.hypot(offset[:, 0], offset[:, 1]), 1e-9)[:, None]
    column, row = np.floor(hits.T).astype(np.intp)
    cell = row * free.shape[1] + column
    marks = np.arange(len(hits)) >= len(placed.contacts)
    for behind in reversed(_BEHIND_CELLS):
        column, row = np.floor((hits + behind * direction).T).astype(np.intp)
        solid = free[row, column] == 0
        cell = np.where(solid, row * free.shape[1] + column, cell)
        marks |= solid
    return np.unique(cell[marks])
