"""The one place that writes files for people, with one rule: nothing is replaced or removed that
segfloor did not write, unchanged, for this very purpose. No link, device or pipe is written to, and
no input of a command.

A single file may take the place of one of its kind that bears the mark of segfloor. A folder of
results is new, empty, or bears a marker, which lists the files of segfloor with a hash of each.
Everything is written to a temporary name in the same folder and moved into place; what a killed
process has left under such names is removed by the next one of the same user.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
import struct
import tempfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO

from segfloor_ros.core.errors import InputError, os_errors

MARKER = '.segfloor_result'
"""In a folder of results: a hash and a name for each file in it that segfloor wrote."""

TEMPORARY = '.segfloor-'
"""Names of temporary files and folders begin with this."""

MARK = 'written by segfloor'
HASH_BYTES = 16

HEAD_BYTES = 4096
"""The mark of a file is in its first or last so many bytes."""


@dataclass(frozen=True)
class Kind:
    """A kind of file. is_own: whether segfloor wrote a file, of this kind; may raise OSError."""

    name: str
    is_own: Callable[[Path], bool]


def marked(name: str, prefix: bytes, mark: bytes = MARK.encode()) -> Kind:
    """Return a kind of file that begins with a prefix and bears a mark near its start or end."""

    def is_own(path: Path) -> bool:
        with path.open('rb') as file:
            head = file.read(HEAD_BYTES)
            file.seek(max(os.fstat(file.fileno()).st_size - HEAD_BYTES, 0))
            return head.startswith(prefix) and mark in head + file.read(HEAD_BYTES)

    return Kind(name, is_own)


PNG = marked('PNG', b'\x89PNG\r\n\x1a\n')
YAML = marked('YAML file', b'# ' + MARK.encode())
PAGE = marked('page', b'<!DOCTYPE html>\n<!-- ' + MARK.encode())
VIEW = marked('view', b'RRF', b'segfloor')
PLOTS = {'.pdf': marked('PDF', b'%PDF'), '.svg': marked('SVG', b'<?xml'), '.png': PNG}


def marked_png(png: bytes) -> bytes:
    """Return a PNG file with the mark of segfloor, a tEXt chunk after the header of 33 bytes."""
    chunk = b'tEXtSoftware\0' + MARK.encode()
    length, crc = struct.pack('>I', len(chunk) - 4), struct.pack('>I', zlib.crc32(chunk))
    return png[:33] + length + chunk + crc + png[33:]


def check_output(
    path: Path, kind: Kind, inputs: Iterable[Path | str | None] = (), option: str = ''
) -> None:
    """Raise InputError unless a file can be written: nothing is there by its name, or a file of its
    kind that segfloor wrote, and that is none of the inputs. Its folder is made.
    """
    what = f'{option} {path}'.strip()
    with os_errors(f'{what}: cannot be written'):
        path.absolute().parent.mkdir(parents=True, exist_ok=True)
        _check_replaceable(path, kind, inputs, what)
        if os.path.lexists(path):
            with _temporary_file(path):
                pass
        else:  # as it will be named
            os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
            path.unlink()


def _check_replaceable(
    path: Path, kind: Kind, inputs: Iterable[Path | str | None], what: str
) -> None:
    if not os.path.lexists(path):
        return
    if not _is_plain(path):
        raise InputError(f'{what}: cannot be written (is a link, folder, device or pipe)')
    for one in inputs:
        if one and os.path.exists(one) and path.samefile(one):
            raise InputError(f'{what}: is the input {one}; choose another name')
    if not kind.is_own(path):
        raise InputError(
            f'{what}: exists and is no {kind.name} that segfloor wrote; choose another name'
        )


@contextmanager
def output_file(
    path: Path, kind: Kind, inputs: Iterable[Path | str | None] = ()
) -> Iterator[IO[bytes]]:
    """Write a file that `check_output` allows; it appears, on the disk, at the end of the block.
    After an error there is what was there before. Raises InputError.
    """
    check_output(path, kind, inputs)
    with os_errors(f'{path}: cannot be written'), _temporary_file(path) as (file, written):
        yield file
        file.flush()
        os.fsync(file.fileno())
        _check_replaceable(path, kind, inputs, str(path))
        written.replace(path)


def write_output(
    path: Path, kind: Kind, content: bytes, inputs: Iterable[Path | str | None] = ()
) -> None:
    """Write a file as `output_file` does. Raises InputError."""
    with output_file(path, kind, inputs) as file:
        file.write(content)


@contextmanager
def _temporary_file(path: Path) -> Iterator[tuple[IO[bytes], Path]]:
    """A temporary file in the folder of another, with the permissions of a new one."""
    number, name = tempfile.mkstemp('.part', TEMPORARY, path.absolute().parent)
    written = Path(name)
    with os.fdopen(number, 'wb') as file, _removed_at_last(written):
        os.fchmod(number, 0o666 & ~_UMASK)
        yield file, written


_UMASK = os.umask(0o077)
os.umask(_UMASK)


@contextmanager
def scratch_folder(parent: Path, prefix: str = TEMPORARY) -> Iterator[Path]:
    """A private folder until the end of the block. Raises OSError."""
    folder = Path(tempfile.mkdtemp(prefix=prefix, dir=parent.absolute()))
    with _removed_at_last(folder):
        yield folder


def check_target(
    target: Path, names: Iterable[str], inputs: Iterable[Path | str | None] = ()
) -> None:
    """Raise InputError unless results can be written to a folder: it is new, empty, or one of
    segfloor for these very names; neither is, holds nor lies in an input; and holds nothing of
    others by one of the names.
    """
    _check_kind(target)
    place = target.resolve()
    for one in inputs:
        if one and (isinstance(one, Path) or os.path.exists(one)):
            read = Path(one).resolve()
            if place == read or place in read.parents or read in place.parents:
                raise InputError(
                    f'{target}: is, holds or lies in {one}, which is read; choose another --out'
                )
    _check_folder(target)
    own, names = {PurePosixPath(name).parts[0] for name in own_files(target)}, set(names)
    if own - names:
        raise InputError(
            f'{target}: holds {min(own - names)} of another command; choose another --out'
        )
    _refuse(target, [n for n in sorted(names - own) if os.path.lexists(target / n)])


def _check_kind(target: Path) -> None:
    if target.is_symlink():
        raise InputError(f'{target}: is a link; choose another --out')
    if os.path.lexists(target) and not target.is_dir():
        raise InputError(f'{target}: exists and is no folder; choose another --out')


def _check_folder(target: Path) -> None:
    _check_kind(target)
    with os_errors(f'{target}: cannot be written', '; choose another --out'):
        if not target.exists() or _is_plain(target / MARKER):
            return
        if any(not name.startswith(TEMPORARY) for name in os.listdir(target)):
            raise InputError(
                f'{target}: holds files and no {MARKER}, so they may be yours; choose another --out'
            )


def _is_plain(path: Path) -> bool:
    return path.is_file() and not path.is_symlink()


def _refuse(target: Path, foreign: list[str]) -> None:
    if foreign:
        raise InputError(
            f'{target}: holds {foreign[0]}, which segfloor did not write, or which was changed '
            'since; choose another --out'
        )


@contextmanager
def folder_in_the_making(target: Path) -> Iterator[Path]:
    """A temporary folder in the target, for `move_into_place`. The target is made where it is
    missing, and goes again where nothing comes of it. Raises InputError.
    """
    _check_folder(target)
    with ExitStack() as stack:
        with os_errors(f'{target}: cannot be written', '; choose another --out'):
            is_new = not target.exists()
            target.mkdir(parents=True, exist_ok=True)
            stack.callback(_give_up, target, is_new)
            if not (target / MARKER).exists():
                _write_marker(target, {})
            made = stack.enter_context(scratch_folder(target))
        yield made


def _give_up(target: Path, is_new: bool) -> None:
    """Leave no trace in a folder that nothing was written to."""
    with suppress(OSError):
        if os.listdir(target) == [MARKER] and not (target / MARKER).stat().st_size:
            (target / MARKER).unlink()
            if is_new:
                target.rmdir()


def move_into_place(made: Path, target: Path) -> None:
    """Put the files of a folder in place of those that segfloor wrote to the target before. Raises
    OSError, or InputError where a file of others is in the way; then nothing has changed.
    """
    new = {name: made / name for name in _files_in(made) if name != MARKER}
    target.mkdir(exist_ok=True)
    _replace_files(target, new, is_all=True)


def add_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files into a folder of results, beside what is there. Raises OSError, or InputError
    where a file of others is in the way.
    """
    with folder_in_the_making(folder) as made:
        for name, content in files.items():
            (made / name).parent.mkdir(parents=True, exist_ok=True)
            (made / name).write_bytes(content)
        _replace_files(folder, {name: made / name for name in files}, is_all=False)


def _replace_files(target: Path, new: Mapping[str, Path], is_all: bool) -> None:
    """Move files to a folder by their names in it. is_all: it has no others of segfloor then."""
    hashes = {name: hash_of(path) for name, path in new.items()}
    with _locked(target):
        _check_folder(target)
        old = own_files(target)
        _refuse(target, _in_the_way(target, new, old))
        kept = {} if is_all else {name: old[name] for name in old.keys() - new.keys()}
        # Whenever this ends, the marker knows what is there.
        _write_marker(target, old, hashes)
        for name, path in new.items():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            path.replace(target / name)
        for name in old.keys() - new.keys() - kept.keys():
            (target / name).unlink()
            with suppress(OSError):  # a folder with more in it stays
                (target / name).parent.rmdir()
        _write_marker(target, kept, hashes)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Let no other process replace files of a folder."""
    number = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(number, fcntl.LOCK_EX)
        yield
    finally:
        os.close(number)


def own_files(folder: Path) -> dict[str, str]:
    """Return the files in a folder that segfloor wrote, and their hashes: those that its marker
    lists and that are unchanged.
    """
    listed: dict[str, set[str]] = {}
    with suppress(OSError, ValueError):
        if _is_plain(folder / MARKER):
            for line in (folder / MARKER).read_text(encoding='utf-8').splitlines():
                digest, _, name = line.partition('  ')
                listed.setdefault(name, set()).add(digest)
    there = [n for n in _files_in(folder) if n in listed and _is_plain(folder / n)]
    hashes = {name: hash_of(folder / name) for name in there}
    return {name: digest for name, digest in hashes.items() if digest in listed[name]}


def hash_of(path: Path) -> str:
    """Return a hash of what a file holds, '' for one that cannot be read."""
    with suppress(OSError), path.open('rb') as file:
        digest = hashlib.blake2b(digest_size=HASH_BYTES)
        while block := file.read(1 << 20):
            digest.update(block)
        return digest.hexdigest()
    return ''


def _write_marker(folder: Path, *hashes: Mapping[str, str]) -> None:
    rows = {f'{digest}  {name}\n' for some in hashes for name, digest in some.items()}
    with _temporary_file(folder / MARKER) as (file, written):
        file.write(''.join(sorted(rows)).encode())
        file.flush()
        written.replace(folder / MARKER)


def _files_in(folder: Path) -> Iterator[str]:
    """Yield all that is in a folder and its folders but these, links not followed."""
    for root, folders, files in os.walk(folder):
        links = [name for name in folders if os.path.islink(os.path.join(root, name))]
        for name in [*files, *links]:
            yield Path(root, name).relative_to(folder).as_posix()


def _in_the_way(folder: Path, names: Iterable[str], own: Iterable[str]) -> list[str]:
    """Return what is in the way of files: others by their names, and what should be a folder."""
    found = []
    for name in sorted(names):
        above = [folder / above for above in list(PurePosixPath(name).parents)[:-1]]
        blocked = any(p.is_symlink() or (p.exists() and not p.is_dir()) for p in above)
        if blocked or (name not in own and os.path.lexists(folder / name)):
            found.append(name)
    return found


@contextmanager
def _removed_at_last(path: Path) -> Iterator[None]:
    """Remove a temporary file or folder at the end of the block, or by a later process."""
    with ExitStack() as stack:
        with suppress(OSError):  # without a note it stays where this process is killed
            stack.enter_context(_noted(path))
        try:
            yield
        finally:
            _remove(path)


@contextmanager
def _noted(path: Path) -> Iterator[None]:
    """Note a temporary file or folder in the cache of the user, by device and inode, in a file that
    is locked during the block. What the notes of processes that are gone name is removed.
    """
    facts = path.lstat()
    home = os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache'
    notes = Path(home) / 'segfloor' / 'temporary'
    notes.mkdir(mode=0o700, parents=True, exist_ok=True)
    for note in notes.iterdir():
        _sweep(note)
    note = notes / path.name
    with note.open('x') as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX)  # another process may look at it just now
            json.dump([str(path.absolute()), facts.st_dev, facts.st_ino], file)
            file.flush()
            yield
        finally:
            note.unlink(missing_ok=True)


def _sweep(note: Path) -> None:
    """Remove what a note names, if its process is gone."""
    with suppress(OSError, ValueError), note.open() as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # OSError: the process is there
        name, *inode = json.load(file)
        if Path(name).name != note.name:
            return  # no note of segfloor
        with suppress(OSError):
            facts = os.lstat(name)
            if [facts.st_dev, facts.st_ino] == inode and facts.st_uid == os.getuid():
                _remove(Path(name))
        note.unlink()


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
