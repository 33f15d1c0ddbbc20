"""The whole pipeline in lockstep on a recording that is driven to and fro for hours: whether map,
memory, time and error stay what they are.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from segfloor_ros.apps.recordings import StereoSource
from segfloor_ros.core.contracts import FrameResult
from segfloor_ros.core.errors import MapError
from segfloor_ros.core.geometry import Array, invert
from segfloor_ros.core.memory import rss_mb
from segfloor_ros.core.pipeline import Pipeline
from tools.driving import drive
from tools.endless_drive import place_of

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


class Soak:
    """Drives an endless drive (see `endless_drive`) of a recording.

    truth: (N, 4, 4) of the left camera in its first pose, for each frame of the recording.
    """

    def __init__(self, pipeline: Pipeline, recording: StereoSource, truth: Array) -> None:
        self._recording = recording
        self._pipeline = pipeline
        self._truth = truth
        self._seconds: list[float] = []
        self._errors_m: list[float] = []
        self._frames, self._tracked = 0, 0

    def run(self, on_progress: Callable[[int], None]) -> list[SoakPart]:
        """Return the parts in order. Raises MapError when there is no map."""
        parts: list[SoakPart] = []
        length = max((self._recording.frame_count or 0) // PARTS, 1)
        with contextlib.closing(self._pipeline):
            for step in drive(self._pipeline, self._recording.frames(), on_progress):
                self._seconds.append(step.cpu_s)
                self._frames += 1
                self._note(step.results)
                if self._frames % length == 0:
                    parts.append(self._end_part(step.frame.stamp_ns))
            if self._pipeline.finish() is None:
                raise MapError(f'{self._recording.name}: no map came of {self._frames} frames')
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
