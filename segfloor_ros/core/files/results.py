"""Saved maps: named arrays and a header in one file, which is checked when it is read. A zip
archive of `.npy` arrays, without pickled objects, so that reading it runs no code; every member has
a checksum.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.errors import InputError, os_errors
from segfloor_ros.core.files.arrays import MapFile
from segfloor_ros.core.files.whole import check_file, json_object
from segfloor_ros.core.files.writing import Kind, output_file

FORMAT = 'segfloor map'
VERSION = 1
HEADER = 'header.json'
COMPRESSION_LEVEL = 3

MAX_RATIO, SMALL = 20, 1 << 24
"""A map unpacks to at most so many times its size, and a small one to so many bytes more."""


def write_map_file(path: Path, saved: MapFile, inputs: Iterable[Path | str | None] = ()) -> None:
    """Write a map, in place of an older one that is none of the inputs. Raises InputError."""
    with output_file(path, SAVED_MAP, inputs) as file:
        write_to(file, saved)


def read_map_file(path: Path) -> MapFile:
    """Read a map. Raises InputError, in one line, for a file that is missing, truncated, damaged,
    of another kind or of a newer version.
    """
    size = check_file(path)
    with os_errors(f'{path}: cannot be read'), path.open('rb') as file:
        return _read(file, size, str(path))


def is_map_file(path: Path) -> bool:
    """Whether a file is a map, of whatever version."""
    try:
        with zipfile.ZipFile(path) as archive, archive.open(HEADER) as header:
            found = json_object(header.read(SMALL))
    except Exception:  # as in `from_bytes`
        return False
    return found is not None and found.get('format') == FORMAT


SAVED_MAP = Kind('saved map', is_map_file)


def to_bytes(saved: MapFile, compress: bool = True) -> bytes:
    """Return a map as the bytes of its file; the same map gives the same bytes."""
    buffer = io.BytesIO()
    write_to(buffer, saved, compress)
    return buffer.getvalue()


def write_to(file: IO[bytes], saved: MapFile, compress: bool = True) -> None:
    """Write a map to an open file. Without `compress` that is many times faster and takes half as
    much space again.
    """
    header = {**saved.header, 'format': FORMAT, 'version': VERSION}
    kind = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
    with zipfile.ZipFile(file, 'w', kind, compresslevel=COMPRESSION_LEVEL) as archive:
        _add(archive, HEADER, json.dumps(header, sort_keys=True).encode())
        for part, arrays in sorted(saved.parts.items()):
            for name, array in sorted(arrays.items()):
                member = io.BytesIO()
                np.save(member, np.ascontiguousarray(array), allow_pickle=False)
                _add(archive, f'{part}/{name}.npy', member.getvalue())


def from_bytes(data: bytes, name: str) -> MapFile:
    """Return the map of a file's bytes; name: of the file, for what is wrong with it."""
    return _read(io.BytesIO(data), len(data), name)


def _read(file: IO[bytes], size: int, name: str) -> MapFile:
    try:
        with zipfile.ZipFile(file) as archive:
            _check_sizes(archive, size)
            saved = MapFile(_header(archive, name))
            for member in archive.namelist():
                if member != HEADER:
                    part, _, array = member.removesuffix('.npy').partition('/')
                    saved.parts.setdefault(part, {})[array] = _array(archive.read(member))
            return saved
    except InputError:
        raise
    except Exception:  # damaged bytes make the library fail in any way, anywhere
        words = 'is truncated or damaged, or no map of segfloor'
        raise InputError(f'{name}: {words}; give a file of --save-map') from None


def _check_sizes(archive: zipfile.ZipFile, packed: int) -> None:
    """Raise ValueError for more than maps hold in so many bytes; members that lie over one another
    take no more room in the file than one of them.
    """
    if sum(member.file_size for member in archive.infolist()) > MAX_RATIO * packed + SMALL:
        raise ValueError('unpacks to more than a map')


def _header(archive: zipfile.ZipFile, name: str) -> dict[str, Any]:
    """Return the header of a map. Raises InputError for a file that is none."""
    found = json_object(archive.read(HEADER)) if HEADER in archive.namelist() else None
    if found is None or found.get('format') != FORMAT:
        raise InputError(f'{name}: is no map of segfloor; give a file of --save-map')
    if found.get('version') != VERSION:
        raise InputError(
            f'{name}: is a map of version {str(found.get("version"))[:9]}, this release reads '
            f'version {VERSION}; take the release that wrote it'
        )
    return found


def _array(content: bytes) -> NDArray[Any]:
    """Return the array of an `.npy` file of numbers. Raises ValueError where its header asks for
    more than the file has.
    """
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    if version != (1, 0):
        raise ValueError(f'arrays are of version 1.0, not {version}')
    shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(file)
    if is_fortran or dtype.kind not in 'biuf':
        raise ValueError('arrays are of numbers, row by row')
    return np.frombuffer(content, dtype, offset=file.tell()).reshape(shape).copy()


def _add(archive: zipfile.ZipFile, name: str, content: bytes | memoryview) -> None:
    member = zipfile.ZipInfo(name)  # without the time of day
    member.compress_type = archive.compression
    archive.writestr(member, content)
