"""Trajectories: poses of tracked frames, corrected by the final keyframes, in the TUM text
format.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.geometry import Array, invert, quaternion_xyzw
from segfloor_ros.slam.results import KeyframePath


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


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write `t x y z qx qy qz qw` lines, seconds and metres (the format of the TUM RGB-D
    benchmark).
    """
    lines = []
    for stamp_ns, pose in zip(trajectory.stamp_ns.tolist(), trajectory.poses, strict=True):
        seconds, nanoseconds = divmod(stamp_ns, 1_000_000_000)
        values = np.concatenate([pose[:3, 3], quaternion_xyzw(pose[:3, :3])])
        numbers = ' '.join(f'{value:.9f}' for value in values.round(9) + 0.0)
        lines.append(f'{seconds}.{nanoseconds:09d} {numbers}\n')
    path.write_text(''.join(lines))
