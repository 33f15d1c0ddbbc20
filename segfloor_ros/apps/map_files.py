"""Map files as map_server and Nav2 write them, read."""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.images import read_picture
from segfloor_ros.core.grid.occupancy import (
    FREE,
    FREE_PIXEL,
    FREE_THRESH,
    OCCUPIED,
    OCCUPIED_THRESH,
    UNKNOWN,
    UNKNOWN_PIXEL,
    OccupancyGrid,
)
from segfloor_ros.nodes.yaml_files import read_yaml

logger = logging.getLogger(__name__)

MODES = ('trinary', 'scale', 'raw')


def load_map(path: Path) -> OccupancyGrid:
    """Read a map YAML and its image, by the rules of map_server (modes trinary, scale and raw).

    Raises InputError naming the file when either is missing or malformed.
    """
    description = _read_description(path)
    image_path = path.parent / description['image']
    grey, opaque = _grey_and_opaque(read_picture(image_path))
    opaque |= description['mode'] != 'scale'
    if description['mode'] == 'trinary' and not description['negate']:
        is_unknown = _unknown_by_its_saver(grey, description['free_thresh'])
        if is_unknown.any():
            logger.warning(
                '%s: free_thresh = %g takes the grey level %d, which savers of maps write where '
                'nothing is known, for free; these %d cells are taken for unknown; correct it to '
                'free_thresh: %g, or Nav2 drives there', path, description['free_thresh'],
                UNKNOWN_PIXEL, np.count_nonzero(is_unknown), FREE_THRESH,
            )  # fmt: skip
        opaque &= ~is_unknown
    cells = _cells(grey, opaque, description)
    x, y, _ = description['origin']
    return OccupancyGrid(np.ascontiguousarray(cells[::-1]), description['resolution'], (x, y))


def is_map(path: Path) -> bool:
    """Whether a file looks like the YAML of a map."""
    if path.suffix not in ('.yaml', '.yml') or not path.is_file():
        return False
    text = path.read_bytes()[:4096].decode(errors='replace')
    return all(f'{key}:' in text for key in ('image', 'resolution', 'origin'))


def map_facts(grid: OccupancyGrid) -> dict[str, Any]:
    """Return areas in m² and the size of what is known in m, by name."""
    known = np.nonzero(grid.cells != UNKNOWN)[::-1]
    return {
        'free_m2': round(grid.area_m2(grid.states == FREE), 2),
        'occupied_m2': round(grid.area_m2(grid.states == OCCUPIED), 2),
        'size_m': [
            round(float(np.ptp(one) + 1) * grid.resolution_m, 2) if len(one) else 0.0
            for one in known
        ],
    }


def _unknown_by_its_saver(grey: NDArray[np.float64], free_thresh: float) -> NDArray[np.bool_]:
    """Return the pixels (H, W) that a saver of mode trinary wrote for unknown, though a reader by
    the letter takes them for free: as grey as they are, beside others that are free for certain.
    """
    is_free = 1 - grey / 255 < free_thresh
    unknown = is_free & (grey == UNKNOWN_PIXEL)
    return unknown if (is_free & (grey >= FREE_PIXEL)).any() else np.zeros_like(unknown)


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
    return np.where(opaque, cells, UNKNOWN).astype(np.int8)
