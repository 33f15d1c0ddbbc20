"""The occupancy grid stage: from labelled points and floor scans to the map.

It keeps the evidence of all keyframes in order, and the raster that follows from it. Keyframes are
laid on the raster at their poses and added one after the other, as the robot saw them: evidence is
clamped (Hornung et al., OctoMap, 2013, eq. 4), so that a bounded number of looks changes a cell's
mind, and a ray ends at what the keyframes before it have found to be occupied, until enough of
them have seen through it.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.contracts import (
    CELL_M,
    FloorScan,
    KeyframeFeatures,
    KeyframePath,
    LabelledPoints,
)
from segfloor_ros.core.errors import MapError
from segfloor_ros.core.files.arrays import Arrays, check_lengths
from segfloor_ros.core.geometry import Array, Pose2d, planar
from segfloor_ros.core.grid.keyframe_evidence import (
    SUBPIXEL_BITS,
    Fan,
    KeyframeEvidence,
    evidence_from_arrays,
    evidence_to_arrays,
    find_jumps,
    fixed_point,
    gather_evidence,
    nearest_cells,
    unit_vectors,
)
from segfloor_ros.core.grid.occupancy import (
    FINE,
    FREE,
    HIT,
    LEAST,
    MISS,
    MOST,
    OCCUPIED,
    OCCUPIED_FROM,
    SURE,
    UNKNOWN,
    ZERO,
    LogOddsRaster,
    OccupancyGrid,
    OccupancyGridSettings,
    render,
    steps,
)

_LEVER_M = 2.5
"""A turn of the base moves its evidence by the turn times this, about half a ray."""

UNDO_BYTES = 4_000_000
_MAX_STRIDE_M = 2.0
"""Between keyframes farther apart than this the base's way is not known."""


_AROUND = np.ones((3, 3), np.uint8)
"""A cell and its neighbours."""

BEHIND_M = 0.1
"""Nothing is free so close behind a face: walls are no thinner."""

MAJORITY = 0.5
"""Share of the keyframes that see a place which must agree on what stands there."""


class OccupancyGridMapper:
    """Builds the map from the keyframes' evidence, and lets it follow their poses."""

    def __init__(self, settings: OccupancyGridSettings) -> None:
        self._settings = settings
        self._gather = gather_evidence
        self._history = EvidenceHistory(EvidenceFolder(settings))
        self._stamp_ns = np.zeros(0, np.int64)
        self._set_back: tuple[NDArray[np.int64], EvidenceHistory] | None = None

    def change_settings(self, settings: OccupancyGridSettings) -> None:
        """Map with changed live settings from now on, old evidence included."""
        self._settings = settings

    def update(
        self,
        stamp_ns: int,
        points: LabelledPoints,
        features: KeyframeFeatures,
        path: KeyframePath,
        scan: FloorScan,
    ) -> None:
        """Take in one keyframe, by its stamp; keyframes come in the order of their stamps.

        path: all keyframes as now optimised, this one among them; evidence of keyframes that are
        no longer in it is forgotten, or where it is all there was, waits for their return. Raises
        MapError when the keyframe is not in the path.
        """
        poses = planar(path.T_map_base)
        self._follow(path.stamp_ns, poses)
        at = int(np.searchsorted(path.stamp_ns, stamp_ns))
        if at == len(path.stamp_ns) or path.stamp_ns[at] != stamp_ns:
            raise MapError(f'keyframe {stamp_ns} ns is not in its own path of keyframes')
        evidence = self._gather(points, features, path.T_map_base[at], scan, self._settings)
        self._history.extend([evidence], poses[at : at + 1])
        self._stamp_ns = np.append(self._stamp_ns, np.int64(stamp_ns))

    def grid(self) -> OccupancyGrid:
        """Return the map as of the last update."""
        history = self._history
        grid = render(history.raster(), history.poses[:, :2], self._settings)
        mark_standing(grid, history.evidence, history.poses)
        return grid

    def to_arrays(self) -> Arrays:
        """Return the evidence of all keyframes, for a file."""
        arrays = evidence_to_arrays(self._history.evidence)
        return arrays | {'stamp_ns': self._stamp_ns, 'pose': self._history.poses}

    def from_arrays(self, arrays: Arrays, stamp_ns: NDArray[np.int64]) -> None:
        """Go on with the evidence of a map, with its keyframes at stamps (K,), ascending."""
        evidence = evidence_from_arrays(arrays)
        check_lengths({'evidence': evidence, 'pose': arrays['pose'], 'stamp_ns': stamp_ns})
        self._history.extend(evidence, arrays['pose'])
        self._stamp_ns = stamp_ns

    def _follow(self, stamp_ns: NDArray[np.int64], poses: NDArray[np.float64]) -> None:
        """Move the evidence to the keyframes' poses (K, 3), where they moved enough to matter."""
        self._bring_back(stamp_ns)
        row = np.minimum(np.searchsorted(stamp_ns, self._stamp_ns), len(stamp_ns) - 1)
        gone = stamp_ns[row] != self._stamp_ns
        if len(gone) and gone.all():
            self._set_back = self._stamp_ns, self._history
            self._history = EvidenceHistory(EvidenceFolder(self._settings))
            self._stamp_ns, row = self._stamp_ns[:0], row[:0]
        elif gone.any():
            self._history.remove(gone)
            self._stamp_ns, row = self._stamp_ns[~gone], row[~gone]
        now, then = poses[row], self._history.poses
        moved_m = np.hypot(now[:, 0] - then[:, 0], now[:, 1] - then[:, 1])
        turn = np.abs(np.remainder(now[:, 2] - then[:, 2] + np.pi, 2 * np.pi) - np.pi)
        limit_m = FINE * self._settings.resolution_m
        moved = np.flatnonzero(moved_m + turn * _LEVER_M > limit_m)
        if len(moved):
            self._history.move(int(moved[0]), now[moved[0] :])

    def _bring_back(self, stamp_ns: NDArray[np.int64]) -> None:
        """Take in what was set back, once its keyframes, which are older, are in the path again:
        a drive with a map of its own has recognised the one that was loaded.
        """
        if self._set_back is None or not np.isin(self._set_back[0], stamp_ns).any():
            return
        (earlier, before), latest = self._set_back, self._history
        self._history, self._set_back = EvidenceHistory(EvidenceFolder(self._settings)), None
        for history in (before, latest):
            self._history.extend(history.evidence, history.poses)
        self._stamp_ns = np.concatenate([earlier, self._stamp_ns])


def make_mapper(settings: OccupancyGridSettings) -> OccupancyGridMapper:
    """Return the mapper that the settings ask for."""
    if not settings.as_published:
        return OccupancyGridMapper(settings)
    from segfloor_ros.core.grid.as_published import PublishedMapper

    return PublishedMapper(settings)


def mark_standing(
    grid: OccupancyGrid, evidence: list[KeyframeEvidence], poses: NDArray[np.float64]
) -> None:
    """Occupy the cells of things of classes that move which have not moved in most of the map's
    life: most of what keyframes, at poses (K, 3) = x, y, yaw, have seen of them is in no free cell,
    from the first of these keyframes to the last. Where things walk, the floor was free before they
    came, or after they left.
    """
    keyframe = np.repeat(np.arange(len(evidence)), [e.movable_m.shape[1] for e in evidence])
    if len(keyframe) == 0:
        return
    x, y = np.concatenate([e.movable_m for e in evidence], axis=1).astype(np.float64)
    cos, sin = unit_vectors(poses[keyframe, 2])
    cells = grid.cells_of(poses[keyframe, :2] + np.stack([cos * x - sin * y, sin * x + cos * y], 1))
    inside = grid.holds(cells)
    keyframe, at = keyframe[inside], tuple(cells[inside].T)
    seen = np.zeros(grid.cells.shape, np.uint8)
    seen[at] = 1
    count, label = cv2.connectedComponents(cv2.dilate(seen, _AROUND))
    thing, keeps = label[at], grid.cells[at] != FREE
    first, last = np.full(count, len(evidence)), np.zeros(count, np.intp)
    np.minimum.at(first, thing[keeps], keyframe[keeps])
    np.maximum.at(last, thing[keeps], keyframe[keeps])
    stands = last - first > MAJORITY * len(evidence)
    stands &= np.bincount(thing, keeps, count) > MAJORITY * np.bincount(thing, None, count)
    grid.cells[(seen > 0) & stands[label] & (grid.cells == UNKNOWN)] = OCCUPIED


class EvidenceHistory:
    """Folds the keyframes into the raster, and folds them anew from the first one that moved.

    What the latest keyframes overwrote is kept, so that they can be taken back one by one: moves
    after local bundle adjustment concern these. The raster depends on evidence and poses alone,
    not on how often and when it was asked for.

    evidence: of the keyframes; poses: (K, 3) = x, y, yaw, where it now lies.
    """

    def __init__(self, folder: EvidenceFolder) -> None:
        self._folder = folder
        self.evidence: list[KeyframeEvidence] = []
        self.poses: NDArray[np.float64] = np.zeros((0, 3))
        self._raster = LogOddsRaster()
        self._done = 0
        self._undo: deque[tuple[tuple[int, int], NDArray[np.uint8]]] = deque()
        self._undo_bytes = 0

    def __len__(self) -> int:
        return len(self.evidence)

    def extend(self, evidence: list[KeyframeEvidence], poses: NDArray[np.float64]) -> None:
        """Add the evidence of the next keyframes, at poses (K, 3) = x, y, yaw."""
        self.evidence += evidence
        self.poses = np.concatenate([self.poses, poses])

    def move(self, first: int, poses: NDArray[np.float64]) -> None:
        """Set the poses (K - first, 3) of keyframe `first` and all after it."""
        self.poses[first:] = poses
        self._return_to(first)

    def remove(self, gone: NDArray[np.bool_]) -> None:
        """Forget the evidence of some keyframes (K,)."""
        self._return_to(int(np.argmax(gone)))
        self.evidence = [e for e, g in zip(self.evidence, gone, strict=True) if not g]
        self.poses = self.poses[~gone]

    def raster(self) -> LogOddsRaster:
        """Return the raster of all keyframes."""
        while self._done < len(self.evidence):
            evidence = self.evidence[self._done]
            pose, previous = self._pose(self._done), self._previous(self._done)
            placed = self._folder.place(evidence, pose, previous)
            cells = self._raster.patch(placed.low, placed.high)
            self._remember(placed.low, cells)
            self._folder.fold(cells, placed)
            self._done += 1
        return self._raster

    def _pose(self, index: int) -> Pose2d:
        x, y, yaw = self.poses[index].tolist()
        return (x, y, yaw)

    def _previous(self, index: int) -> Pose2d | None:
        if index == 0:
            return None
        stride = np.hypot(*(self.poses[index, :2] - self.poses[index - 1, :2]))
        return self._pose(index - 1) if stride <= _MAX_STRIDE_M else None

    def _remember(self, low: tuple[int, int], cells: NDArray[np.uint8]) -> None:
        self._undo.append((low, cells.copy()))
        self._undo_bytes += cells.size
        while self._undo_bytes > UNDO_BYTES:
            self._undo_bytes -= self._undo.popleft()[1].size

    def _return_to(self, index: int) -> None:
        """Make the raster one of the keyframes before `index`, or of none."""
        if self._done - index > len(self._undo):
            self._start_over()
        while self._done > index:
            low, cells = self._undo.pop()
            self._undo_bytes -= cells.size
            high = (low[0] + cells.shape[0], low[1] + cells.shape[1])
            self._raster.patch(low, high)[:] = cells
            self._done -= 1

    def _start_over(self) -> None:
        self._raster = LogOddsRaster()
        self._done = 0
        self._undo.clear()
        self._undo_bytes = 0


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
    along = np.arange(0, length.max() + FINE, FINE)
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
