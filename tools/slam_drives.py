"""SLAM alone over drives whose path is known: how far off it is, and what a frame costs."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from segfloor_ros.configuration import Configuration
from segfloor_ros.errors import MapError
from segfloor_ros.evaluation.trajectory import TrajectoryScore, match, score_trajectory
from segfloor_ros.evaluation.trajectory_files import read_trajectory
from segfloor_ros.slam.results import KeyframePath
from segfloor_ros.stages import make_slam
from segfloor_ros.timing import StageTimes
from segfloor_ros.trajectory import TrackedPose, Trajectory, corrected_trajectory
from tools.driving import drive, open_recording

DRIVES = ('corridor1', 'corridor2', 'ramp', 'rolling', 'exposure_difference')
"""Shipped scenes: weak texture, a narrow corridor, a slope, a shaking and an uneven camera."""


@dataclasses.dataclass(frozen=True)
class DriveResult:
    """One drive: its score, the number of keyframes, and the time of the stages `tracking` (every
    frame) and `mapping` (every keyframe) as in summary.json.
    """

    name: str
    score: TrajectoryScore
    keyframes: int
    stages: Mapping[str, Mapping[str, float]]


def measure_drive(
    name: str, recording: Path, configuration: Configuration, on_progress: Callable[[int], None]
) -> DriveResult:
    """Track a recording with a true path (poses.txt) and score the camera's path, every frame
    carried along by its keyframe's final pose. on_progress is told the number of frames done.

    Raises InputError for a recording without truth, MapError when fewer than two keyframes came.
    """
    truth = read_trajectory(recording / 'poses.txt')
    source, times = open_recording(recording, configuration), StageTimes()
    slam = make_slam(source.camera, configuration.stereo_slam, times=times)
    poses: list[TrackedPose] = []
    path: KeyframePath | None = None
    frames = 0
    with contextlib.closing(slam):
        for step in drive(slam, source.frames(), on_progress):
            frames += 1
            for result in step.results:
                if result.tracked:
                    pose = TrackedPose(
                        result.stamp_ns, result.T_odom_base, result.reference_keyframe_ns
                    )
                    poses.append(pose)
                path = result.keyframe.path if result.keyframe is not None else path
    if path is None or slam.mount is None or len(path.stamp_ns) < 2:
        raise MapError(f'{name}: no path came of {frames} frames')
    tracked = corrected_trajectory(poses, path).seen_from(slam.mount.T_base_left)
    score = score_trajectory(match(_timed(tracked), truth, frames))
    return DriveResult(name, score, len(path.stamp_ns), times.summary())


def _timed(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    return 1e-9 * trajectory.stamp_ns, trajectory.poses
