"""Results folders, packed to be sent, and kept by what they were made from."""

from __future__ import annotations

import io
import json
import os
import shutil
import tarfile
import tempfile
from pathlib import Path

MEASURED = 'measured.json'
ARCHIVE = 'results.tar'


def pack(folder: Path) -> bytes:
    """Return the files of a folder as an archive."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode='w:gz', compresslevel=1) as archive:
        for file in sorted(folder.rglob('*')):
            archive.add(file, str(file.relative_to(folder)), recursive=False)
    return buffer.getvalue()


def unpack(archive: bytes, folder: Path) -> None:
    """Put the files of an archive into a new folder, in place of an old one."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    staging = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f'.{folder.name}-'))
    staging.chmod(0o755)
    if archive:
        with tarfile.open(fileobj=io.BytesIO(archive)) as opened:
            for member in opened.getmembers():
                if member.name.startswith('/') or '..' in Path(member.name).parts:
                    raise ValueError(f'{member.name}: not a file of the results folder')
                opened.extract(member, staging)
    if folder.exists():
        shutil.rmtree(folder)
    staging.rename(folder)


class Cache:
    """Results by key, in a folder that several processes may use."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def get(self, key: str) -> tuple[dict[str, float], bytes] | None:
        """Return measures and archive, None where there are none."""
        entry = self._folder / key
        try:
            return json.loads((entry / MEASURED).read_text()), (entry / ARCHIVE).read_bytes()
        except (OSError, ValueError):
            return None

    def put(self, key: str, measured: dict[str, float], archive: bytes) -> None:
        """Keep a result; one that is there already stays."""
        self._folder.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(dir=self._folder, prefix='.new-'))
        (staging / ARCHIVE).write_bytes(archive)
        (staging / MEASURED).write_text(json.dumps(measured))
        try:
            os.rename(staging, self._folder / key)
        except OSError:
            shutil.rmtree(staging, ignore_errors=True)
