"""Trajectory files: TUM rows `t x y z qx qy qz qw` and KITTI rows of a 3x4 matrix with times.txt
beside them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from segfloor_ros.errors import InputError
from segfloor_ros.files.tables import read_table
from segfloor_ros.geometry import Array

TUM_COLUMNS = 8
KITTI_COLUMNS = 12
FARTHEST = 1e10
"""Times in seconds and positions in metres are not beyond this."""


def read_trajectory(path: Path) -> tuple[Array, Array]:
    """Return times (N,) in seconds and poses (N, 4, 4) of a TUM or KITTI file.

    KITTI poses take their times from times.txt in the same folder. Raises InputError.
    """
    table = read_table(path)
    if table.shape[1] == TUM_COLUMNS:
        return _checked(*_from_tum(table, path), path)
    if table.shape[1] == KITTI_COLUMNS:
        return _checked(_times_beside(path, len(table)), _from_kitti(table, path), path)
    raise InputError(
        f'{path}: has {table.shape[1]} columns; a TUM trajectory has 8 (t x y z qx qy qz qw), '
        'KITTI poses have 12'
    )


def _checked(times: Array, poses: Array, path: Path) -> tuple[Array, Array]:
    for name, values in (('times', times), ('positions', poses[:, :3, 3])):
        if np.abs(values).max() > FARTHEST:
            raise InputError(f'{path}: has {name} up to {np.abs(values).max():.3g}')
    if (np.diff(times) <= 0).any():
        raise InputError(f'{path}: time stamps must increase from row to row')
    return times, poses


def _from_tum(table: Array, path: Path) -> tuple[Array, Array]:
    times = table[:, 0]
    norms = np.linalg.norm(table[:, 4:], axis=1)
    if (np.abs(norms - 1) > 1e-2).any():
        row = int(np.argmax(np.abs(norms - 1))) + 1
        raise InputError(f'{path}, row {row}: the quaternion is not of unit length')
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(table[:, 4:]).as_matrix()
    poses[:, :3, 3] = table[:, 1:4]
    return times, poses


def _from_kitti(table: Array, path: Path) -> Array:
    poses = np.tile(np.eye(4), (len(table), 1, 1))
    poses[:, :3] = table.reshape(-1, 3, 4)
    R = np.clip(poses[:, :3, :3], -2.0, 2.0)
    error = np.abs(R @ R.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
    if (error > 1e-2).any():
        raise InputError(f'{path}, row {np.argmax(error) + 1}: holds no rotation')
    return poses


def _times_beside(path: Path, count: int) -> Array:
    file = path.parent / 'times.txt'
    times = read_table(file)[:, 0]
    if len(times) < count:
        raise InputError(f'{file}: has {len(times)} times for {count} poses in {path.name}')
    return times[:count]
