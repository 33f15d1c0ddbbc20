"""The one place that writes results. A folder of results knows by a marker which files in it are
its own; no other file is ever replaced or removed, and no link is followed.

Saved maps: named arrays and a header in one file, which is checked when it is read. A zip archive
of `.npy` arrays, without pickled objects, so that reading it runs no code; every member has a
checksum. It is written beside its target and moved into place.
"""

from __future__ import annotations

import ctypes
import errno
import io
import json
import os
import shutil
import subprocess
import tempfile
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path, PurePosixPath
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.errors import InputError, os_errors
from segfloor_ros.core.files.arrays import MapFile
from segfloor_ros.core.files.whole import check_file, json_object, read_json, read_text

MARKER = '.segfloor_result'
"""In a folder of results: the files in it that are its own, one a line."""

SCRATCH = '.segfloor-'
"""Begins the names of folders in the making."""

BEFORE_MARKERS = ('map.pgm', 'map.yaml', 'trajectory.txt', 'keyframes.txt', 'labelled_cloud.ply',
                  'camera_trajectory.txt', 'summary.json', 'settings.yaml', 'report.html',
                  'floor_masks', 'moving_masks', 'floor_debug', 'overlay.png', 'log.txt',
                  'saved.map', 'measured.json')  # fmt: skip
"""What releases without a marker wrote beside their summary.json."""

RENDERED = 'rendered_from.txt'
"""In a rendered drive: of what."""

AT_CWD, RENAME_EXCHANGE = -100, 2
"""Of renameat2(2)."""

FORMAT = 'segfloor map'
VERSION = 1
HEADER = 'header.json'
COMPRESSION_LEVEL = 3

MAX_RATIO, SMALL = 20, 1 << 24
"""A map unpacks to at most so many times its size, and a small one to so many bytes more."""


@contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """Write a file beside its target and move it into place at the end of the block; after an error
    nothing is left of it. Raises OSError, also where the target is a link.
    """
    if path.is_symlink():
        raise OSError(errno.ELOOP, 'it is a link; give the file it leads to')
    written = path.with_name(f'.{path.name}.{os.getpid()}.part')
    try:
        with written.open('wb') as file:
            yield file
        written.replace(path)
    finally:
        written.unlink(missing_ok=True)


@contextmanager
def writing(path: Path) -> Iterator[IO[bytes]]:
    """Write a file that was named, in place of an older one, to the disk. Raises InputError."""
    with os_errors(f'{path}: cannot be written'):
        path.absolute().parent.mkdir(parents=True, exist_ok=True)
        with replacing(path.absolute()) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())


def write_file(path: Path, content: bytes) -> None:
    """Write a file that was named, in place of an older one. Raises InputError."""
    with writing(path) as file:
        file.write(content)


def check_writable(
    path: Path, option: str, is_ours: Callable[[Path], bool] = lambda path: True
) -> None:
    """Raise InputError unless a file can be written in place of none or one of ours."""
    with os_errors(f'{option} {path}: cannot be written'):
        if path.is_symlink() or path.is_dir():
            raise InputError(f'{option} {path}: is a link or a folder; give the name of a file')
        if path.exists() and not is_ours(path):
            raise InputError(
                f'{option} {path}: exists and was not written by segfloor; choose another name'
            )
        path.absolute().parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.absolute().parent):
            pass


@contextmanager
def scratch_folder(parent: Path, prefix: str = SCRATCH) -> Iterator[Path]:
    """A private folder until the end of the block or of this process, however that ends: a shell
    waits for the end of its input and removes the folder. Raises OSError.
    """
    folder = Path(tempfile.mkdtemp(prefix=prefix, dir=parent.absolute()))
    try:
        waiting = ['sh', '-c', 'trap "" INT TERM HUP; read _; rm -rf -- "$0"', str(folder)]
        with subprocess.Popen(waiting, stdin=subprocess.PIPE, start_new_session=True, cwd='/'):
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def check_target(target: Path, names: Iterable[str], inputs: Iterable[Path | str] = ()) -> None:
    """Raise InputError unless results can be written to a folder: it is no link, neither is, holds
    nor lies in an input, and holds nothing of others by one of these names.
    """
    _check_folder(target)
    place = target.resolve()
    for one in inputs:
        if one and Path(one).exists():
            read = Path(one).resolve()
            if place == read or place in read.parents or read in place.parents:
                raise InputError(
                    f'{target}: is, holds or lies in {one}, which is read; choose another --out'
                )
    own = {PurePosixPath(name).parts[0] for name in own_files(target)}
    _refuse(target, [name for name in names if name not in own and os.path.lexists(target / name)])


def _check_folder(target: Path) -> None:
    if target.is_symlink():
        raise InputError(f'{target}: is a link; give the folder it leads to')
    if target.exists() and not target.is_dir():
        raise InputError(f'{target}: exists and is no folder; choose another --out')


def _refuse(target: Path, foreign: list[str]) -> None:
    if foreign:
        raise InputError(
            f'{target}: holds {foreign[0]}, which segfloor did not write; choose another --out'
        )


@contextmanager
def folder_in_the_making(target: Path) -> Iterator[Path]:
    """A new folder that `move_into_place` can move to the target; gone at the end of the block
    where it was not. Raises InputError where nothing can be written there.
    """
    parent = target.absolute().parent
    # A folder that is mounted, or that others have files in, stays where it is.
    inside = target.is_dir() and not (_is_wholly_own(target) and os.access(parent, os.W_OK))
    with ExitStack() as stack:
        with os_errors(f'{target}: cannot be written', '; choose another --out'):
            parent.mkdir(parents=True, exist_ok=True)
            made = stack.enter_context(scratch_folder(target if inside else parent)) / 'made'
            made.mkdir()
        yield made


def move_into_place(made: Path, target: Path) -> None:
    """Put the files of a folder in place of those that segfloor wrote to the target before: in one
    step where it holds nothing else, file by file otherwise. Raises OSError, or InputError where a
    file of others is in the way.
    """
    _check_folder(target)
    new = set(_files_in(made)) - {MARKER}
    _write_marker(made, new)
    if not os.path.lexists(target):
        made.rename(target)
    elif not (_is_wholly_own(target) and _exchange(made, target)):
        _merge(made, target, new)


def add_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files into a folder, which knows them as its own from now on. Raises OSError, or
    InputError where a file of others is in the way.
    """
    _check_folder(folder)
    own = own_files(folder)
    _refuse(folder, _in_the_way(folder, files, own))
    folder.mkdir(parents=True, exist_ok=True)
    _write_marker(folder, own | files.keys())
    for name, content in files.items():
        with replacing(folder / name) as file:
            file.write(content)


def own_files(folder: Path) -> set[str]:
    """Return the files in a folder that segfloor wrote: those that its marker names and that are
    still files there.
    """
    try:
        listed = set(read_text(folder / MARKER).splitlines())
    except InputError:
        listed = set(_written_before_markers(folder))
    return {n for n in _files_in(folder) if n in listed and not (folder / n).is_symlink()}


def _written_before_markers(folder: Path) -> Iterator[str]:
    if (folder / RENDERED).is_file():
        yield from _files_in(folder)
        return
    with suppress(InputError):
        summary = read_json(folder / 'summary.json', 'a summary')
        if {'tracked_frames', 'map_updates'} <= summary.keys():
            yield from (n for n in _files_in(folder) if n.partition('/')[0] in BEFORE_MARKERS)


def _write_marker(folder: Path, names: Iterable[str]) -> None:
    with replacing(folder / MARKER) as file:
        file.write(''.join(f'{name}\n' for name in sorted(names)).encode())


def _files_in(folder: Path) -> Iterator[str]:
    """Yield all that is in a folder and its folders but these, links not followed."""
    for root, folders, files in os.walk(folder):
        links = [name for name in folders if os.path.islink(os.path.join(root, name))]
        for name in [*files, *links]:
            yield Path(root, name).relative_to(folder).as_posix()


def _is_wholly_own(folder: Path) -> bool:
    """Whether nothing but results is in a folder, and nobody would miss the folder itself."""
    there = set(_files_in(folder))
    if not there or os.path.ismount(folder) or folder.samefile('.'):
        return False
    return there <= own_files(folder) | {MARKER}


def _exchange(made: Path, target: Path) -> bool:
    """Swap two folders in one step (renameat2(2)); False where the system cannot."""
    swap = getattr(ctypes.CDLL(None), 'renameat2', None)
    return (
        swap is not None
        and swap(AT_CWD, os.fsencode(made), AT_CWD, os.fsencode(target), RENAME_EXCHANGE) == 0
    )


def _merge(made: Path, target: Path, new: set[str]) -> None:
    old = own_files(target)
    _refuse(target, _in_the_way(target, new, old))
    _write_marker(target, old | new)
    for name in sorted(new):
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        os.replace(made / name, target / name)
    for name in sorted(old - new):
        (target / name).unlink()
        with suppress(OSError):  # a folder with more in it stays
            (target / name).parent.rmdir()
    _write_marker(target, new)


def _in_the_way(folder: Path, names: Iterable[str], own: set[str]) -> list[str]:
    """Return what is in the way of files: others by their names, and what should be a folder."""
    found = []
    for name in sorted(names):
        above = [folder / above for above in list(PurePosixPath(name).parents)[:-1]]
        blocked = any(p.is_symlink() or (p.exists() and not p.is_dir()) for p in above)
        if blocked or (name not in own and os.path.lexists(folder / name)):
            found.append(name)
    return found


def write_map_file(path: Path, saved: MapFile) -> None:
    """Write a map in place of an older file. Raises InputError where that is not possible."""
    with writing(path.absolute()) as file:
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
