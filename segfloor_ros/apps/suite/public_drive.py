"""A public recording of which only the wanted files are fetched out of its archives: the first
seconds of KITTI odometry 06 (Geiger et al., Vision meets Robotics: the KITTI dataset, 2013).
"""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

from segfloor_ros.apps.suite.result_files import open_system
from segfloor_ros.core.errors import InputError, os_errors
from segfloor_ros.core.files.writing import scratch_folder

ARCHIVES = 'https://s3.eu-central-1.amazonaws.com/avg-kitti/raw_data'
DAY, DRIVE, PAIRS = '2011_09_30', '2011_09_30_drive_0020', 51
ABOUT = (
    'KITTI raw data, 2011_09_30_drive_0020, frames 0 to 50; licence CC BY-NC-SA 3.0 (no commercial '
    'use); about 30 MB out of an archive of 4.5 GB'
)

BLOCK_BYTES = 1 << 20
"""Asked for at once: three images."""


def files_by_url() -> dict[str, list[str]]:
    """Return the files that are wanted, by the URL of their archive and in its order."""
    folder = f'{DAY}/{DRIVE}_sync'
    sides = [f'{folder}/image_{side}' for side in ('00', '01')]
    images = [f'{side}/data/{k:010d}.png' for side in sides for k in range(PAIRS)]
    return {
        f'{ARCHIVES}/{DAY}_calib.zip': [f'{DAY}/calib_cam_to_cam.txt'],
        f'{ARCHIVES}/{DRIVE}/{DRIVE}_sync.zip': [f'{sides[0]}/timestamps.txt', *images],
    }


def fetched(folder: Path, progress: Callable[[int], None] = lambda _: None) -> Path:
    """Return the folder of the drive in a folder, after fetching the files that are not there.
    Each appears once its size and CRC-32 are those that the archive names; files that are there
    stay as they are. progress: is called with how many files are there. Raises InputError.
    """
    wanted = files_by_url()
    count = 0
    for url, names in wanted.items():
        missing = [name for name in names if not (folder / name).exists()]
        count += len(names) - len(missing)
        progress(count)
        if missing:
            with os_errors(f'{folder}: cannot be written'):
                folder.mkdir(parents=True, exist_ok=True)
            for _ in _fetched(url, missing, folder):
                count += 1
                progress(count)
    return folder / DAY / f'{DRIVE}_sync'


def _fetched(url: str, names: list[str], folder: Path) -> Iterator[None]:
    """Fetch files out of an archive; yield after each."""
    system, path = open_system(url)
    try:
        with (
            system.open(path, block_size=BLOCK_BYTES) as remote,
            zipfile.ZipFile(remote) as archive,
            scratch_folder(folder) as scratch,
        ):
            for name in names:
                read = archive.read(name)  # raises where its CRC-32 is another
                target = folder / name
                target.parent.mkdir(parents=True, exist_ok=True)
                (scratch / target.name).write_bytes(read)
                (scratch / target.name).rename(target)
                yield
    except Exception as error:  # whatever it is that the libraries for networks raise
        is_missing = isinstance(error, FileNotFoundError)
        why = 'not found' if is_missing else ' '.join(str(error).split()) or type(error).__name__
        raise InputError(
            f'{url}: cannot be read ({why}); what came is kept: try again, or fetch '
            f'{" and ".join(files_by_url())} by other means and unpack both in {folder}'
        ) from None
