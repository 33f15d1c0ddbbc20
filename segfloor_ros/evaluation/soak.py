"""The whole pipeline in lockstep on a recording that is driven to and fro for hours: whether map,
memory, time and error stay what they are.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from segfloor_ros.camera.model import Mount, StereoFrame
from segfloor_ros.camera.sources import StereoSource
from segfloor_ros.errors import MapError
from segfloor_ros.evaluation.endless_drive import place_of
from segfloor_ros.geometry import Array, invert
from segfloor_ros.memory import rss_mb
from segfloor_ros.slam.results import FrameResult
from segfloor_ros.slam.stereo_slam import StereoSlam

PARTS = 8


@dataclasses.dataclass(frozen=True)
class SoakPart:
    """One part of a soak, as it ended: recording time, frames and how many of them were tracked,
    keyframes ever made, of these with features in the map, points, CPU time of a frame in the
    tracking thread (median and 95th percentile over the part), RMSE of the camera's position (no
    alignment), resident memory.
    """

    minutes: float
    frames: int
    tracked: int
    keyframes: int
    views: int
    points: int
    frame_ms: tuple[float, float]
    error_m: float
    rss_mb: float


class Stages(Protocol):
    """What is soaked: the pipeline in lockstep."""

    slam: StereoSlam

    @property
    def mount(self) -> Mount | None:
        """Where the camera sits on the base, once it is known."""

    def process(self, frame: StereoFrame) -> list[FrameResult]:
        """Take in the next frame."""

    def finish(self) -> object | None:
        """Return the map, or None when there is none."""

    def close(self) -> None:
        """Drop what is pending."""


class Soak:
    """Drives an endless drive (see `endless_drive`) of a recording.

    truth: (N, 4, 4) of the left camera in its first pose, for each frame of the recording.
    """

    def __init__(self, pipeline: Stages, drive: StereoSource, truth: Array) -> None:
        self._drive = drive
        self._pipeline = pipeline
        self._truth = truth
        self._seconds: list[float] = []
        self._errors_m: list[float] = []
        self._frames, self._tracked = 0, 0

    def run(self, on_progress: Callable[[int], None]) -> list[SoakPart]:
        """Return the parts in order. Raises MapError when there is no map."""
        parts: list[SoakPart] = []
        length = max((self._drive.frame_count or 0) // PARTS, 1)
        try:
            for frame in self._drive.frames():
                start = time.thread_time()
                results = self._pipeline.process(frame)
                self._seconds.append(time.thread_time() - start)
                self._frames += 1
                self._note(results)
                on_progress(self._frames)
                if self._frames % length == 0:
                    parts.append(self._end_part(frame.stamp_ns))
            if self._pipeline.finish() is None:
                raise MapError(f'{self._drive.name}: no map came of {self._frames} frames')
        finally:
            self._pipeline.close()
        return parts

    def _note(self, results: Sequence[FrameResult]) -> None:
        for result in results:
            self._tracked += result.tracked
            mount = self._pipeline.mount
            if mount is None:
                continue
            T_map_base, T_base_left = result.T_map_odom @ result.T_odom_base, mount.T_base_left
            found = invert(T_base_left) @ T_map_base @ T_base_left
            true = self._truth[place_of(result.index, len(self._truth))]
            self._errors_m.append(float(np.linalg.norm(found[:3, 3] - true[:3, 3])))

    def _end_part(self, stamp_ns: int) -> SoakPart:
        sparse_map = self._pipeline.slam.map
        middle, high = 1e3 * np.percentile(self._seconds, (50, 95))
        error_m = np.sqrt(np.mean(np.square(self._errors_m))) if self._errors_m else np.nan
        part = SoakPart(
            stamp_ns / 60e9,
            self._frames,
            self._tracked,
            len(sparse_map.keyframes),
            sum(keyframe.retired is None for keyframe in sparse_map.keyframes),
            int(sparse_map.alive.sum()),
            (float(middle), float(high)),
            float(error_m),
            rss_mb(),
        )
        self._seconds, self._errors_m = [], []
        return part
