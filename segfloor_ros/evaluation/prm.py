"""Probabilistic road maps (PRM) as a score of occupancy maps.

Random nodes on free floor, joined where the straight line between two of them is free. A road map
built on the estimate and replayed on the truth gives precision (an edge that hits something is a
false positive); one built on the truth and replayed on the estimate gives recall. The figures of
the Segfloor dissertation (2022, evaluation chapter) are means over 30 repetitions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]
Cells = NDArray[np.int64]

DRAWS_PER_NODE = 200
"""Free cells drawn per wanted node before giving up on the minimum distance."""


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
