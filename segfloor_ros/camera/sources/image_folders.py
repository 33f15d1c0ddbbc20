"""Two folders of images, or one folder with both sides, with ROS calibration files."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Sequence
from pathlib import Path

from segfloor_ros.camera.calibration.files import (
    find_calibration,
    given_left_calibration,
    read_eye_calibration,
)
from segfloor_ros.camera.settings import StereoCameraSettings
from segfloor_ros.camera.sources import files
from segfloor_ros.camera.sources.depth_images import DEPTH, MONO, with_depth
from segfloor_ros.camera.sources.pairing import check_times, read_times, stamps_of_rate
from segfloor_ros.camera.sources.sensor_files import folder_sensors
from segfloor_ros.camera.sources.sides import is_side, side_pairs
from segfloor_ros.camera.sources.source import StereoSource
from segfloor_ros.errors import InputError
from segfloor_ros.files.tables import whole_nanoseconds

TIME_FILES = ('times.txt', 'timestamps.txt')
NANOSECOND_DIGITS = 16
"""A name that is a number of so many digits is taken for a stamp in ns."""


def has_image_sides(folder: Path) -> bool:
    """Whether `folder` holds two folders of images, or left and right images."""
    return _side_images(folder) is not None


def open_image_folders(folder: Path, settings: StereoCameraSettings) -> StereoSource:
    """Open two image folders with their calibration. Raises InputError or CalibrationError."""
    sides = _side_images(folder)
    if settings.depth or (sides and not sides[1] and (folder / DEPTH).is_dir()):
        return _open_depth(folder, sides[0] if sides else [], settings)
    left, right = find_image_pairs(folder)
    stamps = _stamps(folder, left, settings.rate_hz)
    pairs = [
        files.FilePair(i, *fields) for i, fields in enumerate(zip(stamps, left, right, strict=True))
    ]
    places = (folder, left[0].parent, left[0].parent.parent)
    calibration = find_calibration(str(folder), places, settings)
    sensors = folder_sensors(folder, settings.ignored_sensors)
    return files.file_pair_source(str(folder), pairs, calibration, settings.bit_depth, sensors)


def _open_depth(folder: Path, left: Sequence[Path], settings: StereoCameraSettings) -> StereoSource:
    if not left:
        raise InputError(f'{folder}: expected an image folder left beside depth')
    stamps = _stamps(folder, left, settings.rate_hz)
    pairs = [
        files.FilePair(i, stamp, path, path)
        for i, (stamp, path) in enumerate(zip(stamps, left, strict=True))
    ]
    eye = given_left_calibration(settings) or read_eye_calibration(folder / 'left.yaml')
    return with_depth(folder, pairs, eye, settings)


def find_image_pairs(folder: Path) -> tuple[list[Path], list[Path]]:
    """Return the left and the right images of a folder, in natural order, partner by partner.

    Either in two subfolders (`left` and `right`, or similar names), or side by side
    (`left01.jpg`, `right01.jpg`). Raises InputError when they do not match.
    """
    sides = _side_images(folder)
    if sides is None:
        raise InputError(
            f'{folder}: expected image folders left and right, or images left01… and right01…'
        )
    left, right = sides
    if not (left and right) and (left or right):
        raise InputError(f'{folder}: {len(left)} left and {len(right)} right images; {MONO}')
    files.check_equal_numbers(str(folder), left, right)
    for one, other in zip(left, right, strict=True):
        if _numbers(one) and _numbers(other) and _numbers(one)[-1:] != _numbers(other)[-1:]:
            raise InputError(
                f'{folder}: {one.name} has no partner, {other.name} comes next on the right; '
                'remove the images without partner'
            )
    return left, right


def _side_images(folder: Path) -> tuple[list[Path], list[Path]] | None:
    folders = {path.name: path for path in sorted(folder.iterdir()) if path.is_dir()}
    for left, right in side_pairs(folders):
        images = _nested_images(folders[left]), _nested_images(folders[right])
        if any(images):
            return images
    # Both sides in one folder, or a lonely side, whose partner is missed in the next check.
    left_images, right_images = (
        [path for path in files.images_in(folder) if is_side(path.stem, side)]
        or [
            path
            for name in folders
            if is_side(name, side)
            for path in _nested_images(folders[name])
        ]
        for side in (0, 1)
    )
    return (left_images, right_images) if left_images or right_images else None


def _nested_images(folder: Path) -> list[Path]:
    data = folder / 'data'
    return files.images_in(folder) or (files.images_in(data) if data.is_dir() else [])


def _numbers(path: Path) -> list[int]:
    return [int(digits) for digits in re.findall(r'\d+', path.stem)]


def _stamps(folder: Path, left: Sequence[Path], rate_hz: float) -> list[int]:
    """Stamps from a file of times, from names that are times in ns, or else from the rate."""
    for name in TIME_FILES:
        if (folder / name).exists():
            stamps = read_times(folder / name)
            check_times(folder / name, stamps, left)
            return stamps
    if all(len(path.stem) >= NANOSECOND_DIGITS for path in left):
        with contextlib.suppress(ValueError):
            return [whole_nanoseconds(path.stem) for path in left]
    return stamps_of_rate(len(left), rate_hz)
