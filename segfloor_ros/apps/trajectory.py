"""Trajectories: poses of tracked frames, corrected by the final keyframes, in the TUM text
format.

Trajectory files: TUM rows `t x y z qx qy qz qw` and KITTI rows of a 3x4 matrix with times.txt
beside them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.core.contracts import KeyframePath
from segfloor_ros.core.errors import InputError
from segfloor_ros.core.files.whole import digits_of, read_lines, read_table
from segfloor_ros.core.geometry import Array, invert
from segfloor_ros.core.quaternions import quaternion_xyzw, rotations_of

TUM_COLUMNS = ['t', 'x', 'y', 'z', 'qx', 'qy', 'qz', 'qw']
FARTHEST = 1e10
"""Times in seconds and positions in metres are not beyond this."""


@dataclass(frozen=True)
class Trajectory:
    """Stamps (N,) int64 in ns, ascending, and poses (N, 4, 4)."""

    stamp_ns: NDArray[np.int64]
    poses: Array

    def seen_from(self, T_a_b: Array) -> Trajectory:
        """Return the motion of a frame b that is fixed at T_a_b on the moving frame a, in b's
        first pose's frame when a starts at identity.
        """
        return Trajectory(self.stamp_ns, invert(T_a_b) @ self.poses @ T_a_b)


@dataclass(frozen=True)
class TrackedPose:
    """One tracked frame: its stamp, the base in frame `odom` (4, 4), the keyframe it was
    tracked against, and the base in frame `map` as it was then.
    """

    stamp_ns: int
    T_odom_base: Array
    reference_keyframe_ns: int
    T_map_base: Array | None = None


def corrected_trajectory(poses: Sequence[TrackedPose], path: KeyframePath) -> Trajectory:
    """Return the tracked frames in frame `map`, moved with the final pose of their reference
    keyframe.

    T_map_base = T_map_keyframe(final) · T_odom_keyframe⁻¹ · T_odom_base, as the motion since the
    keyframe is what tracking measured. A frame whose keyframe is not in the path goes with the
    latest keyframe before it.
    """
    odom_at = {pose.stamp_ns: pose.T_odom_base for pose in poses}
    final_at = dict(zip(path.stamp_ns.tolist(), path.T_map_base, strict=True))
    anchors = np.array([stamp for stamp in final_at if stamp in odom_at], np.int64)
    stamps, corrected = [], []
    for pose in poses:
        reference = pose.reference_keyframe_ns
        if reference not in final_at or reference not in odom_at:
            earlier = anchors[anchors <= pose.stamp_ns]
            if len(earlier) == 0:
                # No keyframe of this drive yet: the map was loaded, and stayed as it was.
                if pose.T_map_base is not None:
                    stamps.append(pose.stamp_ns)
                    corrected.append(pose.T_map_base)
                continue
            reference = int(earlier[-1])
        motion = invert(odom_at[reference]) @ pose.T_odom_base
        stamps.append(pose.stamp_ns)
        corrected.append(final_at[reference] @ motion)
    return Trajectory(np.array(stamps, np.int64), np.array(corrected).reshape(-1, 4, 4))


def write_tum(path: Path, trajectory: Trajectory, comments: Iterable[str] = ()) -> None:
    """Write `t x y z qx qy qz qw` lines, seconds and metres (the format of the TUM RGB-D
    benchmark), after comments (`#`).
    """
    lines = [f'# {comment}\n' for comment in comments]
    for stamp_ns, pose in zip(trajectory.stamp_ns.tolist(), trajectory.poses, strict=True):
        seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
        values = np.concatenate([pose[:3, 3], quaternion_xyzw(pose[:3, :3])])
        numbers = ' '.join(f'{value:.9f}' for value in values.round(9) + 0.0)
        lines.append(f'{seconds}.{nanoseconds:09d} {numbers}\n')
    path.write_text(''.join(lines))


def read_trajectory(path: Path, may_be_empty: bool = False) -> tuple[Array, Array]:
    """Return times (N,) in seconds and poses (N, 4, 4) of a TUM or KITTI file, whose times may have
    another unit (`digits_of`).

    KITTI poses take their times from times.txt in the same folder. may_be_empty: N may be 0, as of
    the keyframes of a run that only localised. Raises InputError.
    """
    if may_be_empty and next(read_lines(path), None) is None:
        return np.empty(0), np.empty((0, 4, 4))
    table = read_table(path)
    if table.shape[1] == len(TUM_COLUMNS):
        table[:, 0] /= _units_in_a_second(path)
        return _checked(*_from_tum(table, path), path)
    if table.shape[1] == 3 * 4:
        return _checked(_times_beside(path, len(table)), _from_kitti(table, path), path)
    raise InputError(
        f'{path}: has {table.shape[1]} columns; a TUM trajectory has 8 (t x y z qx qy qz qw), '
        'KITTI poses have 12'
    )


def _units_in_a_second(path: Path) -> float:
    return 10.0 ** digits_of((line.split()[0] for _, line in read_lines(path)), str(path))


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
    poses[:, :3, :3] = rotations_of(table[:, 4:])
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
    times = read_table(file)[:, 0] / _units_in_a_second(file)
    if len(times) < count:
        raise InputError(f'{file}: has {len(times)} times for {count} poses in {path.name}')
    return times[:count]
