"""Map files as map_server and Nav2 read them, written: an image and a YAML file beside it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from segfloor_ros.core.errors import MapError
from segfloor_ros.core.files.results import replacing
from segfloor_ros.core.grid.occupancy import FREE_THRESH, OCCUPIED_THRESH, OccupancyGrid


def save_map(
    grid: OccupancyGrid, path: Path, mode: str = 'trinary', facts: Mapping[str, Any] | None = None
) -> None:
    """Write `path` (YAML) and the PGM of the same name beside it; both appear whole or not at all.

    Free, occupied and unknown are kept; with mode `raw`, the numbers of the cells. facts: further
    entries of the YAML. Raises MapError when the folder cannot be written.
    """
    image_path = path.with_suffix('.pgm')
    description = {
        'image': image_path.name,
        'mode': mode,
        'resolution': float(grid.resolution_m),
        'origin': [float(grid.origin_xy_m[0]), float(grid.origin_xy_m[1]), 0.0],
        'negate': 0,
        'occupied_thresh': OCCUPIED_THRESH,
        'free_thresh': FREE_THRESH,
        **(facts or {}),
    }
    pixels = grid.cells[::-1].view(np.uint8) if mode == 'raw' else grid.picture
    _replace_file(image_path, _pgm_bytes(pixels))
    _replace_file(path, yaml.safe_dump(description, sort_keys=False).encode())


def _pgm_bytes(pixels: NDArray[np.uint8]) -> bytes:
    rows, columns = pixels.shape
    return f'P5\n{columns} {rows}\n255\n'.encode() + pixels.tobytes()


def _replace_file(path: Path, content: bytes) -> None:
    try:
        with replacing(path) as file:
            file.write(content)
    except OSError as error:
        raise MapError(f'{path}: cannot write the map ({error.strerror})') from error
