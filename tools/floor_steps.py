"""What each step of floor segmentation costs, keyframe by keyframe."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from segfloor_ros.apps.cli.terminal import Announce
from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.configuration import Configuration
from segfloor_ros.core.contracts import Mount
from segfloor_ros.core.errors import MapError
from segfloor_ros.core.floor.segmentation import DISPARITY, DISPARITY_ABOVE, FloorSegmentation
from segfloor_ros.core.geometry import Array
from segfloor_ros.core.plugins.assembly import make_slam
from segfloor_ros.core.timing import StageTimes
from tools.benchmark_stages import CAMERA, DRIVE, MOUNT, CorridorImages
from tools.driving import drive, open_recording

WHOLE, WITHOUT_DISPARITY = 'all', 'all but disparity'
WARM_UP = 2
"""The first keyframes pay for tables and memory."""


@dataclass(frozen=True)
class FloorInput:
    """What floor segmentation gets of one keyframe: a rectified pair (H, W) uint8, the mount, and
    the base's pose (4, 4) in the map.
    """

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    mount: Mount
    T_map_base: Array


@dataclass(frozen=True)
class FloorTimes:
    """name: of the recording. camera: its own. steps: by name p50_ms and p95_ms over the keyframes,
    the last two being `WITHOUT_DISPARITY` and `WHOLE`; share: of the time of all keyframes.
    """

    name: str
    camera: StereoCamera
    keyframes: int
    steps: dict[str, dict[str, float]]


def generated_drive(frames: int, seed: int) -> Iterator[FloorInput]:
    """Yield a drive through a corridor without SLAM: its poses are known."""
    for frame in CorridorImages(frames, seed).drive():
        T_map_base = np.eye(4)
        T_map_base[0, 3] = frame.index * DRIVE.step_m
        yield FloorInput(frame.left, frame.right, MOUNT, T_map_base)


def keyframes_of(
    recording: str, configuration: Configuration, announce: Announce
) -> tuple[StereoCamera, Iterator[FloorInput]]:
    """Return the camera of a recording, and its keyframes as SLAM makes them."""
    source = open_recording(recording, configuration)

    def keyframes() -> Iterator[FloorInput]:
        report = announce(f'segmenting {recording}', source.frame_count or 0)
        with contextlib.closing(make_slam(source.camera, configuration.stereo_slam)) as slam:
            for step in drive(slam, source.frames(), report):
                for key in (r.keyframe for r in step.results if r.keyframe is not None):
                    assert slam.mount is not None
                    yield FloorInput(key.left, key.right, slam.mount, key.T_map_base)

    return source.camera, keyframes()


def generated_keyframes(frames: int, seed: int) -> tuple[StereoCamera, Iterator[FloorInput]]:
    """Return the camera of the generated drive and its frames, all of them keyframes."""
    return CAMERA, generated_drive(frames, seed)


def time_steps(
    name: str,
    camera: StereoCamera,
    keyframes: Iterator[FloorInput],
    configuration: Configuration,
    threads: int,
) -> FloorTimes:
    """Segment the keyframes and time every step: with one thread of OpenCV the time that is spent
    computing, with more the time that passes. Raises MapError where there are too few.
    """
    cv2.setNumThreads(threads)
    times = StageTimes(time.thread_time if threads == 1 else time.perf_counter)
    count, settings = 0, configuration.floor_segmentation
    stage = FloorSegmentation(camera, settings, times)
    for count, key in enumerate(keyframes, start=1):
        if count == WARM_UP + 1:
            times.clear()
        with times.measure(WHOLE):
            stage.process(key.left, key.right, key.mount, key.T_map_base)
    if count <= WARM_UP:
        raise MapError(f'{name}: {count} keyframes are too few to time')
    return FloorTimes(name, camera, count - WARM_UP, _figures(times))


def _figures(times: StageTimes) -> dict[str, dict[str, float]]:
    seconds = {step: np.array(durations) for step, durations in times.durations_s.items()}
    whole = seconds.pop(WHOLE)
    rest = whole - seconds[DISPARITY] - seconds[DISPARITY_ABOVE]
    seconds = {**seconds, WITHOUT_DISPARITY: rest, WHOLE: whole}
    return {
        step: {
            'p50_ms': 1e3 * float(np.median(values)),
            'p95_ms': 1e3 * float(np.percentile(values, 95)),
            'share': float(values.sum() / whole.sum()),
        }
        for step, values in seconds.items()
    }
