"""A keyframe's evidence, laid on the raster at its pose and added to the cells.

Keyframes are folded in one after the other, as the robot saw them: evidence is clamped (Hornung
et al., OctoMap, 2013, eq. 4), so that a bounded number of looks changes a cell's mind, and a ray
ends at what the keyframes before it have found to be occupied, until enough of them have seen
through it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.floor.observation import CELL_M
from segfloor_ros.geometry import Array
from segfloor_ros.grid.keyframe_evidence import (
    SUBPIXEL_BITS,
    Fan,
    KeyframeEvidence,
    find_jumps,
    fixed_point,
    nearest_cells,
    unit_vectors,
)
from segfloor_ros.grid.map_file import (
    HIT,
    LEAST,
    MISS,
    MOST,
    OCCUPIED_FROM,
    SURE,
    ZERO,
    OccupancyGridSettings,
    steps,
)

_AROUND = np.ones((3, 3), np.uint8)

_RAY_STEP = 0.25
"""Cells between two samples of a ray."""

Pose2d = tuple[float, float, float]
"""x and y in metres, yaw in radians."""
BEHIND_M = 0.1
"""Nothing is free so close behind a face: walls are no thinner."""


class EvidenceFolder:
    """Folds evidence into a raster, by one set of settings."""

    def __init__(self, settings: OccupancyGridSettings) -> None:
        self._resolution_m = settings.resolution_m
        self._radius_m = settings.footprint_radius_m
        self._least = ZERO - steps(-LEAST)
        self._occupied = ZERO + steps(OCCUPIED_FROM)
        value = np.arange(256)
        hit, free = steps(HIT), steps(MISS)
        most = ZERO + steps(MOST)
        self._raised = np.minimum(value + hit, most).astype(np.uint8)
        self._lowered = np.maximum(value - free, self._least).astype(np.uint8)
        undone = np.minimum(value + free, np.maximum(value, ZERO))
        self._undone = undone.astype(np.uint8)
        # What is seen from too far to be placed within its cell, or in a part of a cell, counts as
        # long as nothing was seen from nearer: it does not count for much, and changes nothing that
        # does.
        sure = self._sure = ZERO + steps(SURE)
        lowered = np.minimum(value, np.maximum(value - free, ZERO - free))
        self._lowered_tentatively = np.where(value > sure, value, lowered).astype(np.uint8)
        raised = np.maximum(value, np.minimum(value + hit, sure))
        self._raised_tentatively = np.where(value < ZERO - 2 * free, value, raised).astype(np.uint8)

    def place(
        self, evidence: KeyframeEvidence, pose: Pose2d, previous: Pose2d | None
    ) -> PlacedEvidence:
        """Lay evidence on the raster with the base at `pose`; the base came there from `previous`
        in a straight line.
        """
        yaw, scale = pose[2], 1 / self._resolution_m
        way = np.array([pose[:2], (previous or pose)[:2]]).T * scale
        lengths = evidence.fan_m.astype(np.float64) * scale
        first_rad = evidence.first_rad + yaw
        directions = unit_vectors(first_rad + evidence.step_rad * np.arange(len(lengths)))
        cos, sin = np.cos(yaw) * scale, np.sin(yaw) * scale
        positions = np.array([[cos, -sin], [sin, cos]]) @ evidence.positions_m.astype(np.float64)
        rays, faces = evidence.num_rays, evidence.num_rays + evidence.num_contacts
        x, y = positions[:, faces:]
        outward = positions[:, faces:] / np.maximum(np.sqrt(x * x + y * y), 1.0)
        positions += way[:, :1]
        thickness = np.maximum(evidence.thickness_m.astype(np.float64) * scale, 1.0)
        margin = self._radius_m * scale + 2
        body = int(np.ceil(thickness.max(initial=BEHIND_M * scale))) + 1
        ends = directions * lengths + way[:, :1]
        touched = np.concatenate([ends, positions, way - margin, way + margin], axis=1)
        low = np.floor(touched.min(axis=1, keepdims=True)).astype(np.intp) - body
        high = np.floor(touched.max(axis=1, keepdims=True)).astype(np.intp) + body + 1
        positions -= low
        way -= low
        return PlacedEvidence(
            low=(int(low[1, 0]), int(low[0, 0])),
            high=(int(high[1, 0]), int(high[0, 0])),
            fan=Fan(
                way[:, 0], first_rad, evidence.step_rad, directions, lengths, find_jumps(lengths)
            ),
            previous=way[:, 1],
            rays=positions[:, :rays],
            ends=positions[:, rays:faces],
            faces=positions[:, faces:],
            outward=outward,
            thickness=thickness,
            sure_range=evidence.sure_range_m * scale,
        )

    def fold(self, cells: NDArray[np.uint8], placed: PlacedEvidence) -> None:
        """Add evidence to the cells from `placed.low` up to, not including, `placed.high`."""
        free, touched = placed.fan.draw(cells.shape)
        if placed.rays.size:
            base = placed.fan.centre
            draw_rays(free, base, placed.rays - base[:, None], 0.5)
            touched |= free
        hits = draw_hits(free, placed)
        partly = self._draw_partly_free(free, placed)
        near = self._draw_near(cells.shape, placed)
        in_the_way = self._standing(cells, near) & touched
        if cv2.countNonZero(in_the_way):
            in_the_way &= 1 - cv2.dilate(hits, _AROUND)
        hidden = self._draw_hidden(in_the_way, placed.fan)
        visible = 1 - (hits if hidden is None else hits | hidden)
        free &= visible
        partly &= visible
        _replace(cells, free & near, self._lowered)
        _replace(cells, partly & ~(free & near), self._lowered_tentatively)
        behind = self._draw_behind(cells.shape, placed) & near & (1 - (partly | hits))
        _replace(cells, behind, self._undone)
        _replace(cells, hits & near, self._raised)
        _replace(cells, hits & ~near, self._raised_tentatively)
        self._drive(cells, placed)

    def _draw_behind(self, shape: tuple[int, ...], placed: PlacedEvidence) -> NDArray[np.uint8]:
        """Return the cells right behind the faces that are seen, 1. What was found to be free there
        was placed wrongly, by a path that had drifted.
        """
        behind = np.zeros(shape, np.uint8)
        depth = np.full(len(placed.thickness), max(1.0, BEHIND_M / self._resolution_m))
        draw_bands(behind, placed, depth)
        return behind

    def _draw_partly_free(
        self, free: NDArray[np.uint8], placed: PlacedEvidence
    ) -> NDArray[np.uint8]:
        """Return the free cells and those that the fan's edges cross, 1."""
        partly = free.copy()
        fan = placed.fan
        edge = fan.edges() & (fan.lengths > 1)
        draw_rays(partly, placed.fan.centre, fan.directions[:, edge] * fan.lengths[edge], 1.0)
        return partly

    def _standing(self, cells: NDArray[np.uint8], near: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the cells that are occupied so far, 1; of the near ones those that were seen to
        be from near: others may lie beside what is seen now.
        """
        occupied = cv2.threshold(cells, self._occupied - 1, 1, cv2.THRESH_BINARY)[1]
        sure = cv2.threshold(cells, self._sure, 1, cv2.THRESH_BINARY)[1]
        return occupied & (sure | (1 - near))

    def _draw_hidden(self, in_the_way: NDArray[np.uint8], fan: Fan) -> NDArray[np.uint8] | None:
        """Return the cells behind what is in the way, 1; None when nothing is.

        What stands there itself still gets its share, so that it is cleared once it has left.
        """
        at = cv2.findNonZero(in_the_way)
        if at is None:
            return None
        column, row = at.reshape(-1, 2).T
        horizon = nearest_cells(column, row, fan)
        return fan.shadow(in_the_way.shape, horizon + max(2.0, CELL_M / self._resolution_m))

    def _draw_near(self, shape: tuple[int, ...], placed: PlacedEvidence) -> NDArray[np.uint8]:
        """Return the cells that are near enough for an obstacle to be placed in one of them, 1."""
        near = np.zeros(shape, np.uint8)
        centre = fixed_point(placed.fan.centre[:, None])[0].tolist()
        radius = round(min(placed.sure_range, sum(shape)) * (1 << SUBPIXEL_BITS))
        cv2.circle(near, centre, radius, 1, cv2.FILLED, shift=SUBPIXEL_BITS)
        return near

    def _drive(self, cells: NDArray[np.uint8], placed: PlacedEvidence) -> None:
        """Free the cells below the base on its way here."""
        if self._radius_m == 0:
            return
        way = fixed_point(np.stack([placed.previous, placed.fan.centre], axis=1)).tolist()
        width = max(1, int(2 * self._radius_m / self._resolution_m) - 1)
        cv2.line(cells, way[0], way[1], self._least, width, shift=SUBPIXEL_BITS)


def _replace(cells: NDArray[np.uint8], where: NDArray[np.uint8], table: NDArray[np.uint8]) -> None:
    """Replace the values of some cells by those of a table (256,)."""
    cv2.copyTo(cv2.LUT(cells, table), where, cells)


def draw_hits(free: NDArray[np.uint8], placed: PlacedEvidence) -> NDArray[np.uint8]:
    """Return a raster like `free` that is 1 in the cells that hold an obstacle.

    What is seen is an obstacle's near face. A cell that the face leaves mostly free stays free,
    and the cell behind it is the occupied one. Contacts without such a cell mark none; points
    hang above free floor then, and mark the cell below them.
    """
    hits = np.zeros_like(free)
    draw_bands(hits, placed, placed.thickness)
    hits &= 1 - free
    step = 0.5 * placed.outward
    num = placed.faces.shape[1]
    candidates = np.empty((2, 3, num))
    candidates[:, 0], candidates[:, 1] = placed.faces, placed.faces + step
    candidates[:, 2] = candidates[:, 1] + step
    column, row = candidates.astype(np.intp)
    cell = row * free.shape[1] + column
    solid = free.ravel()[cell] == 0
    # Of cells without a solid one the first, which is the cell itself, is chosen.
    chosen = cell[solid.argmax(axis=0), np.arange(num)]
    marks = solid.any(axis=0)
    marks[len(placed.thickness) :] = True
    hits.ravel()[chosen[marks]] = 1
    return hits


def draw_bands(raster: NDArray[np.uint8], placed: PlacedEvidence, thickness: Array) -> None:
    """Set the cells behind the faces to 1, up to a depth (C,) in cells."""
    num = len(thickness)
    if num == 0:
        return
    start, outward = placed.faces[:, :num], placed.outward[:, :num]
    along = placed.ends - start
    num_along = int(np.abs(along).max()) + 2
    share = np.arange(num_along) * (1 / (num_along - 1))
    lines = start[:, :, None] + along[:, :, None] * share
    layers = np.arange(0.5, thickness.max())
    behind = outward[:, :, None] * np.minimum(layers, thickness[:, None] - 0.5)
    column, row = (lines[:, :, :, None] + behind[:, :, None, :]).astype(np.intp)
    raster[row, column] = 1


def draw_rays(raster: NDArray[np.uint8], base: Array, offset: Array, short: float) -> None:
    """Set the cells that rays from the base to base + offset (2, N) cross to 1.

    The rays end `short` cells before that. (OpenCV's lines begin and end in the middle of cells.)
    """
    length = np.maximum(np.sqrt((offset**2).sum(axis=0)) - short, 0)
    if len(length) == 0:
        return
    along = np.arange(0, length.max() + _RAY_STEP, _RAY_STEP)
    direction = offset / np.maximum(np.sqrt((offset**2).sum(axis=0)), 1e-9)
    distance = np.minimum(along, length[:, None])
    column, row = (base[:, None, None] + direction[:, :, None] * distance).astype(np.intp)
    raster[row, column] = 1


@dataclass(frozen=True)
class PlacedEvidence:
    """Evidence in cells, x along columns and y along rows, seen from the corner of cell `low`.

    low, high: (row, column) of the first cell and of one beyond the last that the evidence
    touches. previous: (2,), where the base came from. rays: (2, R), ends of single rays. faces:
    (2, C + P), starts of the lines along contacts, then obstacle points; outward: (2, C + P), unit
    vectors from the base to them. ends: (2, C), where these lines end; thickness: (C,), how deep
    is what stands behind them. sure_range: how far obstacles are placed within a
    cell.
    """

    low: tuple[int, int]
    high: tuple[int, int]
    fan: Fan
    previous: Array
    rays: Array
    ends: Array
    faces: Array
    outward: Array
    thickness: Array
    sure_range: float
