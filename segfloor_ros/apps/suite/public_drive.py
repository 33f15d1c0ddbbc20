"""A public recording of which only the wanted files are fetched out of its archives: the first
seconds of KITTI odometry 06 (Geiger et al., Vision meets Robotics: the KITTI dataset, 2013).
"""

from __future__ import annotations

import os
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

from segfloor_ros.apps.suite.result_files import open_system
from segfloor_ros.core.errors import InputError, os_errors
from segfloor_ros.core.files.writing import scratch_folder

ARCHIVES = 'https://s3.eu-central-1.amazonaws.com/avg-kitti/raw_data'
DAY, DRIVE, PAIRS = '2011_09_30', '2011_09_30_drive_0020', 51
FOLDER = f'{DAY}/{DRIVE}_sync'
"""The drive, in its archive and in the folder of what is fetched."""
ABOUT = (
    'KITTI raw data, 2011_09_30_drive_0020, frames 0 to 50; licence CC BY-NC-SA 3.0 (no commercial '
    'use); about 30 MB out of an archive of 4.5 GB'
)

BLOCK_BYTES = 1 << 20
"""Asked for at once: three images."""
ELSEWHERE = '; choose another --data'


def files_by_url() -> dict[str, list[str]]:
    """Return the files that are wanted, by the URL of their archive and in its order."""
    sides = [f'{FOLDER}/image_{side}' for side in ('00', '01')]
    images = [f'{side}/data/{k:010d}.png' for side in sides for k in range(PAIRS)]
    return {
        f'{ARCHIVES}/{DAY}_calib.zip': [f'{DAY}/calib_cam_to_cam.txt'],
        f'{ARCHIVES}/{DRIVE}/{DRIVE}_sync.zip': [f'{sides[0]}/timestamps.txt', *images],
    }


def fetched(folder: Path, progress: Callable[[int], None] = lambda _: None) -> Path:
    """Return the folder of the drive in a folder, after fetching the files that are not there.
    Each appears once its size and CRC-32 are those that the archive names; files and links that
    are there stay as they are. progress: is called with how many are there. Raises InputError.
    """
    count = 0
    for url, names in files_by_url().items():
        missing = [name for name in names if not os.path.lexists(folder / name)]
        count += len(names) - len(missing)
        progress(count)
        for _ in _fetched(url, missing, folder) if missing else ():
            count += 1
            progress(count)
    return folder / FOLDER


def _fetched(url: str, names: list[str], folder: Path) -> Iterator[None]:
    """Put files of an archive in a folder, replacing none; yield after each."""
    with os_errors(f'{folder}: cannot be written', ELSEWHERE):
        folder.mkdir(parents=True, exist_ok=True)
        with scratch_folder(folder) as scratch:
            for name, content in _read(url, names, folder):
                target, made = folder / name, scratch / Path(name).name
                with os_errors(f'{target}: cannot be written', ELSEWHERE):
                    target.parent.mkdir(parents=True, exist_ok=True)
                    made.write_bytes(content)
                    os.link(made, target)
                    made.unlink()  # images of both sides have the same names
                yield


def _read(url: str, names: list[str], folder: Path) -> Iterator[tuple[str, bytes]]:
    """Yield names and contents of files of an archive."""
    system, path = open_system(url)
    try:
        with (
            system.open(path, block_size=BLOCK_BYTES) as remote,
            zipfile.ZipFile(remote) as archive,
        ):
            for name in names:
                yield name, archive.read(name)  # raises where its CRC-32 is another
    except Exception as error:  # whatever it is that the libraries for networks raise
        # fsspec raises FileNotFoundError whatever failed; why is its cause.
        is_vague = isinstance(error, FileNotFoundError) and error.__cause__ is not None
        cause = error.__cause__ if is_vague else error
        is_missing = isinstance(cause, FileNotFoundError) or getattr(cause, 'status', 0) == 404
        why = 'not found' if is_missing else ' '.join(str(cause).split()) or type(cause).__name__
        wanted = [name for names in files_by_url().values() for name in names]
        kept = 'what came is kept: ' if any(os.path.lexists(folder / n) for n in wanted) else ''
        raise InputError(
            f'{url}: cannot be read ({why}); {kept}try again, or fetch '
            f'{" and ".join(files_by_url())} by other means and unpack both in {folder}'
        ) from None
