"""A recording driven to and fro for as long as wanted, for soak tests."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from segfloor_ros.apps.recordings import StereoSource
from segfloor_ros.core.errors import InputError


def write_endless_drive(
    source: StereoSource,
    folder: Path,
    duration_s: float,
    stands: bool = False,
    rate_hz: float = 0.0,
) -> Path:
    """Write a KITTI odometry folder in which a recording is driven forwards and backwards in turn,
    and return it. Every image is stored once; the frames link to them. stands: the camera stays
    where it is in the first frame. rate_hz: frames a second, 0: as recorded. Raises InputError for
    a recording of less than two frames.
    """
    stamps_ns = _write_images(source, folder)
    if len(stamps_ns) < 2:
        raise InputError(f'{source.name}: a drive to and fro needs two frames')
    period_s = 1 / rate_hz if rate_hz else float(np.median(np.diff(stamps_ns))) * 1e-9
    count = max(round(duration_s / period_s), 2)
    for camera in (0, 1):
        images = folder / f'image_{camera}'
        images.mkdir()
        for frame in range(count):
            place = 0 if stands else place_of(frame, len(stamps_ns))
            (images / f'{frame:06d}.png').symlink_to(folder / f'stored_{camera}/{place:06d}.png')
    times = ''.join(f'{frame * period_s:.6f}\n' for frame in range(count))
    (folder / 'times.txt').write_text(times)
    _write_calibration(source, folder / 'calib.txt')
    return folder


def place_of(frame: int, places: int) -> int:
    """Return which frame of the recording, of `places`, a frame of the endless drive shows."""
    turn = 2 * (places - 1)
    return min(frame % turn, turn - frame % turn)


def _write_images(source: StereoSource, folder: Path) -> list[int]:
    for camera in (0, 1):
        (folder / f'stored_{camera}').mkdir(parents=True)
    stamps_ns: list[int] = []
    for frame in source.frames():
        name = f'{len(stamps_ns):06d}.png'
        cv2.imwrite(str(folder / 'stored_0' / name), frame.left)
        cv2.imwrite(str(folder / 'stored_1' / name), frame.right)
        stamps_ns.append(frame.stamp_ns)
    return stamps_ns


def _write_calibration(source: StereoSource, file: Path) -> None:
    P = np.hstack([source.camera.K, np.zeros((3, 1))])
    lines = []
    for name, shift in (('P0', 0.0), ('P1', -source.camera.disparity_times_depth)):
        P[0, 3] = shift
        lines.append(f'{name}: ' + ' '.join(f'{value:.12e}' for value in P.ravel()))
    file.write_text('\n'.join(lines) + '\n')
