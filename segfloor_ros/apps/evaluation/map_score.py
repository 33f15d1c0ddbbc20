"""The score of an occupancy map against the true one, by road maps and cells, and its picture.

Probabilistic road maps (PRM): random nodes on free floor, connected where the straight line between
two of them is free. A road map built on the estimate and replayed on the truth gives precision (an
edge that hits something is a false positive); one built on the truth and replayed on the estimate
gives recall. The figures of the Segfloor dissertation (2022, evaluation chapter) are means over 30
repetitions.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.apps.evaluation.maps import SAME_PLACE_M, MapTruth, Mask, observable, resample
from segfloor_ros.core.files.images import png_bytes
from segfloor_ros.core.geometry import Pose2d
from segfloor_ros.core.grid.occupancy import (
    FREE,
    OCCUPIED,
    UNKNOWN_PIXEL,
    Cells,
    OccupancyGrid,
    enlarged,
)

DEFAULT_RANGE_M = 5.0

COLOURS = {
    'free, agree': (255, 255, 255),
    'occupied, agree': (40, 40, 40),
    'free, but is not': (60, 60, 230),
    'occupied, but is free': (190, 70, 190),
    'floor missed': (245, 200, 130),
    'obstacle missed': (0, 165, 255),
    'no evidence': (UNKNOWN_PIXEL,) * 3,
}
"""Blue, green, red of each class in the picture."""

LEGEND_ROW_PX = 26


@dataclass(frozen=True)
class RoadMapPlan:
    """How road maps are built. nodes: wanted number of nodes, 0 chooses one per 1.5 m² of floor,
    between 20 (a corridor) and 400. min_distance_m: between nodes. max_edge_m: longest edge.
    draws_per_node: free cells drawn per wanted node before giving up on the minimum distance.
    """

    nodes: int = 0
    min_distance_m: float = 0.25
    max_edge_m: float = 2.0
    repetitions: int = 30
    seed: int = 0
    draws_per_node: int = 200

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


@dataclass(frozen=True)
class CellScore:
    """Shares of cells. free_precision: of the cells called free that are. free_recall: of the
    wanted floor that is called free. occupied_precision and occupied_recall: of the obstacle
    cells, those with one of the other map within the tolerance.
    """

    free_precision: float
    free_recall: float
    occupied_precision: float
    occupied_recall: float


@dataclass(frozen=True)
class MapScore:
    """Everything about one estimated map. raw and opened: road map scores of the free cells as
    they are and after a morphological opening (3x3). observable_only: recall counts only what
    the drive could see. alignment: where the estimate's frame lies in the truth's.
    """

    raw: RoadMapScore
    opened: RoadMapScore
    cells: CellScore
    nodes: int
    area_m2: float
    observable_only: bool
    alignment: Pose2d


@dataclass(frozen=True)
class Comparison:
    """Both maps on the truth's raster: states (rows, columns) int8, the floor that counts for
    recall and the obstacles that do.
    """

    estimate: NDArray[np.int8]
    truth: NDArray[np.int8]
    wanted_floor: Mask
    wanted_obstacles: Mask
    resolution_m: float


def compare(
    estimate: OccupancyGrid,
    truth: MapTruth,
    alignment: Pose2d | None = None,
    range_m: float = DEFAULT_RANGE_M,
) -> Comparison:
    """Bring the estimate onto the truth's raster. alignment: where its frame lies in the truth's;
    None: where the drive starts, as far as that is known. Where the drive is known, only what it
    could see within `range_m` counts for recall.
    """
    true_states = truth.grid.states
    floor, obstacles = true_states == FREE, true_states == OCCUPIED
    if truth.base_poses is not None:
        floor, obstacles = observable(truth.grid, truth.base_poses, truth.fov_rad, range_m)
    return Comparison(
        resample(estimate, truth.grid, alignment or truth.start),
        true_states,
        floor,
        obstacles,
        truth.grid.resolution_m,
    )


def score_map(
    estimate: OccupancyGrid,
    truth: MapTruth,
    alignment: Pose2d | None = None,
    plan: RoadMapPlan = RoadMapPlan(),
    range_m: float = DEFAULT_RANGE_M,
) -> MapScore:
    """Score an estimated map. alignment, range_m: as in `compare`."""
    maps = compare(estimate, truth, alignment, range_m)
    free = maps.estimate == FREE
    area_m2 = float(maps.wanted_floor.sum()) * maps.resolution_m**2
    road_maps = [
        score_road_maps(part, maps.truth == FREE, maps.wanted_floor, maps.resolution_m, plan)
        for part in (free, opened(free))
    ]
    return MapScore(
        road_maps[0],
        road_maps[1],
        score_cells(maps),
        plan.nodes_for(area_m2),
        area_m2,
        truth.base_poses is not None,
        alignment or truth.start,
    )


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
    for _ in range(count * RoadMapPlan.draws_per_node):
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


def opened(mask: Mask) -> Mask:
    """Return a mask without its lone rays and specks: erosion and dilation by 3x3 cells."""
    kernel = np.ones((3, 3), np.uint8)
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0


def score_cells(maps: Comparison, tolerance_m: float = SAME_PLACE_M) -> CellScore:
    """Return precision and recall per cell, obstacles within `tolerance_m` of each other."""
    free, occupied = maps.estimate == FREE, maps.estimate == OCCUPIED
    reach = 2 * round(tolerance_m / maps.resolution_m) + 1
    return CellScore(
        free_precision=_share(maps.truth == FREE, free),
        free_recall=_share(free, maps.wanted_floor),
        occupied_precision=_share(_grown(maps.truth == OCCUPIED, reach), occupied),
        occupied_recall=_share(_grown(occupied, reach), maps.wanted_obstacles),
    )


def _share(true_where: Mask, among: Mask) -> float:
    total = int(among.sum())
    return float((true_where & among).sum()) / total if total else 0.0


def _grown(mask: Mask, side: int) -> Mask:
    return cv2.dilate(mask.astype(np.uint8), np.ones((side, side), np.uint8)) > 0


def draw_overlay(maps: Comparison) -> NDArray[np.uint8]:
    """Return a colour picture (BGR), y up, enlarged, with a legend."""
    picture = enlarged(coloured(maps)[::-1])
    return np.vstack([picture, _legend(picture.shape[1])])


def overlay_png(maps: Comparison) -> bytes:
    """Return the picture as a PNG file."""
    return png_bytes(draw_overlay(maps))


def coloured(maps: Comparison) -> NDArray[np.uint8]:
    """Return the picture (rows, columns, 3) BGR, a pixel a cell, the first row at the lowest y."""
    estimate, truth = maps.estimate, maps.truth
    free, occupied = estimate == FREE, estimate == OCCUPIED
    picture = np.full((*truth.shape, 3), COLOURS['no evidence'], np.uint8)
    picture[maps.wanted_floor & ~free] = COLOURS['floor missed']
    picture[maps.wanted_obstacles & ~occupied] = COLOURS['obstacle missed']
    picture[free & (truth == FREE)] = COLOURS['free, agree']
    picture[occupied & (truth == OCCUPIED)] = COLOURS['occupied, agree']
    picture[free & (truth != FREE)] = COLOURS['free, but is not']
    picture[occupied & (truth == FREE)] = COLOURS['occupied, but is free']
    return picture


def _legend(width: int) -> NDArray[np.uint8]:
    legend = list(COLOURS.items())
    columns = max(1, width // 240)
    rows = -(-len(legend) // columns)
    strip = np.full((rows * LEGEND_ROW_PX + 6, width, 3), 250, np.uint8)
    for index, (name, colour) in enumerate(legend):
        x = 10 + (index % columns) * (width // columns)
        y = 6 + (index // columns) * LEGEND_ROW_PX
        cv2.rectangle(strip, (x, y), (x + 18, y + 18), colour, cv2.FILLED)
        cv2.rectangle(strip, (x, y), (x + 18, y + 18), (120, 120, 120), 1)
        cv2.putText(
            strip, name, (x + 26, y + 14), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (30, 30, 30), 1,
            cv2.LINE_AA,
        )  # fmt: skip
    return strip
