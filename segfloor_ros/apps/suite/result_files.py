"""Results folders, packed to be sent, and kept by what they were made from; recordings by path,
pattern or URL: found, copied to this machine, and told apart by content. A suite's results on one
page, with links to the report of each recording.
"""

from __future__ import annotations

import base64
import contextlib
import glob
import hashlib
import html
import io
import json
import tarfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from segfloor_ros.apps.results_folder import REPORT
from segfloor_ros.apps.suite.measures import MEASURES, Checked, SuiteResult, known_measures, number
from segfloor_ros.core.errors import InputError, printable, without_credentials
from segfloor_ros.core.files.images import png_bytes, read_mask
from segfloor_ros.core.files.whole import read_json
from segfloor_ros.core.files.writing import folder_in_the_making, move_into_place, scratch_folder
from segfloor_ros.core.grid.occupancy import UNKNOWN_PIXEL

MEASURED = 'measured.json'
ARCHIVE = 'results.tar'

WILDCARDS = '*?['

COLUMNS = ('tracked_percent', 'path_error_m', 'precision_percent', 'recall_percent',
           'known_area_m2', 'time_ratio', 'memory_peak_mb')  # fmt: skip
THUMBNAIL_PX = 110
MARKS = """
td { vertical-align: middle; } td:first-child a { font-weight: 600; }
.ok { color: #1b7f3b; } .bad { color: #b3261e; } ul { margin: 0; padding-left: 18px; }
img { image-rendering: pixelated; border: 1px solid #e1e6ec; }
"""


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
            return measured, (entry / ARCHIVE).read_bytes()
        except (InputError, OSError, ValueError):
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
        system, path = open_system(pattern)
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
    system, path = open_system(path_or_url)
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
                with contextlib.suppress(OSError):  # another process has been faster
                    made.rename(target)
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
            while chunk := opened.read(io.DEFAULT_BUFFER_SIZE):
                result.update(chunk)
    return result.hexdigest()


def open_system(url: str) -> tuple[Any, str]:
    """Return the file system of a URL, and the path in it. Raises InputError."""
    try:
        from fsspec.core import url_to_fs

        return url_to_fs(url)
    except ImportError as error:
        raise InputError(
            f'{url}: a library is missing ({error}); those of https:// come with '
            "pip install 'segfloor_ros[cluster]'"
        ) from None
    except (OSError, ValueError) as error:
        raise InputError(f'{url}: cannot be read ({error})') from None


def _name(path_or_url: str) -> str:
    """Return the last part, without the query of a URL: it may hold what signs it."""
    return without_credentials(path_or_url).rstrip('/').rpartition('/')[2]


def _stem(path: str) -> str:
    return Path(_name(path)).stem


def page(result: SuiteResult, folder: Path) -> bytes:
    """Return the page of a suite's folder, which holds a folder for each recording."""
    # Imported here: Matplotlib takes a second that no other command should wait for.
    from segfloor_ros.apps.evaluation.report import html_page

    kept = sum(checked.holds for checked in result.recordings)
    names = ('recording', 'map', '', *COLUMNS)
    head = ''.join(f'<th>{_heading(name)}</th>' for name in names)
    rows = ''.join(_row(checked, folder) for checked in result.recordings)
    failed = ''.join(
        f'<li class="bad">{html.escape(printable(complaint))}</li>'
        for checked in result.recordings
        for complaint in checked.complaints
    )
    complaints = f'<h2>What fails</h2><ul>{failed}</ul>' if failed else ''
    about = f'{kept} of {len(result.recordings)} recordings are as they should be'
    table = f'<h2>Recordings</h2><table><tr>{head}</tr>{rows}</table>'
    return html_page(printable(result.name), about, complaints + table, MARKS)


def _row(checked: Checked, folder: Path) -> str:
    name = html.escape(checked.name)
    link = f'{checked.name}/{REPORT}'
    has_map = not checked.problem  # what is there of an earlier check is not of this one
    if has_map and (folder / link).is_file():
        name = f'<a href="{html.escape(link)}">{name}</a>'
    failing = {v.bound.measure for v in checked.verdicts if not v.holds}
    state = f'<span class="{"ok" if checked.holds else "bad"}">{checked.state}</span>'
    picture = _thumbnail(folder / checked.name / 'map.pgm') if has_map else ''
    cells = [name, picture, state]
    for measure in COLUMNS:
        value = checked.measured.get(measure)
        text = '' if value is None else number(value)
        cells.append(f'<span class="bad">{text}</span>' if measure in failing else text)
    return '<tr>' + ''.join(f'<td>{cell}</td>' for cell in cells) + '</tr>'


def _heading(name: str) -> str:
    if name not in MEASURES:
        return name
    unit = MEASURES[name].unit
    words = name.removesuffix('_percent').removesuffix('_m2').removesuffix('_mb').removesuffix('_m')
    return html.escape(words.replace('_', ' ') + (f' {unit}' if unit else ''))


def _thumbnail(path: Path) -> str:
    """Return a small picture of what is known in a map, '' where there is none."""
    try:
        image = read_mask(path)
    except InputError:
        return ''
    left, top, width, height = cv2.boundingRect((image != UNKNOWN_PIXEL).astype(np.uint8))
    image = image[top : top + height, left : left + width] if width and height else image
    scale = THUMBNAIL_PX / max(image.shape)
    size = np.maximum(1, np.rint(scale * np.array(image.shape[::-1]))).astype(int)
    small = cv2.resize(image, (int(size[0]), int(size[1])), interpolation=cv2.INTER_AREA)
    data = base64.b64encode(png_bytes(small)).decode()
    return f'<img alt="map" src="data:image/png;base64,{data}">'
