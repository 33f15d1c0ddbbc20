"""SLAM alone over drives whose path is known: how far off it is, and what a frame costs."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from segfloor_ros.apps.evaluation.trajectory import TrajectoryScore, match, score_trajectory
from segfloor_ros.apps.trajectory import (
    TrackedPose,
    Trajectory,
    corrected_trajectory,
    read_trajectory,
)
from segfloor_ros.core.configuration import Configuration
from segfloor_ros.core.contracts import KeyframePath
from segfloor_ros.core.errors import MapError
from segfloor_ros.core.geometry import Array, invert
from segfloor_ros.core.plugins.assembly import make_slam
from segfloor_ros.core.timing import StageTimes
from tools.driving import after_sensors, drive, noisy, open_recording

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


@dataclasses.dataclass(frozen=True)
class TrackedDrive:
    """A drive as SLAM tracked it. trajectory: the left camera. frames: how many of `total` were
    tracked.
    """

    trajectory: Trajectory
    frames: int
    total: int
    keyframes: int
    points: int
    stages: Mapping[str, Mapping[str, float]]

    def score(self, recording: Path) -> TrajectoryScore:
        """Return the score against the true path of a recording, poses.txt."""
        truth = read_trajectory(recording / 'poses.txt')
        return score_trajectory(match(_timed(self.trajectory), truth, self.total))

    def end_error_m(self, end_m: Array) -> float:
        """Return how far the last pose is from where the camera ended, (3,) from the first."""
        first, last = self.trajectory.poses[[0, -1]]
        return float(np.linalg.norm((invert(first) @ last)[:3, 3] - end_m))


def track(
    recording: Path,
    configuration: Configuration,
    noise: int = 0,
    on_progress: Callable[[int], None] = lambda _: None,
) -> TrackedDrive:
    """Track a recording with its sensors, every frame carried along by its keyframe's final pose.
    noise: seed of noise added to the images. on_progress is told the number of frames done.

    Raises MapError when fewer than two keyframes came.
    """
    source, times = open_recording(recording, configuration), StageTimes()
    slam = make_slam(source.camera, configuration.stereo_slam, times=times)
    poses: list[TrackedPose] = []
    path: KeyframePath | None = None
    total = 0
    with contextlib.closing(slam):
        frames = after_sensors(slam, source.sensors, noisy(source.frames(), noise))
        for step in drive(slam, frames, on_progress):
            total += 1
            for result in step.results:
                while poses and poses[-1].stamp_ns >= result.stamp_ns:  # they come once more
                    poses.pop()
                if result.tracked:
                    pose = TrackedPose(
                        result.stamp_ns, result.T_odom_base, result.reference_keyframe_ns
                    )
                    poses.append(pose)
                path = result.keyframe.path if result.keyframe is not None else path
    if path is None or slam.mount is None or len(path.stamp_ns) < 2:
        raise MapError(f'{recording.name}: no path came of {total} frames')
    trajectory = corrected_trajectory(poses, path).seen_from(slam.mount.T_base_left)
    points = int(slam.map.alive.sum())
    return TrackedDrive(trajectory, len(poses), total, len(path.stamp_ns), points, times.summary())


def measure_drive(
    name: str, recording: Path, configuration: Configuration, on_progress: Callable[[int], None]
) -> DriveResult:
    """Track a recording with a true path (poses.txt) and score the camera's path.

    Raises InputError for a recording without truth, MapError when fewer than two keyframes came.
    """
    read_trajectory(recording / 'poses.txt')
    tracked = track(recording, configuration, on_progress=on_progress)
    return DriveResult(name, tracked.score(recording), tracked.keyframes, tracked.stages)


def _timed(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    return 1e-9 * trajectory.stamp_ns, trajectory.poses
