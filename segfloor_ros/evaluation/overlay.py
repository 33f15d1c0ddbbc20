"""A picture of an estimated map on the true one."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.errors import InputError
from segfloor_ros.evaluation.map_score import Comparison
from segfloor_ros.evaluation.raster import FREE, OCCUPIED

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


def draw_overlay(maps: Comparison) -> NDArray[np.uint8]:
    """Return a colour picture (BGR), y up, enlarged to about a thousand pixels, with a legend."""
    picture = _coloured(maps)[::-1]
    factor = max(1, WANTED_SIDE_PX // max(picture.shape[:2]))
    picture = np.repeat(np.repeat(picture, factor, axis=0), factor, axis=1)
    return np.vstack([picture, _legend(picture.shape[1])])


def save_overlay(maps: Comparison, path: Path) -> None:
    """Write the picture as PNG. Raises InputError where it cannot be written."""
    written, data = cv2.imencode('.png', draw_overlay(maps))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data.tobytes() if written else b'')
    except OSError as error:
        raise InputError(f'{path}: cannot write the overlay ({error.strerror})') from None


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
