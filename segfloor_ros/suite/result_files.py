"""Results folders, packed to be sent, and kept by what they were made from; recordings by path,
pattern or URL: found, copied to this machine, and told apart by content.
"""

from __future__ import annotations

import contextlib
import glob
import hashlib
import io
import json
import tarfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from segfloor_ros.errors import InputError, without_credentials
from segfloor_ros.files.results import folder_in_the_making, move_into_place, scratch_folder
from segfloor_ros.files.whole import read_bytes, read_json
from segfloor_ros.suite.measures import known_measures

MEASURED = 'measured.json'
ARCHIVE = 'results.tar'

CHUNK = 1 << 20
MAX_ARCHIVE = 1 << 32

WILDCARDS = '*?['


def pack(folder: Path) -> bytes:
    """Return the files of a folder as an archive."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode='w:gz', compresslevel=1) as archive:
        for file in sorted(f for f in folder.rglob('*') if not f.is_symlink()):
            archive.add(file, str(file.relative_to(folder)), recursive=False)
    return buffer.getvalue()


def unpack(archive: bytes, folder: Path, more: Mapping[str, bytes] | None = None) -> None:
    """Put the files of an archive, and more, in place of the results in a folder. Raises OSError,
    or InputError where files of others are in the way.
    """
    with folder_in_the_making(folder) as made:
        with tarfile.open(fileobj=io.BytesIO(archive)) as opened:
            for member in opened.getmembers():
                beyond = member.name.startswith('/') or '..' in Path(member.name).parts
                if beyond or not (member.isfile() or member.isdir()):
                    raise ValueError(f'{member.name}: not a file of the results folder')
                opened.extract(member, made)
        for name, content in (more or {}).items():
            (made / name).write_bytes(content)
        move_into_place(made, folder)


class Cache:
    """Results by key, in a folder that several processes may use."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def get(self, key: str) -> tuple[dict[str, float], bytes] | None:
        """Return measures and archive, None where there are none."""
        entry = self._folder / key
        try:
            measured = known_measures(read_json(entry / MEASURED, 'measures'))
            return measured, read_bytes(entry / ARCHIVE, at_most=MAX_ARCHIVE)
        except (InputError, ValueError):
            return None

    def put(self, key: str, measured: dict[str, float], archive: bytes) -> None:
        """Keep a result; one that is there already stays."""
        self._folder.mkdir(parents=True, exist_ok=True)
        with scratch_folder(self._folder) as scratch:
            entry = scratch / key
            entry.mkdir()
            (entry / ARCHIVE).write_bytes(archive)
            (entry / MEASURED).write_text(json.dumps(measured))
            with contextlib.suppress(OSError):  # another process has been faster
                entry.rename(self._folder / key)


def is_url(text: str) -> bool:
    """Whether a recording is named by a URL (`s3://`, `gs://`, `https://`, `file://`)."""
    return '://' in text


def find_recordings(pattern: str) -> dict[str, str]:
    """Return paths or URLs by short name: the one given, or all that a pattern matches. Raises
    InputError where there is none.
    """
    is_there = not is_url(pattern) and Path(pattern).exists()
    if is_there or not any(c in without_credentials(pattern) for c in WILDCARDS):
        if not is_url(pattern) and not is_there:
            raise InputError(f'{pattern}: no such recording')
        return {_stem(pattern): pattern}
    if is_url(pattern):
        system, path = _open_system(pattern)
        found = sorted(system.unstrip_protocol(match) for match in system.glob(path))
    else:
        found = sorted(glob.glob(pattern))
    if not found:
        raise InputError(f'{pattern}: matches no recording')
    return {_stem(path): path for path in found}


def local_copy(path_or_url: str, folder: Path) -> Path:
    """Return a path as it is, or that of a copy of what a URL names, made in `folder` unless it is
    there. Raises InputError.
    """
    if not is_url(path_or_url):
        return Path(path_or_url)
    system, path = _open_system(path_or_url)
    try:
        # Size, time and tag tell whether what the URL names has changed.
        facts = repr(sorted((k, str(v)) for k, v in system.info(path).items()))
        target = folder / hashlib.sha256((path_or_url + facts).encode()).hexdigest()[:16]
        copy = target / _name(path)
        if not target.is_dir():
            folder.mkdir(parents=True, exist_ok=True)
            with scratch_folder(folder) as scratch:
                (made := scratch / target.name).mkdir()
                system.get(path.rstrip('/'), str(made / copy.name), recursive=True)
                _move(made, target)
    except (OSError, ValueError, ImportError) as error:
        raise InputError(f'{path_or_url}: cannot be read ({error})') from None
    return copy


def digest_of(path: Path) -> str:
    """Return a hash of what a file or all files of a folder hold, names included; modules that
    Python has compiled differ from machine to machine and do not count.
    """
    result = hashlib.blake2b(digest_size=16)
    files = sorted(path.rglob('*')) if path.is_dir() else [path]
    for file in files:
        if not file.is_file() or file.parent.name == '__pycache__':
            continue
        result.update(f'{file.relative_to(path)}\0{file.stat().st_size}\0'.encode())
        with file.open('rb') as opened:
            while chunk := opened.read(CHUNK):
                result.update(chunk)
    return result.hexdigest()


def _open_system(url: str) -> tuple[Any, str]:
    try:
        from fsspec.core import url_to_fs
    except ImportError:
        raise InputError(
            f"{url}: URLs need fsspec; install the extra: pip install 'segfloor_ros[cluster]'"
        ) from None
    try:
        return url_to_fs(url)
    except (ImportError, OSError, ValueError) as error:
        raise InputError(f'{url}: cannot be read ({error})') from None


def _move(staging: Path, target: Path) -> None:
    """Move a folder to its place, unless another process has been faster."""
    try:
        staging.rename(target)
    except OSError:
        if not target.is_dir():
            raise


def _name(path_or_url: str) -> str:
    """Return the last part, without the query of a URL: it may hold what signs it."""
    return without_credentials(path_or_url).rstrip('/').rpartition('/')[2]


def _stem(path: str) -> str:
    return Path(_name(path)).stem
