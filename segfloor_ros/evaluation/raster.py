"""Grids brought onto one raster, and the part of a floor that a drive could have seen.

Probabilistic road maps (PRM) as a score of occupancy maps.

Random nodes on free floor, joined where the straight line between two of them is free. A road map
built on the estimate and replayed on the truth gives precision (an edge that hits something is a
false positive); one built on the truth and replayed on the estimate gives recall. The figures of
the Segfloor dissertation (2022, evaluation chapter) are means over 30 repetitions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.evaluation.truth import Pose2d
from segfloor_ros.geometry import Array
from segfloor_ros.grid.map_file import OccupancyGrid

FREE_BELOW = 20
OCCUPIED_FROM = 65
"""Occupancy values, in percent, that map files store as free and occupied."""

FREE, OCCUPIED, UNKNOWN = 0, 1, -1

BEARINGS = 361
SAME_PLACE_M = 0.1
SAME_HEADING_RAD = 0.05

Mask = NDArray[np.bool_]
Cells = NDArray[np.int64]

DRAWS_PER_NODE = 200
"""Free cells drawn per wanted node before giving up on the minimum distance."""


def states(grid: OccupancyGrid) -> NDArray[np.int8]:
    """Return the cells (rows, columns) int8 as `FREE`, `OCCUPIED` or `UNKNOWN`."""
    result = np.full(grid.cells.shape, UNKNOWN, np.int8)
    result[(grid.cells >= 0) & (grid.cells < FREE_BELOW)] = FREE
    result[grid.cells >= OCCUPIED_FROM] = OCCUPIED
    return result


def cell_centres(grid: OccupancyGrid) -> Array:
    """Return the centres (rows * columns, 2) of a grid's cells in its frame, row by row."""
    rows, columns = np.indices(grid.cells.shape)
    cells = np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5
    return np.array(grid.origin_xy_m) + cells * grid.resolution_m


def sample_states(
    cell_states: NDArray[np.int8], grid: OccupancyGrid, points: Array
) -> NDArray[np.int8]:
    """Return the states (N,) of the cells that hold points (N, 2) of the grid's frame; `UNKNOWN`
    outside.
    """
    cells = np.floor((points - np.array(grid.origin_xy_m)) / grid.resolution_m).astype(np.int64)
    column, row = cells[:, 0], cells[:, 1]
    height, width = cell_states.shape
    inside = (row >= 0) & (column >= 0) & (row < height) & (column < width)
    result = np.full(len(points), UNKNOWN, np.int8)
    result[inside] = cell_states[row[inside], column[inside]]
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


def resample(estimate: OccupancyGrid, raster: OccupancyGrid, pose: Pose2d) -> NDArray[np.int8]:
    """Return the states of an estimate on the raster of another grid, (rows, columns) int8.

    pose: where the estimate's frame lies in the raster's frame.
    """
    points = to_frame(cell_centres(raster), pose)
    return sample_states(states(estimate), estimate, points).reshape(raster.cells.shape)


def observable(
    truth: OccupancyGrid, base_poses: Array, fov_rad: float, range_m: float
) -> tuple[Mask, Mask]:
    """Return the free cells in line of sight of some pose and the occupied cells first hit.

    base_poses: (N, 3) x, y, yaw. Sight is horizontal, `fov_rad` wide and `range_m` long.
    """
    cell_states = states(truth)
    seen = np.zeros(cell_states.shape, bool)
    hit = np.zeros(cell_states.shape, bool)
    bearings = np.linspace(-fov_rad / 2, fov_rad / 2, BEARINGS)
    distances = np.arange(0.0, range_m, truth.resolution_m / 2)
    for x, y, yaw in _distinct(base_poses):
        heading = (yaw + bearings)[:, None]
        ray_x, ray_y = x + np.cos(heading) * distances, y + np.sin(heading) * distances
        row, column = _clipped_cells(truth, ray_x, ray_y)
        state = cell_states[row, column]
        blocked = np.logical_or.accumulate(state != FREE, axis=1)
        seen[row[~blocked], column[~blocked]] = True
        first = blocked & (np.cumsum(blocked, axis=1) == 1) & (state == OCCUPIED)
        hit[row[first], column[first]] = True
    return seen & (cell_states == FREE), hit


def _clipped_cells(
    grid: OccupancyGrid, x: Array, y: Array
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return rows and columns of points; those outside fall on the border."""
    height, width = grid.cells.shape
    row = ((y - grid.origin_xy_m[1]) / grid.resolution_m).astype(np.int64)
    column = ((x - grid.origin_xy_m[0]) / grid.resolution_m).astype(np.int64)
    return np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)


def _distinct(base_poses: Array) -> Array:
    """Return the poses that differ noticeably from the one before."""
    kept = [base_poses[0]]
    for pose in base_poses[1:]:
        step = pose - kept[-1]
        if np.hypot(step[0], step[1]) >= SAME_PLACE_M or abs(step[2]) >= SAME_HEADING_RAD:
            kept.append(pose)
    return np.array(kept)


@dataclass(frozen=True)
class RoadMapPlan:
    """How road maps are built. nodes: wanted number of nodes, 0 chooses one per 1.5 m² of floor,
    between 20 (a corridor) and 400. min_distance_m: between nodes. max_edge_m: longest edge.
    """

    nodes: int = 0
    min_distance_m: float = 0.25
    max_edge_m: float = 2.0
    repetitions: int = 30
    seed: int = 0

    def nodes_for(self, area_m2: float) -> int:
        """Return the number of nodes for a floor of this area."""
        return self.nodes or int(np.clip(area_m2 / 1.5, 20, 400))


@dataclass(frozen=True)
class Spread:
    """Mean and standard deviation over the repetitions, as fractions."""

    mean: float
    std: float

    @classmethod
    def of(cls, values: list[float]) -> Spread:
        """Return the spread of some values; without values both are 0."""
        return cls(float(np.mean(values)), float(np.std(values))) if values else cls(0.0, 0.0)


@dataclass(frozen=True)
class RoadMapScore:
    """PRM precision and recall. An estimate without edges scores 0, as it helps nobody to move."""

    precision: Spread
    recall: Spread


def score_road_maps(
    estimate_free: Mask, truth_free: Mask, wanted_free: Mask, resolution_m: float, plan: RoadMapPlan
) -> RoadMapScore:
    """Score the free cells of an estimate (rows, columns) against the truth on the same raster.

    wanted_free: the part of the true floor on which recall is measured, e.g. what was observable.
    """
    rng = np.random.default_rng(plan.seed)
    count = plan.nodes_for(float(wanted_free.sum()) * resolution_m**2)

    def replay(built_on: Mask, replayed_on: Mask) -> list[float]:
        """Return the share of one road map's edges that is free in `replayed_on`, if it has any."""
        nodes = sample_nodes(built_on, count, plan.min_distance_m / resolution_m, rng)
        starts, ends = candidate_edges(nodes, plan.max_edge_m / resolution_m)
        built = edges_are_free(built_on, starts, ends)
        replayed = edges_are_free(replayed_on, starts[built], ends[built])
        return [float(replayed.mean())] if built.any() else []

    precisions: list[float] = []
    recalls: list[float] = []
    for _ in range(plan.repetitions):
        precisions += replay(estimate_free, truth_free)
        recalls += replay(wanted_free, estimate_free)
    return RoadMapScore(Spread.of(precisions), Spread.of(recalls))


def sample_nodes(
    free: Mask, count: int, min_distance_cells: float, rng: np.random.Generator
) -> Cells:
    """Return up to `count` random free cells (N, 2) = (row, column), no two nearer than the
    minimum distance.
    """
    rows, columns = np.nonzero(free)
    if not len(rows):
        return np.zeros((0, 2), np.int64)
    margin = int(np.ceil(min_distance_cells))
    available = np.pad(free, margin)
    width = available.shape[1]
    cells = (rows + margin) * width + columns + margin
    available, disc = available.ravel(), _disc(min_distance_cells, margin, width)
    nodes: list[int] = []
    for _ in range(count * DRAWS_PER_NODE):
        cell = cells[rng.integers(len(cells))]
        if available[cell]:
            nodes.append(int(cell))
            available[cell + disc] = False
            if len(nodes) == count:
                break
    return np.stack(np.divmod(np.array(nodes), width), axis=1) - margin


def _disc(radius_cells: float, margin: int, width: int) -> Cells:
    """Return the flat offsets of the cells nearer than a radius in rasters of this width."""
    dy, dx = np.mgrid[-margin : margin + 1, -margin : margin + 1]
    near = (np.hypot(dy, dx) < radius_cells) | ((dy == 0) & (dx == 0))
    return (dy * width + dx)[near]


def candidate_edges(nodes: Cells, max_edge_cells: float) -> tuple[Cells, Cells]:
    """Return the ends (E, 2) and (E, 2) of all pairs of nodes no farther apart than the limit."""
    first, second = np.triu_indices(len(nodes), k=1)
    starts, ends = nodes[second], nodes[first]
    near = np.hypot(*(ends - starts).T) <= max_edge_cells
    return starts[near], ends[near]


def edges_are_free(free: Mask, starts: Cells, ends: Cells) -> Mask:
    """Return for each edge (E,) whether the straight line between two cells stays on free cells.

    Lines are sampled twice per cell of their length, both ends included.
    """
    lengths = np.hypot(*(ends - starts).T)
    samples = (2 * lengths).astype(np.int64) + 2
    edge = np.repeat(np.arange(len(starts)), samples)
    first_sample = np.cumsum(samples) - samples
    share = (np.arange(len(edge)) - first_sample[edge]) * (1.0 / (samples - 1))[edge]
    cells = np.round(starts[edge] + (ends - starts)[edge] * share[:, None]).astype(np.int64)
    blocked = np.bincount(edge, weights=~free[cells[:, 0], cells[:, 1]], minlength=len(starts))
    return blocked == 0
