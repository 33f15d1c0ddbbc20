"""KITTI odometry folders: image_0 and image_1 (grey) or image_2 and image_3 (colour), calib.txt,
times.txt.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from segfloor_ros.camera.calibration.files import (
    given_calibration,
    given_left_calibration,
    read_kitti_calibration,
    read_kitti_eye,
)
from segfloor_ros.camera.settings import StereoCameraSettings
from segfloor_ros.camera.sources import files
from segfloor_ros.camera.sources.depth_images import DEPTH, MONO, with_depth
from segfloor_ros.camera.sources.pairing import check_times, read_times, stamps_of_rate
from segfloor_ros.camera.sources.sensor_files import folder_sensors
from segfloor_ros.camera.sources.source import StereoSource
from segfloor_ros.errors import InputError

CAMERAS = ((0, 1), (2, 3))


def is_kitti(folder: Path) -> bool:
    """Whether `folder` looks like a KITTI odometry sequence."""
    has_index = (folder / 'calib.txt').exists() or (folder / 'times.txt').exists()
    return has_index and any((folder / f'image_{i}').is_dir() for i in range(4))


def open_kitti(folder: Path, settings: StereoCameraSettings) -> StereoSource:
    """Open a KITTI odometry folder. Raises InputError or CalibrationError."""
    camera, partner = _cameras(folder)
    has_right = partner is not None and not settings.depth
    left = files.images_in(folder / f'image_{camera}')
    right = files.images_in(folder / f'image_{partner}') if has_right else left
    files.check_equal_numbers(str(folder), left, right)
    indices, stamps = _indices_and_stamps(folder / 'times.txt', left, settings.rate_hz)
    pairs = [files.FilePair(*fields) for fields in zip(indices, stamps, left, right, strict=True)]
    calib, size = folder / 'calib.txt', files.first_image_size(left, str(folder))
    if partner is None or not has_right:
        eye = given_left_calibration(settings) or read_kitti_eye(calib, *size, camera)
        return with_depth(folder, pairs, eye, settings)
    calibration = given_calibration(settings)
    calibration = calibration or read_kitti_calibration(calib, *size, (camera, partner))
    sensors = folder_sensors(folder, settings.ignored_sensors)
    return files.file_pair_source(str(folder), pairs, calibration, settings.bit_depth, sensors)


def _cameras(folder: Path) -> tuple[int, int | None]:
    """Return the numbers of the left and the right camera; None for the latter where there are
    depth images.
    """
    for cameras in CAMERAS:
        if all((folder / f'image_{camera}').is_dir() for camera in cameras):
            return cameras
    for camera, _ in CAMERAS:
        if (folder / f'image_{camera}').is_dir() and (folder / DEPTH).is_dir():
            return camera, None
    found = ', '.join(path.name for path in sorted(folder.glob('image_*')))
    raise InputError(
        f'{folder}: has {found}, but a stereo pair is image_0 with image_1, or image_2 with '
        f'image_3; {MONO}'
    )


def _indices_and_stamps(
    times: Path, left: Sequence[Path], rate_hz: float
) -> tuple[list[int], list[int]]:
    """Line k of times.txt belongs to the image whose name is the number k; names that are no such
    numbers are matched in order.
    """
    indices = list(range(len(left)))
    if not times.exists():
        return indices, stamps_of_rate(len(left), rate_hz)
    stamps = read_times(times)
    numbers = [int(path.stem) for path in left if path.stem.isdecimal()]
    if len(numbers) == len(left) and numbers[-1] < len(stamps):
        return numbers, [stamps[number] for number in numbers]
    check_times(times, stamps, left)
    return indices, stamps
