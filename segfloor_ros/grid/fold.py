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

from segfloor_ros.grid.blocking import Horizon
from segfloor_ros.grid.evidence import KeyframeEvidence
from segfloor_ros.grid.fan import SUBPIXEL_BITS, fixed_point
from segfloor_ros.grid.log_odds import ZERO, LogOddsRaster, steps
from segfloor_ros.grid.placing import PlacedEvidence, Pose2d, place
from segfloor_ros.grid.settings import OccupancyGridSettings


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
        """Return the cells that this keyframe sees to be free, 1, in a raster like `cells`.

        What it sees ends in the first cell that is occupied so far. That cell still gets its
        share, so that what has left is cleared in the end.
        """
        occupied = cv2.threshold(cells, self._occupied - 1, 1, cv2.THRESH_BINARY)[1]
        fan = placed.fan
        horizon = Horizon(occupied, placed.base, fan.first_rad, fan.step_rad)
        lengths = np.minimum(fan.lengths, horizon.along_fan(len(fan.lengths)) + 1)
        free = replace(fan, lengths=lengths).draw(cells.shape)
        offset = placed.rays - placed.base[:, None]
        if offset.size:
            distance = np.sqrt((offset**2).sum(axis=0))
            reached = np.minimum(distance, horizon.towards(offset) + 1) - 0.5
            ends = placed.base[:, None] + offset * (np.maximum(reached, 0) / distance)
            line = np.stack([np.broadcast_to(placed.base[:, None], ends.shape), ends], axis=2)
            pixels = fixed_point(line.reshape(2, -1)).reshape(-1, 2, 2)
            cv2.polylines(free, list(pixels), False, 1, shift=SUBPIXEL_BITS)
        return free

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
        way = fixed_point(np.stack([placed.previous, placed.base], axis=1)).tolist()
        width = max(1, int(2 * self._radius_m / self._resolution_m) - 1)
        cv2.line(cells, way[0], way[1], self._least, width, shift=SUBPIXEL_BITS)


def _hit_cells(free: NDArray[np.uint8], placed: PlacedEvidence) -> NDArray[np.intp]:
    """Return the cells, as ascending indices without repetition, that hold an obstacle.

    What is seen is an obstacle's near face. A cell that the face leaves mostly free stays free,
    and the cell behind it is the occupied one. Contacts without such a cell mark none; points
    hang above free floor then, and mark the cell below them.
    """
    hits = np.concatenate([placed.contacts, placed.points], axis=1)
    offset = hits - placed.base[:, None]
    distance = np.sqrt((offset**2).sum(axis=0))
    step = offset * (0.5 / np.maximum(distance, 1.0))
    candidates = np.stack([hits, hits + step, hits + 2 * step], axis=1).astype(np.intp)
    cell = candidates[1] * free.shape[1] + candidates[0]
    solid = free.ravel()[cell] == 0
    choice = solid.argmax(axis=0)
    chosen = cell[choice, np.arange(hits.shape[1])]
    marks = solid.any(axis=0)
    marks[placed.contacts.shape[1] :] = True
    return np.unique(chosen[marks])
