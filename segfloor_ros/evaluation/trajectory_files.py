"""Trajectory files: TUM rows `t x y z qx qy qz qw` and KITTI rows of a 3x4 matrix with times.txt
beside them.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from segfloor_ros.errors import InputError
from segfloor_ros.geometry import Array

TUM_COLUMNS = 8
KITTI_COLUMNS = 12


def read_table(path: Path) -> Array:
    """Return the numbers of a text file (rows, columns). Raises InputError when it has none."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter('ignore', UserWarning)
            table = np.loadtxt(path, ndmin=2)
    except OSError:
        raise InputError(f'{path}: cannot be read; is the path right?') from None
    except ValueError as error:
        raise InputError(f'{path}: not a table of numbers ({error})') from None
    if not table.size:
        raise InputError(f'{path}: is empty')
    return table


def read_trajectory(path: Path) -> tuple[Array, Array]:
    """Return times (N,) in seconds and poses (N, 4, 4) of a TUM or KITTI file.

    KITTI poses take their times from times.txt in the same folder. Raises InputError.
    """
    table = read_table(path)
    if not np.isfinite(table).all():
        raise InputError(f'{path}: has values that are not finite')
    if table.shape[1] == TUM_COLUMNS:
        return _from_tum(table, path)
    if table.shape[1] == KITTI_COLUMNS:
        return _times_beside(path, len(table)), _from_kitti(table)
    raise InputError(
        f'{path}: has {table.shape[1]} columns; a TUM trajectory has 8 (t x y z qx qy qz qw), '
        'KITTI poses have 12'
    )


def _from_tum(table: Array, path: Path) -> tuple[Array, Array]:
    times = table[:, 0]
    if (np.diff(times) <= 0).any():
        raise InputError(f'{path}: time stamps must increase from row to row')
    norms = np.linalg.norm(table[:, 4:], axis=1)
    if (np.abs(norms - 1) > 1e-2).any():
        row = int(np.argmax(np.abs(norms - 1))) + 1
        raise InputError(f'{path}, row {row}: the quaternion is not of unit length')
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(table[:, 4:]).as_matrix()
    poses[:, :3, 3] = table[:, 1:4]
    return times, poses


def _from_kitti(table: Array) -> Array:
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3] = table.reshape(-1, 3, 4)
    return poses


def _times_beside(path: Path, count: int) -> Array:
    file = path.parent / 'times.txt'
    times = read_table(file)[:, 0]
    if len(times) < count:
        raise InputError(f'{file}: has {len(times)} times for {count} poses in {path.name}')
    return times[:count]
