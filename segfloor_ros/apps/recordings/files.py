"""Files of one recording: images with stamps, wheel odometry and IMU samples."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.apps.recordings.calibration_files import read_body_pose
from segfloor_ros.apps.recordings.source import (
    DEFAULT_RATE_HZ,
    PairEntry,
    StampPairing,
    StereoSource,
    check_forward,
)
from segfloor_ros.core.camera.calibration import StereoCalibration
from segfloor_ros.core.camera.pixels import Grey
from segfloor_ros.core.camera.recording import DEPTH, RecordedSensor
from segfloor_ros.core.contracts import ImuSample, Measurement, WheelPose
from segfloor_ros.core.errors import CorruptImageError, InputError
from segfloor_ros.core.files.images import read_colour, read_grey
from segfloor_ros.core.files.whole import (
    digits_of,
    nanoseconds,
    number,
    read_lines,
    time_of,
    whole_nanoseconds,
)
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.quaternions import rotations_of
from segfloor_ros.nodes.shared.joining import Stamped

T = TypeVar('T')

logger = logging.getLogger(__name__)

SIDES = (
    ('left', 'right'),
    ('Left', 'Right'),
    ('LEFT', 'RIGHT'),
    ('infra1', 'infra2'),
    ('cam0', 'cam1'),
    ('cam_0', 'cam_1'),
    ('camera0', 'camera1'),
    ('camera_0', 'camera_1'),
    ('image0', 'image1'),
    ('image_00', 'image_01'),
    ('image_0', 'image_1'),
    ('image_02', 'image_03'),
    ('image_2', 'image_3'),
)
"""Words for left and right inside a name, the usual ones first."""

IMAGE_SUFFIXES = {'.png', '.jpg', '.jpeg', '.bmp', '.pgm', '.ppm', '.tif', '.tiff', '.webp'}

WHEEL_ODOMETRY, IMU = 'wheel_odometry', 'imu'
WHEEL_FILE, IMU_FILE = 'wheel_odometry.txt', 'imu.csv'
TUM_COLUMNS = 't x y z qx qy qz qw'
IMU_COLUMNS = 'stamp in ns, angular velocity x y z in rad/s, acceleration x y z in m/s²'
ACCEL_RANGE_M_S2 = (7.0, 13.0)
"""Median acceleration measured on earth; outside of it the unit or the columns are wrong."""


def read_times(path: Path) -> list[int]:
    """Return the stamps in ns of a file with one time per line: in seconds or another unit
    (`digits_of`), or a date with the time of day.

    Raises InputError naming the line where one is no number or earlier than the one before; and
    where all are the same.
    """
    stamps = stamps_of(path, [time_of(line) for _, line in read_lines(path)])
    if len(stamps) > 1 and stamps[0] == stamps[-1]:
        raise InputError(
            f'{path}: all {len(stamps)} times are the same; it needs the time in seconds of each '
            'pair, or remove it to read the images at stereo_camera.rate_hz'
        )
    return stamps


def stamps_of(path: Path, times: Sequence[str]) -> list[int]:
    """Return the stamps in ns of the times in the lines of a file. Raises InputError naming the
    line.
    """
    digits = digits_of(times, str(path))
    wheres = (where for where, _ in read_lines(path))
    stamps: list[int] = []
    for where, time in zip(wheres, times, strict=True):
        try:
            stamp_ns = nanoseconds(time, digits)
        except ValueError as error:
            raise InputError(f'{where}: expected a time in seconds ({error})') from None
        check_forward(where, stamps[-1:], stamp_ns)
        stamps.append(stamp_ns)
    return stamps


def check_times(path: Path, stamps: Sequence[int], images: Sequence[Path]) -> None:
    """Raise InputError unless a file has as many times as there are left images."""
    if len(stamps) != len(images):
        raise InputError(
            f'{path}: {len(stamps)} times for {len(images)} pairs of images; it needs one line '
            'for each, or remove it to read the images at stereo_camera.rate_hz'
        )


def stamps_of_rate(count: int, rate_hz: float) -> list[int]:
    """Return `count` stamps in ns from 0 on at `rate_hz`, or at the usual rate where that is 0."""
    return [round(i * 1e9 / (rate_hz or DEFAULT_RATE_HZ)) for i in range(count)]


def rate_of(stamps_ns: Sequence[int]) -> float:
    """Return the frame rate in Hz of ascending stamps: of their median interval."""
    intervals = np.diff(stamps_ns)
    intervals = intervals[intervals > 0]
    return float(1e9 / np.median(intervals)) if intervals.size else DEFAULT_RATE_HZ


def side_pairs(names: Iterable[str]) -> list[tuple[str, str]]:
    """Return the (left, right) names that differ only in the word for the side, in the order of
    `SIDES`, then of `names`.
    """
    known = list(names)
    pairs: dict[tuple[str, str], None] = {}
    for left_word, right_word in SIDES:
        for name in known:
            partner = name.replace(left_word, right_word)
            if partner != name and partner in known:
                pairs[name, partner] = None
    return list(pairs)


def is_side(name: str, side: int) -> bool:
    """Whether `name` says, in letters, that it is the left (0) or the right (1) side."""
    return ('left', 'right')[side] in name.lower()


@dataclass(frozen=True)
class FilePair:
    """Two image files of one moment; index: their number in the recording."""

    index: int
    stamp_ns: int
    left: Path
    right: Path


def file_pair_source(
    name: str,
    pairs: Sequence[FilePair],
    calibration: StereoCalibration,
    sensors: Sequence[RecordedSensor] = (),
    read_right: Callable[[Path], NDArray[Any]] | None = None,
) -> StereoSource:
    """Return a recording of image files. read_right: of what stands in place of the right images.
    Raises InputError.
    """

    def entries(source: StereoSource) -> Iterator[PairEntry]:
        last_ns = None
        for pair in pairs:
            if pair.stamp_ns == last_ns:
                source.skip(pair.index, f'its stamp {last_ns} ns was there before')
                continue
            last_ns = pair.stamp_ns
            read_left = read_colour if source.takes_colour else read_grey
            yield PairEntry(pair.index, pair.stamp_ns, partial(load, pair, read_left))

    def load(pair: FilePair, read_left: Callable[[Path], Grey]) -> tuple[Grey, NDArray[Any]]:
        return read_left(pair.left), (read_right or read_grey)(pair.right)

    stamps = [pair.stamp_ns for pair in pairs]
    source = StereoSource(
        name, calibration, entries, frame_count=len(pairs), rate_hz=rate_of(stamps), sensors=sensors
    )
    check_shared_clock(sensors, stamps)
    return source


def read_index(index: Path, parse: Callable[[str, str], Stamped[Path]]) -> list[Stamped[Path]]:
    """Return the images that the lines of a file name, those with `#` in front left out. parse:
    gets the line and what to call it. Images that are not there are counted in a warning and left
    out: a part of a recording often has the list of the whole. Raises InputError where all are
    missing, and for stamps that go backwards.
    """
    entries: list[Stamped[Path]] = []
    for where, line in read_lines(index):
        entry = parse(line, where)
        check_forward(where, [e.stamp_ns for e in entries[-1:]], entry.stamp_ns)
        entries.append(entry)
    there = [entry for entry in entries if entry.item.exists()]
    if len(there) < len(entries):
        first = next(entry.item for entry in entries if entry not in there)
        missing = f'{index}: {len(entries) - len(there)} of {len(entries)} images do not exist, '
        missing += f'the first is {first}'
        if not there:
            raise InputError(f'{missing}; complete the copy')
        logger.warning('%s; they are left out', missing)
    return there


def pairs_by_stamp(
    left: Sequence[Stamped[Path]],
    right: Sequence[Stamped[Path]],
    tolerance_s: float,
    names: tuple[str, str],
) -> list[FilePair]:
    """Return the images of two lists that belong together. names: of both, for messages. Raises
    InputError where there are none.
    """
    pairing: StampPairing[Path] = StampPairing(tolerance_s, names)
    # A right image comes once all left ones are there that may be nearer.
    images = [(one.stamp_ns, 0, one) for one in left]
    images += [(one.stamp_ns + round(1e9 * tolerance_s), 1, one) for one in right]
    images.sort(key=lambda image: image[:2])
    found = (pairing.add(side, one.stamp_ns, one.item) for _, side, one in images)
    matches = [*chain.from_iterable(found), *pairing.finish()]
    pairing.report()
    return [
        FilePair(i, one.stamp_ns, one.item, other.item) for i, (one, other) in enumerate(matches)
    ]


def first_image_size(paths: Sequence[Path], name: str) -> tuple[int, int]:
    """Return (width, height) of the first image that can be decoded. Raises InputError."""
    for path in paths:
        try:
            height, width = read_grey(path).shape
        except CorruptImageError:
            continue
        return width, height
    raise InputError(f'{name}: none of its {len(paths)} images can be decoded')


def images_in(folder: Path) -> list[Path]:
    """Return the image files of a folder in natural order: `left2` before `left10`."""
    files = (path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)
    return sorted((path for path in files if not path.name.startswith('.')), key=natural_key)


def natural_key(path: Path) -> list[tuple[int, str]]:
    """Return a sort key that reads runs of digits as numbers."""
    parts = re.split(r'(\d+)', path.name.casefold())
    return [(int(part), '') if part.isdecimal() else (0, part) for part in parts]


def partners(name: str, left: Sequence[Path], right: Sequence[Path]) -> tuple[list[int], list[int]]:
    """Return which left and which right images, by their places, are pairs: those with the same
    last number in their names; in their order where such numbers tell nothing and both sides have
    as many. Images without partner are counted in a warning and left out. Raises InputError where
    none has one.
    """
    if not left and not right:
        raise InputError(f'{name}: there are no images in its folders')
    places = [_by_number(side) for side in (left, right)]
    if not all(places) and len(left) == len(right):
        return list(range(len(left))), list(range(len(right)))
    common = [number for number in places[0] if number in places[1]]
    if not common:
        raise InputError(
            f'{name}: {len(left)} left and {len(right)} right images, none with the number of one '
            'of the other side; complete the copy, or give partners the same number'
        )
    alone = [len(side) - len(common) for side in (left, right)]
    if any(alone):
        logger.warning(
            '%s: %d left and %d right images have no partner of the same number; they are left out',
            name, *alone,
        )  # fmt: skip
    return [places[0][number] for number in common], [places[1][number] for number in common]


def _by_number(paths: Sequence[Path]) -> dict[int, int]:
    """Return the places of files by the last number of their names; empty where that is not one of
    its own for each.
    """
    numbers = [re.findall(r'\d+', path.stem)[-1:] for path in paths]
    places = {int(last): place for place, found in enumerate(numbers) for last in found}
    return places if len(places) == len(paths) else {}


def folder_sensors(
    folder: Path, ignored: Collection[str], T_left_imu: Array | None = None, imu: Path | None = None
) -> list[RecordedSensor]:
    """Return the sensors whose files lie in a folder; depth images count as not used.

    T_left_imu: (4, 4), the frame of what the file `imu` holds in the rectified left optical one.
    Raises InputError when a file that is used is bad.
    """
    files: list[tuple[str, Path, Callable[[Path], Sequence[Measurement]]]] = [
        (WHEEL_ODOMETRY, folder / WHEEL_FILE, read_wheel_odometry),
        (IMU, imu or folder / IMU_FILE, lambda path: read_imu(path, T_left_imu)),
    ]
    found = [
        _sensor(name, path, read, name not in ignored)
        for name, path, read in files
        if path.exists()
    ]
    depth = [*(folder / DEPTH).glob('*.png')]
    if depth:
        found.append(RecordedSensor(DEPTH, str(folder / DEPTH), len(depth), False))
    return found


def _sensor(
    name: str, path: Path, read: Callable[[Path], Sequence[Measurement]], used: bool
) -> RecordedSensor:
    if not used:
        return RecordedSensor(name, str(path), sum(1 for _ in read_lines(path)), False)
    measurements = read(path)
    return RecordedSensor(name, str(path), len(measurements), True, lambda: measurements)


def read_wheel_odometry(path: Path) -> list[WheelPose]:
    """Return the poses of a file in the TUM format. Raises InputError naming file and line."""
    digits = digits_of((time_of(line) for _, line in read_lines(path)), str(path))
    table, stamps_ns = _read_table(path, 8, TUM_COLUMNS, partial(nanoseconds, digits=digits))
    norms = np.linalg.norm(table[:, 3:7], axis=1)
    bad = np.flatnonzero(np.abs(norms - 1) > 0.01)
    if len(bad):
        raise InputError(
            f'{path}, pose {bad[0] + 1}: the quaternion has length {norms[bad[0]]:.3g}, not 1; '
            f'expected {TUM_COLUMNS}'
        )
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, :3] = rotations_of(table[:, 3:7])
    poses[:, :3, 3] = table[:, :3]
    return [WheelPose(int(stamp), pose) for stamp, pose in zip(stamps_ns, poses, strict=True)]


def read_imu(path: Path, T_left_imu: Array | None = None) -> list[ImuSample]:
    """Return the samples of a file with the columns of EuRoC's data.csv. A YAML file of the same
    name tells by `T_BS` where the IMU is; T_left_imu: (4, 4), and where that frame is in the
    rectified left optical one.

    Raises InputError naming file and line, or CalibrationError.
    """
    table, stamps_ns = _read_table(path, 7, IMU_COLUMNS, whole_nanoseconds)
    check_gravity(str(path), table[:, 3:6])
    beside = path.with_suffix('.yaml')
    T = np.eye(4) if T_left_imu is None else T_left_imu
    T = T @ read_body_pose(beside) if beside.exists() else T
    return [
        ImuSample.seen_from(T, int(stamp), row[:3], row[3:6])
        for stamp, row in zip(stamps_ns, table, strict=True)
    ]


def check_gravity(where: str, accel_m_s2: Array) -> None:
    """Raise InputError unless accelerations (N, 3) are about those on earth."""
    median_m_s2 = float(np.nanmedian(np.linalg.norm(accel_m_s2, axis=1)))
    if not ACCEL_RANGE_M_S2[0] <= median_m_s2 <= ACCEL_RANGE_M_S2[1]:
        raise InputError(
            f'{where}: the median acceleration is {median_m_s2:.3g}, but gravity alone is 9.81 '
            'm/s²; correct the unit or the columns, or leave it out with --ignore imu'
        )


def check_shared_clock(sensors: Sequence[RecordedSensor], stamps_ns: Sequence[int]) -> None:
    """Raise InputError when a sensor that is used measured at no time of the images."""
    for sensor in sensors:
        times = sorted(m.stamp_ns for m in sensor.read()) if sensor.used else []
        if times and (times[-1] < stamps_ns[0] or times[0] > stamps_ns[-1]):
            raise InputError(
                f'{sensor.where}: its stamps, {times[0] / 1e9:.3f} to {times[-1] / 1e9:.3f} s, do '
                f'not meet those of the images, {stamps_ns[0] / 1e9:.3f} to '
                f'{stamps_ns[-1] / 1e9:.3f} s; bring them to one clock, or leave it out with '
                f'--ignore {sensor.name}'
            )


def _read_table(
    path: Path, columns: int, expected: str, read_stamp: Callable[[str], int]
) -> tuple[Array, NDArray[np.int64]]:
    """Return the numbers (N, columns - 1) after the stamps, and the stamps (N,) in ns, ascending;
    of several lines with the same stamp the first counts.
    """
    rows: dict[int, list[float]] = {}
    for where, line in read_lines(path):
        words = line.replace(',', ' ').split()
        try:
            values = [number(word) for word in words[1:columns]]
            stamp_ns = read_stamp(words[0])
        except ValueError as error:
            raise InputError(f'{where}: expected {expected} ({error})') from None
        if len(values) != columns - 1:
            raise InputError(f'{where}: expected {expected}')
        rows.setdefault(stamp_ns, values)
    if not rows:
        raise InputError(f'{path}: holds no measurement; expected {expected}')
    stamps = sorted(rows)
    return np.array([rows[stamp] for stamp in stamps]), np.array(stamps, np.int64)
