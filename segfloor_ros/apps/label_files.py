"""Maps of classes: as files, as pictures, and as masks for the costmap filters of Nav2."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.apps.map_files import load_map
from segfloor_ros.core.errors import InputError, SettingsError
from segfloor_ros.core.grid.occupancy import FREE, UNKNOWN, OccupancyGrid
from segfloor_ros.core.plugins.semantics.label_map import Labels, numbered
from segfloor_ros.core.plugins.semantics.outputs import UNLABELLED
from segfloor_ros.core.settings import suggestion
from segfloor_ros.nodes.map_files import save_map
from segfloor_ros.nodes.yaml_files import read_yaml

HUE_STEP = 111.2
"""Half degrees of OpenCV's hue from one class to the next: by the golden ratio, any number of hues
lies apart."""

LEGEND_ROW_PX, LEAST_SIDE_PX = 22, 600


def labels_of(numbers: OccupancyGrid, classes: list[str]) -> Labels:
    """Return what `numbered` made of the labels of cells."""
    cells = np.where(numbers.cells == UNKNOWN, UNLABELLED, numbers.cells).astype(np.uint8)
    return Labels(classes, cells, None)


def save_labels(path: Path, grid: OccupancyGrid, labels: Labels) -> None:
    """Write the labels of cells as a map for map_server, mode raw, with the names of the classes
    in its YAML. Raises InputError.
    """
    assert labels.cells is not None
    save_map(numbered(grid, labels.cells), path, 'raw', {'classes': labels.classes})


def class_colours(count: int) -> NDArray[np.uint8]:
    """Return the colour (count, 3) BGR of each class."""
    hsv = np.zeros((1, count, 3), np.uint8)
    hsv[0, :, 0] = (np.arange(count) * HUE_STEP) % 180
    hsv[0, :, 1:] = 170, 230
    return cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)[0]


def draw_labels(grid: OccupancyGrid, labels: Labels) -> NDArray[np.uint8]:
    """Return a picture (H, W, 3) BGR of a map with the colour of each class, light where it is
    free, and a legend below.
    """
    assert labels.cells is not None
    colours = class_colours(len(labels.classes))
    picture = cv2.cvtColor(np.ascontiguousarray(grid.picture), cv2.COLOR_GRAY2BGR)
    cells, kinds = labels.cells[::-1], grid.cells[::-1]
    known = cells < len(labels.classes)
    painted = colours[cells[known]].astype(np.uint16)
    free = (kinds[known] == FREE)[:, None]
    picture[known] = np.where(free, (painted + 255) // 2, painted)
    finer = max(1, -(-LEAST_SIDE_PX // max(picture.shape[:2])))
    picture = np.kron(picture, np.ones((finer, finer, 1), np.uint8))
    shown = [i for i in range(len(labels.classes)) if (labels.cells == i).any()]
    legend = np.full((LEGEND_ROW_PX * (len(shown) + 1), picture.shape[1], 3), 255, np.uint8)
    for line, i in enumerate(shown):
        top, side = line * LEGEND_ROW_PX + 5, LEGEND_ROW_PX - 8
        cv2.rectangle(legend, (8, top), (8 + side, top + side), colours[i].tolist(), cv2.FILLED)
        where = (16 + side, top + side - 1)
        cv2.putText(legend, labels.classes[i], where, 0, 0.5, (40, 40, 40), 1, cv2.LINE_AA)
    return np.vstack([picture, legend])


def filter_mask(path: Path, percent: dict[str, int]) -> OccupancyGrid:
    """Return a mask for Nav2's costmap filters from the labels of a map (`save_labels`): cells of
    classes by name get their percentage, others 0. Raises InputError for a file without classes,
    SettingsError for a class it does not have.
    """
    grid = load_map(path)
    names = read_yaml(path, 'a map with classes').get('classes')
    if not isinstance(names, list):
        raise InputError(f'{path}: names no classes; give map_labels.yaml of a run with --network')
    cells = np.zeros(grid.cells.shape, np.int8)
    for name, value in percent.items():
        if name not in names:
            near = suggestion(name, names)
            raise SettingsError(f'{name} is none of {", ".join(names)} in {path}{near}')
        cells[grid.cells == names.index(name)] = value
    return OccupancyGrid(cells, grid.resolution_m, grid.origin_xy_m)
