"""Adding one keyframe's evidence to the cells.

Keyframes are folded in one after the other, as the robot saw them: evidence is clamped (Hornung
et al., OctoMap, 2013, eq. 4), so that a bounded number of looks changes a cell's mind, and a ray
ends at what the keyframes before it have found to be occupied, until enough of them have seen
through it.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array
from segfloor_ros.grid.evidence import KeyframeEvidence
from segfloor_ros.grid.fan import SUBPIXEL_BITS, fixed_point
from segfloor_ros.grid.log_odds import ZERO, LogOddsRaster, steps
from segfloor_ros.grid.placing import PlacedEvidence, Pose2d, place
from segfloor_ros.grid.settings import OccupancyGridSettings

_SEARCH_STEP_M = 0.03


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
        placed = place(evidence, pose, previous, self._resolution_m, self._radius_m)
        cells = raster.patch(placed.low, placed.high)
        free = self._draw_free(cells, placed)
        hits = _hit_cells(free, placed)
        self._lower(cells, free, hits)
        self._raise(cells, hits)
        self._drive(cells, placed)

    def _draw_free(self, cells: NDArray[np.uint8], placed: PlacedEvidence) -> NDArray[np.uint8]:
        """Return the cells that this keyframe sees to be free, 1, in a raster like `cells`."""
        occupied = self._occupied_mask(cells)
        fan = placed.fan
        if occupied is not None and len(fan.lengths):
            lengths = self._blocked(occupied, placed.base, fan.directions, fan.lengths)
            fan = replace(fan, lengths=lengths)
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
        distance = np.minimum(along.astype(np.float32), lengths.astype(np.float32)[:, None])
        column = (np.float32(base[0]) + scaled[:, :1] * distance).astype(np.int32)
        row = (np.float32(base[1]) + scaled[:, 1:] * distance).astype(np.int32)
        block = occupied.ravel().take(row * occupied.shape[1] + column)
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

    def _drive(self, cells: NDArray[np.uint8], placed: PlacedEvidence) -> None:
        """Free the cells below the base on its way here."""
        if self._radius_m == 0:
            return
        way = fixed_point(np.array([placed.previous, placed.base])).tolist()
        width = max(1, int(2 * self._radius_m / self._resolution_m) - 1)
        cv2.line(cells, way[0], way[1], self._least, width, shift=SUBPIXEL_BITS)


def _hit_cells(free: NDArray[np.uint8], placed: PlacedEvidence) -> NDArray[np.intp]:
    """Return the cells, as ascending indices without repetition, that hold an obstacle.

    What is seen is an obstacle's near face. A cell that the face leaves mostly free stays free,
    and the cell behind it is the occupied one. Contacts without such a cell mark none; points
    hang above free floor then, and mark the cell below them.
    """
    hits = np.concatenate([placed.contacts, placed.points])
    offset = hits - placed.base
    distance = np.sqrt(offset[:, 0] ** 2 + offset[:, 1] ** 2)
    step = offset * (0.5 / np.maximum(distance, 1.0))[:, None]
    candidates = np.concatenate([hits, hits + step, hits + 2 * step]).astype(np.intp)
    cell = (candidates[:, 1] * free.shape[1] + candidates[:, 0]).reshape(3, -1)
    solid = free.ravel()[cell] == 0
    choice = solid.argmax(axis=0)
    chosen = cell[choice, np.arange(len(hits))]
    marks = solid[choice, np.arange(len(hits))]
    marks[len(placed.contacts) :] = True
    return np.unique(chosen[marks])
