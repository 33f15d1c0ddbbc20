"""Driving stages through recordings: of the command line, or of scenes rendered for it."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from segfloor_ros.apps.cli.terminal import Announce
from segfloor_ros.apps.recordings import StereoSource, open_source
from segfloor_ros.apps.simulation.scene_file import open_scene
from segfloor_ros.apps.simulation.simulation import render_once
from segfloor_ros.core.camera.model import is_disparity
from segfloor_ros.core.camera.recording import MeasurementLog, RecordedSensor
from segfloor_ros.core.configuration import Configuration
from segfloor_ros.core.contracts import FrameResult, StereoFrame
from segfloor_ros.core.slam.stereo_slam import StereoSlam


class Stages(Protocol):
    """What is driven: SLAM alone, all stages on one thread, or the pipeline."""

    def process(self, frame: StereoFrame) -> Sequence[FrameResult]:
        """Take in the next frame."""


@dataclasses.dataclass(frozen=True)
class Step:
    """A frame, what came of it, and the CPU time of the calling thread."""

    frame: StereoFrame
    results: Sequence[FrameResult]
    cpu_s: float


def drive(
    stages: Stages, frames: Iterable[StereoFrame], on_progress: Callable[[int], None]
) -> Iterator[Step]:
    """Put frames through the stages, one step after the other."""
    for done, frame in enumerate(frames, start=1):
        start_s = time.thread_time()
        results = stages.process(frame)
        yield Step(frame, results, time.thread_time() - start_s)
        on_progress(done)


def after_sensors(
    slam: StereoSlam, sensors: Sequence[RecordedSensor], frames: Iterable[StereoFrame]
) -> Iterator[StereoFrame]:
    """Yield frames, each once SLAM has what sensors measured up to it."""
    log = MeasurementLog(sensors)
    for frame in frames:
        for measurement in log.until(frame.stamp_ns + slam.sensors.lag_ns):
            slam.add(measurement)
        yield frame


def noisy(frames: Iterable[StereoFrame], seed: int) -> Iterator[StereoFrame]:
    """Yield frames with noise of one grey level added to images, by a seed; 0: as they are."""
    rng = np.random.default_rng(seed)

    def spoiled(image: NDArray[Any]) -> NDArray[Any]:
        if is_disparity(image):
            return image
        return np.clip(np.rint(image + rng.normal(0, 1, image.shape)), 0, 255).astype(np.uint8)

    for frame in frames:
        if seed:
            left, right = spoiled(frame.left), spoiled(frame.right)
            frame = dataclasses.replace(frame, left=left, right=right)
        yield frame


def open_recording(recording: str | Path, configuration: Configuration) -> StereoSource:
    """Open a recording with the camera's settings."""
    return open_source(dataclasses.replace(configuration.stereo_camera, input=str(recording)))


def recordings(name: str, seeds: int, folder: Path, announce: Announce) -> list[tuple[str, Path]]:
    """Return names and folders: a recording with poses.txt itself, or the scene of that name,
    rendered once for each seed (1, 2, ...) and kept in `folder`.
    """
    if (Path(name) / 'poses.txt').is_file():
        return [(Path(name).name, Path(name))]
    scene, found = open_scene(name), []
    for seed in range(1, seeds + 1):
        drive_name = f'{Path(name).stem}-{seed}'
        recording = folder / drive_name
        on_start = partial(announce, f'rendering {drive_name}')
        render_once(dataclasses.replace(scene, seed=seed), recording, on_start=on_start)
        found.append((drive_name, recording))
    return found
