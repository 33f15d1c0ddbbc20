"""Wheel odometry and IMU files beside the images of a folder."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.camera.calibration.files import read_body_pose
from segfloor_ros.errors import InputError
from segfloor_ros.files.whole import nanoseconds, number, read_lines, whole_nanoseconds
from segfloor_ros.geometry import Array
from segfloor_ros.measurements import DEPTH, ImuSample, Measurement, RecordedSensor, WheelPose

WHEEL_ODOMETRY, IMU = 'wheel_odometry', 'imu'
WHEEL_FILE, IMU_FILE = 'wheel_odometry.txt', 'imu.csv'
TUM_COLUMNS = 't x y z qx qy qz qw'
IMU_COLUMNS = 'stamp in ns, angular velocity x y z in rad/s, acceleration x y z in m/s²'
ACCEL_RANGE_M_S2 = (7.0, 13.0)
"""Median acceleration felt on earth; outside of it the unit or the columns are wrong."""

UPRIGHT = 0.8
"""Cosine of the angle between gravity and the image's vertical up to which a camera is upright."""


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
    table, stamps_ns = _read_table(path, 8, TUM_COLUMNS, nanoseconds)
    norms = np.linalg.norm(table[:, 3:7], axis=1)
    bad = np.flatnonzero(np.abs(norms - 1) > 0.01)
    if len(bad):
        raise InputError(
            f'{path}, pose {bad[0] + 1}: the quaternion has length {norms[bad[0]]:.3g}, not 1; '
            f'expected {TUM_COLUMNS}'
        )
    from scipy.spatial.transform import Rotation  # see geometry.py

    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(table[:, 3:7]).as_matrix()
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
    felt = float(np.nanmedian(np.linalg.norm(accel_m_s2, axis=1)))
    if not ACCEL_RANGE_M_S2[0] <= felt <= ACCEL_RANGE_M_S2[1]:
        raise InputError(
            f'{where}: the median acceleration is {felt:.3g}, but gravity alone is 9.81 m/s²; '
            'correct the unit or the columns, or leave it out with --ignore imu'
        )


def is_upright(accel_m_s2: Array) -> bool:
    """Whether up is about up in the image for what an IMU at rest feels (3,): its axes may be those
    of the image.
    """
    return bool(-accel_m_s2[1] > UPRIGHT * np.linalg.norm(accel_m_s2))


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
