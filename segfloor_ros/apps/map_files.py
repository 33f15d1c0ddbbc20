"""Map files as map_server and Nav2 write them, read."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.images import read_picture
from segfloor_ros.core.grid.occupancy import (
    FREE,
    FREE_THRESH,
    OCCUPIED,
    OCCUPIED_THRESH,
    UNKNOWN,
    OccupancyGrid,
)
from segfloor_ros.nodes.yaml_files import read_yaml

MODES = ('trinary', 'scale', 'raw')


def load_map(path: Path) -> OccupancyGrid:
    """Read a map YAML and its image, by the rules of map_server (modes trinary, scale and raw).

    Raises InputError naming the file when either is missing or malformed.
    """
    description = _read_description(path)
    image_path = path.parent / description['image']
    grey, opaque = _grey_and_opaque(read_picture(image_path))
    cells = _cells(grey, opaque, description)
    x, y, _ = description['origin']
    return OccupancyGrid(np.ascontiguousarray(cells[::-1]), description['resolution'], (x, y))


def _read_description(path: Path) -> dict[str, Any]:
    """Return the checked values of a map YAML, with the defaults of map_server."""
    document = read_yaml(path, 'image, resolution and origin')
    missing = [key for key in ('image', 'resolution', 'origin') if key not in document]
    if missing:
        raise InputError(f'{path}: {missing[0]} is missing')
    try:
        checked = {
            'image': str(document['image']),
            'mode': str(document.get('mode', 'trinary')),
            'resolution': float(document['resolution']),
            'origin': [float(value) for value in document['origin']],
            'negate': bool(int(document.get('negate', 0))),
            'occupied_thresh': float(document.get('occupied_thresh', OCCUPIED_THRESH)),
            'free_thresh': float(document.get('free_thresh', FREE_THRESH)),
        }
    except (TypeError, ValueError, OverflowError):
        raise InputError(f'{path}: a value is not a number where one is needed') from None
    _check_description(path, checked)
    return checked


def _check_description(path: Path, values: dict[str, Any]) -> None:
    if values['mode'] not in MODES:
        raise InputError(f'{path}: mode {values["mode"]!r}: expected one of {", ".join(MODES)}')
    if not (math.isfinite(values['resolution']) and values['resolution'] > 0):
        raise InputError(f'{path}: resolution {values["resolution"]:g} m must be positive')
    if len(values['origin']) != 3 or not all(map(math.isfinite, values['origin'])):
        raise InputError(f'{path}: origin must be three numbers: x, y, yaw')
    if values['origin'][2] != 0:
        raise InputError(f'{path}: origin is turned by {values["origin"][2]:g} rad, expected yaw 0')
    if not 0 < values['free_thresh'] < values['occupied_thresh'] < 1:
        raise InputError(f'{path}: expected 0 < free_thresh < occupied_thresh < 1')


def _grey_and_opaque(image: NDArray[np.uint8]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return brightness (H, W) of 0 to 255 and where the image is not transparent."""
    if image.ndim == 2:
        return image.astype(np.float64), np.ones(image.shape, np.bool_)
    channels = image.shape[2]
    colours = image[..., : 3 if channels >= 3 else 1].astype(np.float64)
    opaque = image[..., -1] == 255 if channels in (2, 4) else np.ones(image.shape[:2], np.bool_)
    return colours.mean(axis=2), opaque


def _cells(
    grey: NDArray[np.float64], opaque: NDArray[np.bool_], values: dict[str, Any]
) -> NDArray[np.int8]:
    """Return cells for pixels by the mode's rule; row order is left as it is."""
    if values['mode'] == 'raw':
        return np.where(grey <= OCCUPIED, grey, UNKNOWN).astype(np.int8)
    occupancy = grey / 255 if values['negate'] else 1 - grey / 255
    low, high = values['free_thresh'], values['occupied_thresh']
    between: Any = UNKNOWN
    if values['mode'] == 'scale':
        between = np.where(opaque, np.rint((occupancy - low) / (high - low) * 100), UNKNOWN)
    cells = np.where(occupancy < low, FREE, np.where(occupancy > high, OCCUPIED, between))
    if values['mode'] == 'scale':
        cells = np.where(opaque, cells, UNKNOWN)
    return cells.astype(np.int8)
