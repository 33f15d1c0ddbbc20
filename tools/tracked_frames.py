"""SLAM alone over frames in memory: what it publishes, and what stands at the end."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.apps.trajectory import TrackedPose, corrected_trajectory
from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.camera.recording import RecordedSensor
from segfloor_ros.core.configuration import Configuration
from segfloor_ros.core.contracts import FrameResult, Keyframe, KeyframePath, Mount, StereoFrame
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.plugins.assembly import make_slam
from segfloor_ros.core.slam.drift import DriftMeter
from segfloor_ros.core.slam.held_results import left_out
from segfloor_ros.core.slam.stereo_slam import CAMERA_AS_BASE
from tools.driving import after_sensors, drive

NO_IMAGES: dict[str, Any] = dict.fromkeys(('left', 'right'), np.zeros((0, 0), np.uint8))

UNCERTAIN = 'uncertain'
"""In the state of a frame whose place is weak."""


@dataclasses.dataclass(frozen=True)
class TrackedFrames:
    """SLAM over N frames. results: of each frame, as it was published last, without keyframes;
    frames that are in no map at the end are not tracked. drift: (N, 6, 13), of odom (see
    `core.slam.drift`). T_map_left: (N, 4, 4), the rectified left camera, every frame carried along
    by its keyframe's final pose; NaN where it is not tracked. seconds: CPU time of the calling
    thread.
    """

    results: list[FrameResult]
    drift: Array
    T_map_left: Array
    mount: Mount
    keyframes: int
    seconds: float

    @property
    def is_tracked(self) -> NDArray[np.bool_]:
        """Which frames (N,) have a pose."""
        return np.asarray(np.isfinite(self.T_map_left[:, 0, 0]))

    @property
    def weak(self) -> int:
        """How many frames have a pose of which SLAM itself says that it is weak: uncertain, or by
        sensors alone.
        """
        return sum(r.tracked and (r.blind or UNCERTAIN in r.state) for r in self.results)

    @property
    def lost(self) -> int:
        """How many frames were not even mapped in a submap that was left out."""
        return sum(not (r.tracked or r.in_submap) for r in self.results)


def track_frames(
    camera: StereoCamera,
    frames: Sequence[StereoFrame],
    sensors: Sequence[RecordedSensor],
    configuration: Configuration,
    with_mount: bool = True,
    on_progress: Callable[[int], None] = lambda _: None,
) -> TrackedFrames:
    """Run SLAM over frames. with_mount: results have the axes of the mount, as those of
    `segfloor run`; else the camera is the base, as with --no-map, and where no floor shows it.
    """
    settings = configuration.stereo_slam
    mount = None if with_mount or settings.has_mount else CAMERA_AS_BASE
    slam = make_slam(camera, settings, mount)
    results: list[FrameResult] = []
    keyframes: dict[int, Keyframe] = {}
    path = KeyframePath(np.zeros(0, np.int64), np.zeros((0, 4, 4)))
    start_s = time.thread_time()

    def note(published: Sequence[FrameResult]) -> None:
        nonlocal path
        for result in published:
            if result.keyframe is not None:
                path = result.keyframe.path
                keyframes[result.stamp_ns] = dataclasses.replace(result.keyframe, **NO_IMAGES)
            while results and results[-1].index >= result.index:  # they come once more
                results.pop()
            results.append(dataclasses.replace(result, keyframe=None, moving=None))

    with contextlib.closing(slam):
        for step in drive(slam, after_sensors(slam, sensors, frames), on_progress):
            note(step.results)
        if slam.mount is None:
            slam.rig.base = CAMERA_AS_BASE
        note(slam.finish())
    assert slam.mount is not None
    began_ns = path.stamp_ns[0] if len(path.stamp_ns) else 0
    results = [left_out(r) if r.tracked and r.stamp_ns < began_ns else r for r in results]
    meter, drift = DriftMeter(camera), []
    meter.T_base_left = slam.mount.T_base_left
    for result in results:
        meter.see(result, keyframes.get(result.stamp_ns))
        drift.append(meter.drift)
    return TrackedFrames(
        results,
        np.array(drift),
        _corrected(frames, results, path) @ slam.mount.T_base_left,
        slam.mount,
        len(path.stamp_ns),
        time.thread_time() - start_s,
    )


def _corrected(
    frames: Sequence[StereoFrame], results: Sequence[FrameResult], path: KeyframePath
) -> Array:
    """Return the base (N, 4, 4) in `map` by the final keyframes, NaN where it is not tracked."""
    poses = [
        TrackedPose(
            r.stamp_ns, r.T_odom_base, r.reference_keyframe_ns, r.T_map_odom @ r.T_odom_base
        )
        for r in results
        if r.tracked
    ]
    trajectory = corrected_trajectory(poses, path)
    at = dict(zip(trajectory.stamp_ns.tolist(), trajectory.poses, strict=True))
    nothing = np.full((4, 4), np.nan)
    return np.array([at.get(frame.stamp_ns, nothing) for frame in frames])
