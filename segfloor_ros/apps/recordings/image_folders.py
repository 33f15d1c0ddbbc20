"""Folders of images: any two with ROS calibration files, EuRoC (cam0 and cam1, each with data.csv,
sensor.yaml and data/), KITTI (image_0 and image_1 or image_2 and image_3, calib.txt, times.txt),
and depth cameras: depth/ beside the left images, or a sequence of the TUM RGB-D benchmark.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import segfloor_ros.apps.recordings.files as files
from segfloor_ros.apps.recordings.calibration_files import (
    KALIBR_NAMES,
    find_calibration,
    given_calibration,
    given_left_calibration,
    read_body_pose,
    read_eye_calibration,
    read_kalibr_imu,
    read_kitti_calibration,
    read_kitti_eye,
)
from segfloor_ros.apps.recordings.files import (
    IMU,
    check_times,
    folder_sensors,
    is_side,
    rate_of,
    read_times,
    side_pairs,
    stamps_of_rate,
)
from segfloor_ros.apps.recordings.other_calibrations import read_other
from segfloor_ros.apps.recordings.source import PLAUSIBLE_HZ, StereoSource
from segfloor_ros.core.camera.calibration import EyeCalibration, StereoCalibration
from segfloor_ros.core.camera.depth import depth_calibration, disparity_of_depth
from segfloor_ros.core.camera.recording import DEPTH, RecordedSensor
from segfloor_ros.core.camera.settings import StereoCameraSettings
from segfloor_ros.core.errors import CalibrationError, InputError
from segfloor_ros.core.files.images import read_depth
from segfloor_ros.core.files.whole import END_NS, nanoseconds, read_lines, whole_nanoseconds
from segfloor_ros.core.geometry import Array, invert, make_transform
from segfloor_ros.nodes.shared.joining import Stamped

logger = logging.getLogger(__name__)

TIME_FILES = ('times.txt', 'timestamps.txt')
NANOSECOND_DIGITS = len(str(END_NS))
"""Names that are numbers of so many digits are stamps in ns: those of this century have as many."""

EUROC_CAMERAS = ('cam0', 'cam1')
IMU_FOLDER = 'imu0'
INDEX = 'data.csv'
SENSOR = 'sensor.yaml'

KITTI_CAMERAS = ((0, 1), (2, 3))
KITTI_RAW = 'calib_cam_to_cam.txt'
"""Calibration of a day of KITTI's raw recordings, beside the folders of its drives."""

TUM_UNIT_M = 1 / 5000
"""Depth images of the TUM RGB-D benchmark (Sturm et al., IROS 2012)."""

TUM_TOLERANCE_S = 0.02
TUM_SIZE = 640, 480
TUM_PAIRS = ('associations.txt', 'association.txt', 'associate.txt', 'assoc.txt')
"""Lists of pairs, as the benchmark's own tool and ORB-SLAM have them."""
TUM_CAMERAS = {
    'freiburg1': (517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    'freiburg2': (520.9, 521.0, 325.1, 249.7, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    'freiburg3': (535.4, 539.2, 320.1, 247.6, (0.0,) * 5),
    '': (525.0, 525.0, 319.5, 239.5, (0.0,) * 5),
}
"""Intrinsics fx, fy, cx, cy and distortion of the benchmark's colour cameras by a part of the
folder's name, as published."""

CALIBRATIONS = ('left.yaml', 'rgb.yaml', 'color.yaml', 'camera.yaml', 'camera_info.yaml')
MONO = (
    'one camera alone does not tell how far away anything is: it takes a right image or a depth '
    'image for each of its images'
)


def has_image_sides(folder: Path) -> bool:
    """Whether `folder` holds two folders of images, or left and right images."""
    return _side_images(folder) is not None


def open_image_folders(folder: Path, settings: StereoCameraSettings) -> StereoSource:
    """Open two image folders with their calibration. Raises InputError or CalibrationError."""
    sides = _side_images(folder)
    if settings.depth or (sides and not sides[1] and (folder / DEPTH).is_dir()):
        return _open_depth(folder, sides[0] if sides else [], settings)
    left, right = _both_sides(folder)
    stamps = _stamps(folder, left, settings.rate_hz)
    places = files.partners(str(folder), left, right)
    pairs = [
        files.FilePair(number, stamps[i], left[i], right[j])
        for number, (i, j) in enumerate(zip(*places, strict=True))
    ]
    near = (folder, left[0].parent, left[0].parent.parent)
    raw = next((p for p in (folder / KITTI_RAW, folder.parent / KITTI_RAW) if p.is_file()), None)
    calibration = None if raw is None else given_calibration(settings)
    if raw is not None and calibration is None:
        number = left[0].parts[-3].removeprefix('image_')
        cameras = ('02', '03') if number == '02' else ('00', '01')
        size = files.first_image_size(left, str(folder))
        calibration = read_other(raw, size=size, cameras=cameras)
    calibration = calibration or find_calibration(str(folder), near, settings)
    sensors = folder_sensors(folder, settings.ignored_sensors)
    return files.file_pair_source(str(folder), pairs, calibration, sensors)


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
    (`left01.jpg`, `right01.jpg`). Raises InputError where there are no pairs.
    """
    left, right = _both_sides(folder)
    chosen = files.partners(str(folder), left, right)
    return [left[i] for i in chosen[0]], [right[i] for i in chosen[1]]


def _both_sides(folder: Path) -> tuple[list[Path], list[Path]]:
    """Return all left and all right images of a folder. Raises InputError where a side is empty."""
    sides = _side_images(folder)
    if sides is None:
        raise InputError(
            f'{folder}: expected image folders left and right, or images left01… and right01…'
        )
    if not all(sides) and any(sides):
        left, right = map(len, sides)
        raise InputError(f'{folder}: {left} left and {right} right images; {MONO}')
    return sides


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


def _stamps(folder: Path, left: Sequence[Path], rate_hz: float) -> list[int]:
    """Stamps from a file of times, in the folder or beside its left images, from names that are
    times in ns, or else from the rate.
    """
    for place in dict.fromkeys((folder, left[0].parent, left[0].parent.parent)):
        for name in TIME_FILES:
            if (place / name).exists():
                return _indices_and_stamps(place / name, left, rate_hz)[1]
    if all(len(path.stem) >= NANOSECOND_DIGITS for path in left):
        with contextlib.suppress(ValueError):
            return [whole_nanoseconds(path.stem) for path in left]
    return stamps_of_rate(len(left), rate_hz)


def _are_numbers(sides: tuple[list[Path], list[Path]] | None) -> bool:
    """Whether the names of the left images are no stamps in ns, but e.g. numbers in a row."""
    names = [path.stem for path in sides[0]] if sides else []
    if not all(name.isdecimal() for name in names):
        return True
    return len(names) > 1 and rate_of([int(name) for name in names]) > PLAUSIBLE_HZ[1]


def is_euroc(folder: Path) -> bool:
    """Whether `folder` (or its `mav0`) looks like an EuRoC sequence: by its files, or else by its
    folders.
    """
    root = _root(folder)
    names = (INDEX, SENSOR, 'data') if root != folder else (INDEX, SENSOR)
    return any((root / cam / name).exists() for cam in EUROC_CAMERAS for name in names)


def open_euroc(folder: Path, settings: StereoCameraSettings) -> StereoSource:
    """Open an EuRoC ASL folder. Left and right are paired by their stamps.

    Raises InputError or CalibrationError.
    """
    root = _root(folder)
    if not (root / EUROC_CAMERAS[0] / INDEX).exists() and _are_numbers(_side_images(root)):
        return open_image_folders(root, settings)
    left, right = (_read_index(root / camera) for camera in EUROC_CAMERAS)
    names = (str(root / EUROC_CAMERAS[0]), str(root / EUROC_CAMERAS[1]))
    pairs = files.pairs_by_stamp(left, right, settings.pairing_tolerance_s, names)
    calibration = find_calibration(str(folder), (root, folder), settings)
    sensors = _sensors(root, folder, calibration, settings)
    return files.file_pair_source(str(folder), pairs, calibration, sensors)


def _root(folder: Path) -> Path:
    return folder / 'mav0' if (folder / 'mav0').is_dir() else folder


def _sensors(
    root: Path, folder: Path, calibration: StereoCalibration, settings: StereoCameraSettings
) -> list[RecordedSensor]:
    imu, ignored = root / IMU_FOLDER / INDEX, settings.ignored_sensors
    if not imu.exists() or IMU in ignored:
        return folder_sensors(root, ignored, None, imu)
    T_raw_imu = _T_raw_imu(root, folder)
    if T_raw_imu is None:
        logger.warning('%s: no %s says how the IMU is mounted; it is left out', imu.parent, SENSOR)
        return folder_sensors(root, {*ignored, IMU}, None, imu)
    T_left_raw = make_transform(calibration.left.R, np.zeros(3))
    return folder_sensors(root, ignored, T_left_raw @ T_raw_imu, imu)


def _T_raw_imu(root: Path, folder: Path) -> Array | None:
    """Return the IMU's frame in that of the raw left images (4, 4), None where no file has it."""
    for chain in (place / name for place in (root, folder) for name in KALIBR_NAMES):
        if chain.exists():
            return read_kalibr_imu(chain)
    mounts = [root / name / SENSOR for name in (EUROC_CAMERAS[0], IMU_FOLDER)]
    if not all(mount.exists() for mount in mounts):
        return None
    T_body_left, T_body_imu = (read_body_pose(mount) for mount in mounts)
    return invert(T_body_left) @ T_body_imu


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
    return Stamped(stamp_ns, folder / (name.strip() or f'{stamp.strip()}.png'))


def _named_by_stamp(images: Iterable[Path]) -> Iterator[Stamped[Path]]:
    for path in images:
        with contextlib.suppress(ValueError):
            yield Stamped(whole_nanoseconds(path.stem), path)


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
    places = files.partners(str(folder), left, right)
    indices, stamps = _indices_and_stamps(folder / 'times.txt', left, settings.rate_hz)
    pairs = [
        files.FilePair(indices[i], stamps[i], left[i], right[j])
        for i, j in zip(*places, strict=True)
    ]
    calib, size = folder / 'calib.txt', files.first_image_size(left, str(folder))
    if partner is None or not has_right:
        eye = given_left_calibration(settings) or read_kitti_eye(calib, *size, camera)
        return with_depth(folder, pairs, eye, settings)
    calibration = given_calibration(settings)
    calibration = calibration or read_kitti_calibration(calib, *size, (camera, partner))
    sensors = folder_sensors(folder, settings.ignored_sensors)
    return files.file_pair_source(str(folder), pairs, calibration, sensors)


def _cameras(folder: Path) -> tuple[int, int | None]:
    """Return the numbers of the left and the right camera; None for the latter where there are
    depth images.
    """
    for cameras in KITTI_CAMERAS:
        if all((folder / f'image_{camera}').is_dir() for camera in cameras):
            return cameras
    for camera, _ in KITTI_CAMERAS:
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


def _depth_source(
    name: str,
    pairs: Sequence[files.FilePair],
    left: EyeCalibration,
    settings: StereoCameraSettings,
    sensors: Sequence[RecordedSensor],
    metres_per_unit: float | None = None,
) -> StereoSource:
    """Return images with depth images in place of the right ones. left: of the raw images."""
    calibration, scale = depth_calibration(left), settings.depth_scale or metres_per_unit

    def read_disparity(path: Path) -> NDArray[Any]:
        return disparity_of_depth(read_depth(path), calibration.camera, scale)

    found = RecordedSensor(DEPTH, str(pairs[0].right.parent), len(pairs), True)
    others = [sensor for sensor in sensors if sensor.name != DEPTH]
    return files.file_pair_source(name, pairs, calibration, [found, *others], read_disparity)


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
            f'{folder / DEPTH}: there are no depth images (16-bit PNG in mm, TIFF of floats in '
            'm); leave out --depth'
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
    """Whether `folder` looks like a sequence of the TUM RGB-D benchmark: with both lists of images,
    or with one of pairs.
    """
    lists = all((folder / name).is_file() for name in ('rgb.txt', 'depth.txt'))
    return lists or _associations(folder) is not None


def _associations(folder: Path) -> Path | None:
    return next((folder / name for name in TUM_PAIRS if (folder / name).is_file()), None)


def open_tum_rgbd(folder: Path, settings: StereoCameraSettings) -> StereoSource:
    """Open a folder of the TUM RGB-D benchmark. Colour and depth are paired by their stamps.

    Raises InputError or CalibrationError.
    """
    pairs_file = None if (folder / 'rgb.txt').is_file() else _associations(folder)
    if pairs_file is None:
        names = (str(folder / 'rgb.txt'), str(folder / 'depth.txt'))
        colour, depth = (_read_list(Path(name)) for name in names)
    else:
        names = (f'{pairs_file}, colour', f'{pairs_file}, depth')
        colour, depth = _read_associations(pairs_file, settings.rate_hz)
    tolerance_s = max(settings.pairing_tolerance_s, TUM_TOLERANCE_S)
    pairs = files.pairs_by_stamp(colour, depth, tolerance_s, names)
    eye = given_left_calibration(settings) or _tum_camera(folder, [pair.left for pair in pairs])
    sensors = folder_sensors(folder, settings.ignored_sensors)
    return _depth_source(str(folder), pairs, eye, settings, sensors, TUM_UNIT_M)


def _tum_camera(folder: Path, images: Sequence[Path]) -> EyeCalibration:
    for name in CALIBRATIONS:
        if (folder / name).exists():
            return read_eye_calibration(folder / name)
    part, (fx, fy, cx, cy, distortion) = next(
        (key, value) for key, value in TUM_CAMERAS.items() if key in folder.resolve().name
    )
    width, height = files.first_image_size(images, str(folder))
    here = f'put camera.yaml into {folder}, or give stereo_camera.left_calibration'
    if (width, height) != TUM_SIZE:
        raise CalibrationError(
            f'{folder}: no calibration: its images are {width}x{height}, those of the TUM RGB-D '
            f'benchmark are 640x480; {here}'
        )
    if not part:
        logger.warning(
            '%s: no calibration; that of a first Kinect is taken, fx = 525 px; %s', folder, here
        )
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return EyeCalibration.of_raw(
        TUM_SIZE, K, np.array(distortion), origin='the TUM RGB-D benchmark'
    )


def _read_associations(file: Path, rate_hz: float) -> list[list[Stamped[Path]]]:
    """Return colour and depth of a file of pairs: time, image, time, image, in any order. Numbers
    of frames in place of times stand for the rate.
    """
    rows = []
    for where, line in read_lines(file):
        words = line.split()
        if len(words) != 4 or 'depth' not in words[1] + words[3]:
            raise InputError(f'{where}: expected a time, an rgb image, a time and a depth image')
        rows.append(words if 'depth' in words[3] else words[2:] + words[:2])
    if not rows:
        raise InputError(f'{file}: names no image')
    numbers = [words[0] for words in rows]
    if all(n.isdecimal() and int(n) == int(numbers[0]) + i for i, n in enumerate(numbers)):
        stamps = [stamps_of_rate(len(rows), rate_hz)] * 2
    else:
        sides = ([words[i] for words in rows] for i in (0, 2))
        stamps = [files.stamps_of(file, side) for side in sides]
    return [
        [
            Stamped(stamp_ns, file.parent / words[1 + 2 * side])
            for stamp_ns, words in zip(stamps[side], rows, strict=True)
        ]
        for side in (0, 1)
    ]


def _read_list(index: Path) -> list[Stamped[Path]]:
    """Return the images of rgb.txt or depth.txt: lines of a time in seconds and a file name."""

    def entry(line: str, where: str) -> Stamped[Path]:
        with contextlib.suppress(ValueError):
            seconds, name = line.split()
            return Stamped(nanoseconds(seconds), index.parent / name)
        raise InputError(f'{where}: expected a time in seconds and the name of an image')

    entries = files.read_index(index, entry)
    if not entries:
        raise InputError(f'{index}: names no image')
    return entries
