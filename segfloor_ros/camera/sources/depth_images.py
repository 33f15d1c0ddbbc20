"""Recordings of depth cameras: depth images beside those of a folder, and folders of the TUM RGB-D
benchmark.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.calibration.files import given_left_calibration, read_eye_calibration
from segfloor_ros.camera.calibration.parameters import EyeCalibration
from segfloor_ros.camera.depth import depth_calibration, disparity_of_depth
from segfloor_ros.camera.settings import StereoCameraSettings
from segfloor_ros.camera.sources import pairing as files
from segfloor_ros.camera.sources.pairing import Stamped
from segfloor_ros.camera.sources.sensor_files import DEPTH, folder_sensors
from segfloor_ros.camera.sources.source import StereoSource
from segfloor_ros.errors import InputError
from segfloor_ros.files.images import read_grey
from segfloor_ros.files.whole import nanoseconds
from segfloor_ros.geometry import make_transform
from segfloor_ros.measurements import RecordedSensor

TUM_UNIT_M = 1 / 5000
"""Depth images of the TUM RGB-D benchmark (Sturm et al., IROS 2012)."""

TUM_TOLERANCE_S = 0.02
TUM_CAMERAS = {
    'freiburg1': (517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    'freiburg2': (520.9, 521.0, 325.1, 249.7, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    'freiburg3': (535.4, 539.2, 320.1, 247.6, (0.0,) * 5),
}
"""Intrinsics fx, fy, cx, cy and distortion of the benchmark's colour cameras, as published."""

TUM_ANY_CAMERA = (525.0, 525.0, 319.5, 239.5, (0.0,) * 5)
CALIBRATIONS = ('left.yaml', 'rgb.yaml', 'color.yaml', 'camera.yaml', 'camera_info.yaml')
MONO = (
    'one camera alone does not tell how far away anything is: it takes a right image or a depth '
    'image for each of its images'
)


def _depth_source(
    name: str,
    pairs: Sequence[files.FilePair],
    left: EyeCalibration,
    settings: StereoCameraSettings,
    sensors: Sequence[RecordedSensor],
    metres_per_unit: float | None = None,
) -> StereoSource:
    """Return images with depth images in place of the right ones. left: of the raw images."""
    calibration = depth_calibration(left)

    def read_depth(path: Path) -> NDArray[Any]:
        return disparity_of_depth(read_grey(path), calibration.camera, metres_per_unit)

    found = RecordedSensor(DEPTH, str(pairs[0].right.parent), len(pairs), True)
    others = [sensor for sensor in sensors if sensor.name != DEPTH]
    return files.file_pair_source(
        name, pairs, calibration, settings.bit_depth, [found, *others], read_depth
    )


def with_depth(
    folder: Path,
    pairs: Sequence[files.FilePair],
    left: EyeCalibration,
    settings: StereoCameraSettings,
) -> StereoSource:
    """Return the left images of a folder with the depth images of its `depth/`, by file name or,
    where there are as many, in order. Raises InputError.
    """
    depth = files.images_in(folder / DEPTH) if (folder / DEPTH).is_dir() else []
    if not depth:
        raise InputError(
            f'{folder / DEPTH}: there are no depth images (16-bit PNG, mm); leave out --depth'
        )
    by_name = {path.stem: path for path in depth}
    partners = [by_name.get(pair.left.stem) for pair in pairs]
    if not all(partners) and len(depth) == len(pairs):
        partners = [*depth]
    missing = [pair.left.name for pair, path in zip(pairs, partners, strict=True) if path is None]
    if missing:
        raise InputError(
            f'{folder / DEPTH}: {len(depth)} depth images for {len(pairs)} left ones; the one of '
            f'{missing[0]} is missing'
        )
    found = [
        files.FilePair(pair.index, pair.stamp_ns, pair.left, path)
        for pair, path in zip(pairs, partners, strict=True)
        if path is not None
    ]
    # The images of a depth camera are not turned: `imu.csv` is in the axes of the rectified ones.
    sensors = folder_sensors(
        folder, settings.ignored_sensors, make_transform(left.R.T, np.zeros(3))
    )
    return _depth_source(str(folder), found, left, settings, sensors)


def is_tum_rgbd(folder: Path) -> bool:
    """Whether `folder` looks like a sequence of the TUM RGB-D benchmark."""
    return all((folder / name).is_file() for name in ('rgb.txt', 'depth.txt'))


def open_tum_rgbd(folder: Path, settings: StereoCameraSettings) -> StereoSource:
    """Open a folder of the TUM RGB-D benchmark. Colour and depth are paired by their stamps.

    Raises InputError or CalibrationError.
    """
    names = (str(folder / 'rgb.txt'), str(folder / 'depth.txt'))
    colour, depth = (_read_list(Path(name)) for name in names)
    tolerance_s = max(settings.pairing_tolerance_s, TUM_TOLERANCE_S)
    pairs = files.pairs_by_stamp(colour, depth, tolerance_s, names)
    eye = given_left_calibration(settings) or _tum_camera(folder, [pair.left for pair in pairs])
    sensors = folder_sensors(folder, settings.ignored_sensors)
    return _depth_source(str(folder), pairs, eye, settings, sensors, TUM_UNIT_M)


def _tum_camera(folder: Path, images: Sequence[Path]) -> EyeCalibration:
    for name in CALIBRATIONS:
        if (folder / name).exists():
            return read_eye_calibration(folder / name)
    published = [value for key, value in TUM_CAMERAS.items() if key in folder.resolve().name]
    fx, fy, cx, cy, distortion = (*published, TUM_ANY_CAMERA)[0]
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    width, height = files.first_image_size(images, str(folder))
    P = np.hstack([K, np.zeros((3, 1))])
    return EyeCalibration(
        width, height, K, np.array(distortion), np.eye(3), P, origin='the TUM RGB-D benchmark'
    )


def _read_list(index: Path) -> list[Stamped[Path]]:
    """Return the images of rgb.txt or depth.txt: lines of a time in seconds and a file name."""

    def entry(line: str, where: str) -> Stamped[Path]:
        with contextlib.suppress(ValueError):
            seconds, name = line.split()
            if (index.parent / name).exists():
                return Stamped(nanoseconds(seconds), index.parent / name)
        raise InputError(
            f'{where}: expected a time in seconds and the name of an image that is there'
        )

    entries = files.read_index(index, entry)
    if not entries:
        raise InputError(f'{index}: names no image')
    return entries
