"""Map files as map_server and Nav2 read them, written: an image and a YAML file beside it."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.writing import (
    HASH_BYTES,
    MARK,
    YAML,
    Kind,
    check_output,
    hash_of,
    write_output,
)
from segfloor_ros.core.grid.occupancy import FREE_THRESH, OCCUPIED_THRESH, OccupancyGrid


def save_map(
    grid: OccupancyGrid, path: Path, mode: str = 'trinary', facts: Mapping[str, Any] | None = None
) -> None:
    """Write `path` (YAML) and the PGM of the same name beside it; both appear whole or not at all.

    Free, occupied and unknown are kept; with mode `raw`, the numbers of the cells. facts: further
    entries of the YAML. Raises InputError where they cannot be written.
    """
    check_map_output(path)
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
    image = _pgm_bytes(pixels)
    digest = hashlib.blake2b(image, digest_size=HASH_BYTES).hexdigest()
    text = f'# {MARK}, with an image {digest}\n{yaml.safe_dump(description, sort_keys=False)}'
    write_output(image_path, _image_of(path), image)
    write_output(path, YAML, text.encode())


def check_map_output(path: Path, inputs: Iterable[Path | str | None] = ()) -> None:
    """Raise InputError unless a map can be written to `path` (YAML) and the PGM beside it."""
    inputs = [*inputs]
    if path.suffix == '.pgm':
        raise InputError(f'{path}: is a name for the image; name the YAML file')
    check_output(path, YAML, inputs)
    check_output(path.with_suffix('.pgm'), _image_of(path), inputs)


def _image_of(path: Path) -> Kind:
    """Return the kind of the image that belongs to a map of segfloor and is unchanged since."""

    def is_own(image: Path) -> bool:
        has_map = path.is_file() and YAML.is_own(path)
        return has_map and hash_of(image) in path.read_text(errors='replace').partition('\n')[0]

    return Kind('image of a map', is_own)


def _pgm_bytes(pixels: NDArray[np.uint8]) -> bytes:
    rows, columns = pixels.shape
    return f'P5\n{columns} {rows}\n255\n'.encode() + pixels.tobytes()
