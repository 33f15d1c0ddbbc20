"""Maps to compare: true ones, brought onto one raster, and aligned.

The score of an alignment counts estimated free cells on true free floor, minus those elsewhere,
plus estimated obstacles near true obstacles. It is correlated over all translations and headings on
a coarse raster (Fourier domain) and then refined by a shrinking pattern search.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2

from segfloor_ros.apps.map_files import load_map
from segfloor_ros.apps.trajectory import read_trajectory
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.whole import read_table
from segfloor_ros.core.geometry import Array, Pose2d, planar
from segfloor_ros.core.grid.occupancy import FINE, FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from segfloor_ros.nodes.yaml_files import read_yaml

BEARINGS = 361
SAME_PLACE_M, SAME_HEADING_RAD = 0.1, 0.05
"""Places and headings that differ by less are one: where sight is followed, where two maps are
compared, and the step of the search for an alignment.
"""

Mask = NDArray[np.bool_]

ENOUGH = 40000
"""Cells or points, to score an alignment by or to draw."""


@dataclass(frozen=True)
class MapTruth:
    """A true map. start_pose: where the frame `map` of an estimate lies in the truth's frame,
    None where nobody said. base_poses: (N, 3) x, y, yaw of the robot in the truth's frame, None
    where the drive is unknown. fov_rad: horizontal field of view of the camera.
    """

    grid: OccupancyGrid
    start_pose: Pose2d | None = None
    base_poses: Array | None = None
    fov_rad: float = math.pi / 2

    @property
    def start(self) -> Pose2d:
        """Where the drive starts; the truth's own origin where nobody said."""
        return self.start_pose or (0.0, 0.0, 0.0)


def load_truth(path: Path) -> MapTruth:
    """Read a true map from a map YAML, or with poses from a scene folder (map.yaml, scene.yaml,
    base_poses.txt). Raises InputError naming the file.
    """
    if not path.is_dir():
        return MapTruth(load_map(path))
    grid = load_map(path / 'map.yaml')
    scene_file = path / 'scene.yaml'
    if not scene_file.is_file():
        return MapTruth(grid)
    start_pose, fov_rad = _read_scene(scene_file)
    poses_file = path / 'base_poses.txt'
    poses = read_base_poses(poses_file) if poses_file.is_file() else None
    return MapTruth(grid, start_pose, poses, fov_rad)


def read_base_poses(path: Path) -> Array:
    """Return poses (N, 3) = x, y, yaw from rows `t x y yaw` or from a TUM file of the base."""
    table = read_table(path)
    if table.shape[1] == 4:
        return table[:, 1:]
    return planar(read_trajectory(path)[1])


def _read_scene(path: Path) -> tuple[Pose2d, float]:
    scene = read_yaml(path, 'names and values')
    try:
        x, y, yaw = (float(value) for value in scene['start_pose_world'])
        fov_rad = float(np.radians(scene['fov_x_deg']))
    except (KeyError, TypeError, ValueError):
        raise InputError(f'{path}: expected start_pose_world (x, y, yaw) and fov_x_deg') from None
    return (x, y, yaw), fov_rad


def sample_states(grid: OccupancyGrid, points: Array) -> NDArray[np.int8]:
    """Return the states (N,) of the cells that hold points (N, 2) of the grid's frame; `UNKNOWN`
    outside.
    """
    return _values_at(grid, grid.states, points, UNKNOWN)


def _values_at(grid: OccupancyGrid, values: NDArray[Any], points: Array, outside: Any) -> Any:
    """Return what the cells (rows, columns) that hold points (N, 2) have; `outside` beyond them."""
    cells = grid.cells_of(points)
    inside = grid.holds(cells)
    result = np.full(len(points), outside, values.dtype)
    result[inside] = values[tuple(cells[inside].T)]
    return result


def to_frame(points: Array, pose: Pose2d) -> Array:
    """Map points (N, 2) of a frame into the frame that lies in it at `pose`."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    dx, dy = points[:, 0] - pose[0], points[:, 1] - pose[1]
    return np.stack([c * dx + s * dy, c * dy - s * dx], axis=1)


def from_frame(points: Array, pose: Pose2d) -> Array:
    """Map points (N, 2) of the frame that lies at `pose` into the frame around it."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    x, y = points[:, 0], points[:, 1]
    return np.stack([pose[0] + c * x - s * y, pose[1] + s * x + c * y], axis=1)


def resample(
    estimate: OccupancyGrid, raster: OccupancyGrid, pose: Pose2d = (0.0, 0.0, 0.0)
) -> NDArray[np.int8]:
    """Return the states of an estimate on the raster of another grid, (rows, columns) int8.

    pose: where the estimate's frame lies in the raster's frame, without one they are the same.
    """
    points = to_frame(raster.centres_of(raster.all_cells), pose)
    return sample_states(estimate, points).reshape(raster.cells.shape)


def observable(
    truth: OccupancyGrid, base_poses: Array, fov_rad: float, range_m: float
) -> tuple[Mask, Mask]:
    """Return the free cells in line of sight of some pose and the occupied cells first hit.

    base_poses: (N, 3) x, y, yaw. Sight is horizontal, `fov_rad` wide and `range_m` long.
    """
    cell_states = truth.states
    seen = np.zeros(cell_states.shape, bool)
    hit = np.zeros(cell_states.shape, bool)
    bearings = np.linspace(-fov_rad / 2, fov_rad / 2, BEARINGS)
    distances = np.arange(0.0, range_m, truth.resolution_m / 2)
    for x, y, yaw in _distinct(base_poses):
        heading = (yaw + bearings)[:, None]
        rays = np.stack([x + np.cos(heading) * distances, y + np.sin(heading) * distances], axis=-1)
        # What lies beyond the map has the state of its border.
        cells = truth.cells_of(rays).clip(0, np.array(seen.shape) - 1)
        row, column = cells[..., 0], cells[..., 1]
        state = cell_states[row, column]
        blocked = np.logical_or.accumulate(state != FREE, axis=1)
        seen[row[~blocked], column[~blocked]] = True
        first = blocked & (np.cumsum(blocked, axis=1) == 1) & (state == OCCUPIED)
        hit[row[first], column[first]] = True
    return seen & (cell_states == FREE), hit


def _distinct(base_poses: Array) -> Array:
    """Return the poses that differ noticeably from the one before."""
    kept = [base_poses[0]]
    for pose in base_poses[1:]:
        step = pose - kept[-1]
        if np.hypot(step[0], step[1]) >= SAME_PLACE_M or abs(step[2]) >= SAME_HEADING_RAD:
            kept.append(pose)
    return np.array(kept)


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
        return float(_values_at(self.truth, gain, from_frame(points, pose), outside).sum())


def _known_points(grid: OccupancyGrid) -> tuple[Array, Array]:
    """Return centres of free and of occupied cells, thinned evenly where there are many."""
    free, occupied = (thinned(np.argwhere(grid.states == state)) for state in (FREE, OCCUPIED))
    return grid.centres_of(free), grid.centres_of(occupied)


def thinned(rows: NDArray[Any]) -> NDArray[Any]:
    """Return rows (N, ...) evenly thinned where they are more than a score or a picture needs."""
    return rows[:: max(1, len(rows) // ENOUGH)]


def _gain_images(truth: OccupancyGrid) -> tuple[Array, Array]:
    """Return what a free and what an occupied estimated cell earn at each cell of the truth."""
    state = truth.states
    free_gain = np.where(state == FREE, 1.0, -1.0)
    reach = 2 * max(1, round(SAME_PLACE_M / 2 / truth.resolution_m)) + 1
    near = cv2.dilate((state == OCCUPIED).astype(np.uint8), np.ones((reach, reach), np.uint8))
    return free_gain, near.astype(np.float64)


def _refine(fit: _Fit, start: Pose2d) -> Pose2d:
    """Move to the best of the neighbouring poses until none is better, with steps that are halved
    down to what a cell shows. A turn moves points by as much as a step does.
    """
    best, best_score = start, fit.score(start)
    moves = np.array([move for move in product((-1, 0, 1), repeat=3) if any(move)])
    lever_m = float(np.hypot(*np.vstack([fit.free, fit.occupied]).T).mean())
    step_m = SAME_PLACE_M
    while step_m >= FINE * fit.truth.resolution_m:
        steps = moves * (step_m, step_m, step_m / max(lever_m, step_m))
        improved = True
        while improved:
            centre, improved = np.array(best), False
            for x, y, yaw in (centre + steps).tolist():
                score = fit.score((x, y, yaw))
                if score > best_score:
                    best, best_score, improved = (x, y, yaw), score, True
        step_m /= 2
    return best


def _search_everywhere(fit: _Fit) -> Pose2d:
    """Return the best pose over all headings and coarse translations by correlation."""
    scale = fit.truth.resolution_m / SAME_PLACE_M
    size = [max(1, round(side * scale)) for side in fit.free_gain.shape[::-1]]
    # Outside the truth nothing is free: shift the gains so that zero padding means a loss.
    free_gain = cv2.resize(fit.free_gain, size, interpolation=cv2.INTER_AREA) + 1.0
    occupied_gain = cv2.resize(fit.occupied_gain, size, interpolation=cv2.INTER_AREA)
    best, best_score = (0.0, 0.0, 0.0), -np.inf
    headings = np.linspace(-np.pi, np.pi, round(math.tau / SAME_HEADING_RAD), endpoint=False)
    # From the smallest turn on, so that a symmetric place is not turned over for nothing.
    for yaw in sorted(headings, key=abs):
        turned = from_frame(np.vstack([fit.free, fit.occupied]), (0.0, 0.0, float(yaw)))
        low = np.floor(turned.min(axis=0) / SAME_PLACE_M) * SAME_PLACE_M
        counts = [_histogram(part, low, turned) for part in np.split(turned, [len(fit.free)])]
        score = _correlate([free_gain, occupied_gain], counts)
        row, column = np.unravel_index(int(np.argmax(score)), score.shape)
        if score[row, column] > best_score:
            best_score = float(score[row, column])
            offset = np.array([column, row]) - np.array(counts[0].shape[::-1]) + 1
            shift = np.array(fit.truth.origin_xy_m) + offset * SAME_PLACE_M - low
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
    columns, rows = (np.floor((all_points.max(axis=0) - low) / SAME_PLACE_M) + 1).astype(int)
    cells = np.floor((points - low) / SAME_PLACE_M).astype(np.int64)
    flat = np.bincount(cells[:, 1] * columns + cells[:, 0], minlength=rows * columns)
    return flat.reshape(rows, columns).astype(np.float64)
