"""The score of an occupancy map against the true one, by road maps and cells, and its picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.evaluation.raster import (
    FREE,
    OCCUPIED,
    Mask,
    RoadMapPlan,
    RoadMapScore,
    observable,
    resample,
    score_road_maps,
    states,
)
from segfloor_ros.evaluation.truth import MapTruth, Pose2d
from segfloor_ros.files.results import write_file
from segfloor_ros.grid.map_file import OccupancyGrid

DEFAULT_RANGE_M = 5.0
DEFAULT_TOLERANCE_M = 0.1
DEFAULT_PLAN = RoadMapPlan()

Colour = tuple[int, int, int]

AGREE_FREE: Colour = (255, 255, 255)

AGREE_OCCUPIED: Colour = (40, 40, 40)

FALSE_FREE: Colour = (60, 60, 230)

FALSE_OCCUPIED: Colour = (190, 70, 190)

MISSED_FLOOR: Colour = (245, 200, 130)

MISSED_OBSTACLE: Colour = (0, 165, 255)

NOTHING: Colour = (214, 214, 214)

LEGEND = (
    ('free, agree', AGREE_FREE),
    ('occupied, agree', AGREE_OCCUPIED),
    ('free, but is not', FALSE_FREE),
    ('occupied, but is free', FALSE_OCCUPIED),
    ('floor missed', MISSED_FLOOR),
    ('obstacle missed', MISSED_OBSTACLE),
)
"""Name and colour (blue, green, red) of each class in the picture."""

WANTED_SIDE_PX = 1000

LEGEND_ROW_PX = 26


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
    true_states = states(truth.grid)
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
    plan: RoadMapPlan = DEFAULT_PLAN,
    range_m: float = DEFAULT_RANGE_M,
    tolerance_m: float = DEFAULT_TOLERANCE_M,
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
        score_cells(maps, tolerance_m),
        plan.nodes_for(area_m2),
        area_m2,
        truth.base_poses is not None,
        alignment or truth.start,
    )


def opened(mask: Mask) -> Mask:
    """Return a mask without its lone rays and specks: erosion and dilation by 3x3 cells."""
    kernel = np.ones((3, 3), np.uint8)
    return cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0


def score_cells(maps: Comparison, tolerance_m: float = DEFAULT_TOLERANCE_M) -> CellScore:
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
    """Return a colour picture (BGR), y up, enlarged to about a thousand pixels, with a legend."""
    picture = _coloured(maps)[::-1]
    factor = max(1, WANTED_SIDE_PX // max(picture.shape[:2]))
    picture = np.repeat(np.repeat(picture, factor, axis=0), factor, axis=1)
    return np.vstack([picture, _legend(picture.shape[1])])


def overlay_png(maps: Comparison) -> bytes:
    """Return the picture as a PNG file."""
    return cv2.imencode('.png', draw_overlay(maps))[1].tobytes()


def save_overlay(maps: Comparison, path: Path) -> None:
    """Write the picture as PNG. Raises InputError where it cannot be written."""
    write_file(path, overlay_png(maps))


def _coloured(maps: Comparison) -> NDArray[np.uint8]:
    estimate, truth = maps.estimate, maps.truth
    free, occupied = estimate == FREE, estimate == OCCUPIED
    picture = np.full((*truth.shape, 3), NOTHING, np.uint8)
    picture[maps.wanted_floor & ~free] = MISSED_FLOOR
    picture[maps.wanted_obstacles & ~occupied] = MISSED_OBSTACLE
    picture[free & (truth == FREE)] = AGREE_FREE
    picture[occupied & (truth == OCCUPIED)] = AGREE_OCCUPIED
    picture[free & (truth != FREE)] = FALSE_FREE
    picture[occupied & (truth == FREE)] = FALSE_OCCUPIED
    return picture


def _legend(width: int) -> NDArray[np.uint8]:
    columns = max(1, width // 240)
    rows = -(-len(LEGEND) // columns)
    strip = np.full((rows * LEGEND_ROW_PX + 6, width, 3), 250, np.uint8)
    for index, (name, colour) in enumerate(LEGEND):
        x = 10 + (index % columns) * (width // columns)
        y = 6 + (index // columns) * LEGEND_ROW_PX
        cv2.rectangle(strip, (x, y), (x + 18, y + 18), colour, cv2.FILLED)
        cv2.rectangle(strip, (x, y), (x + 18, y + 18), (120, 120, 120), 1)
        cv2.putText(
            strip, name, (x + 26, y + 14), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (30, 30, 30), 1,
            cv2.LINE_AA,
        )  # fmt: skip
    return strip
