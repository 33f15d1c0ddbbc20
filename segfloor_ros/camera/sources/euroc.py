"""EuRoC ASL folders: cam0 and cam1, each with data.csv, sensor.yaml and data/."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path

import numpy as np

from segfloor_ros.camera.calibration.files import (
    given_calibration,
    read_body_pose,
    read_calibration,
)
from segfloor_ros.camera.calibration.parameters import StereoCalibration
from segfloor_ros.camera.settings import StereoCameraSettings
from segfloor_ros.camera.sources import files
from segfloor_ros.camera.sources.pairing import Stamped
from segfloor_ros.camera.sources.sensor_files import IMU, folder_sensors
from segfloor_ros.camera.sources.source import StereoSource
from segfloor_ros.errors import InputError
from segfloor_ros.files.tables import whole_nanoseconds
from segfloor_ros.geometry import invert, make_transform
from segfloor_ros.measurements import RecordedSensor

CAMERAS = ('cam0', 'cam1')
IMU_FOLDER = 'imu0'
INDEX = 'data.csv'
SENSOR = 'sensor.yaml'


def is_euroc(folder: Path) -> bool:
    """Whether `folder` (or its `mav0`) looks like an EuRoC sequence."""
    root = _root(folder)
    return any((root / cam / name).exists() for cam in CAMERAS for name in (INDEX, SENSOR))


def open_euroc(folder: Path, settings: StereoCameraSettings) -> StereoSource:
    """Open an EuRoC ASL folder. Left and right are paired by their stamps.

    Raises InputError or CalibrationError.
    """
    root = _root(folder)
    left, right = (_read_index(root / camera) for camera in CAMERAS)
    names = (str(root / CAMERAS[0]), str(root / CAMERAS[1]))
    pairs = files.pairs_by_stamp(left, right, settings.pairing_tolerance_s, names)
    sides = (root / camera / SENSOR for camera in CAMERAS)
    calibration = given_calibration(settings) or read_calibration(*sides)
    sensors = _sensors(root, calibration, settings)
    return files.file_pair_source(str(folder), pairs, calibration, settings.bit_depth, sensors)


def _root(folder: Path) -> Path:
    return folder / 'mav0' if (folder / 'mav0').is_dir() else folder


def _sensors(
    root: Path, calibration: StereoCalibration, settings: StereoCameraSettings
) -> list[RecordedSensor]:
    """The IMU of imu0 is in the rectified left optical frame where both `T_BS` have it."""
    imu, ignored = root / IMU_FOLDER / INDEX, settings.ignored_sensors
    if not imu.exists() or IMU in ignored:
        return folder_sensors(root, ignored, None, imu)
    T_body_left, T_body_imu = (read_body_pose(root / n / SENSOR) for n in (CAMERAS[0], IMU_FOLDER))
    T_left_raw = make_transform(calibration.left.R, np.zeros(3))
    T_left_imu = T_left_raw @ invert(T_body_left) @ T_body_imu
    return folder_sensors(root, ignored, T_left_imu, imu)


def _read_index(camera: Path) -> list[Stamped[Path]]:
    """Return the images of one camera with their stamps; without data.csv their names tell them."""
    if not (camera / 'data').is_dir():
        raise InputError(f'{camera / "data"}: no such folder; a stereo pair is cam0 and cam1')
    index = camera / INDEX
    if not index.exists():
        return [*_named_by_stamp(files.images_in(camera / 'data'))]
    return files.read_index(index, partial(_entry, camera / 'data'))


def _entry(folder: Path, line: str, where: str) -> Stamped[Path]:
    stamp, _, name = line.partition(',')
    try:
        stamp_ns = whole_nanoseconds(stamp.strip())
    except ValueError as error:
        raise InputError(f'{where}: expected a stamp in ns and a file name ({error})') from None
    image = folder / (name.strip() or f'{stamp.strip()}.png')
    if not image.exists():
        raise InputError(f'{where}: {image} does not exist; complete the copy, or remove the line')
    return Stamped(stamp_ns, image)


def _named_by_stamp(images: Iterable[Path]) -> Iterator[Stamped[Path]]:
    for path in images:
        with contextlib.suppress(ValueError):
            yield Stamped(whole_nanoseconds(path.stem), path)
