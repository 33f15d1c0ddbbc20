"""What each step of the stages takes: `segfloor benchmark`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice

import cv2

from segfloor_ros.apps.recordings import StereoSource
from segfloor_ros.core.camera.model import StereoCamera
from segfloor_ros.core.configuration import Configuration
from segfloor_ros.core.contracts import FrameResult, Mount, StereoFrame
from segfloor_ros.core.grid.occupancy import OccupancyGrid
from segfloor_ros.core.plugins.assembly import make_slam, make_stages
from segfloor_ros.core.timing import Profile, StageTimes

MAP = 'map'
"""The stage of drawing the whole map, which the pipeline does once, at the end."""


@dataclass(frozen=True)
class Step:
    """What a step of a stage took. path: its name, those of what it is a step of before. ms: the
    time computed by each of the calls. share: of the time of all stages.
    """

    path: tuple[str, ...]
    calls: int
    ms: float
    share: float


def profile_recording(
    source: StereoSource,
    frames: int,
    threads: int,
    configuration: Configuration,
    on_progress: Callable[[int], None],
) -> list[Step]:
    """Put the first frames of a recording through all stages, by its images alone, and return what
    each step took, outermost first. threads: of OpenCV.
    """
    cv2.setNumThreads(threads)
    profile, stages = Profile(), StageChain(source.camera, configuration)
    for frame in islice(source.frames(), frames):
        with profile.recording():
            stages.process(frame)
        on_progress(stages.frames)
    whole_s = sum(seconds for path, (_, seconds) in profile.steps.items() if len(path) == 1)
    came = {path: order for order, path in enumerate(profile.steps)}
    return [
        Step(path, calls, round(1e3 * seconds / calls, 3), round(seconds / whole_s, 4))
        for path, (calls, seconds) in sorted(
            profile.steps.items(),
            key=lambda step: [came[step[0][:length]] for length in range(1, len(step[0]) + 1)],
        )
    ]


class StageChain:
    """All stages one after the other on one thread, with a map at every keyframe, so that no stage
    waits for another one. mount: where the camera sits, None where the settings say or it is to be
    measured.
    """

    def __init__(
        self,
        camera: StereoCamera,
        configuration: Configuration,
        times: StageTimes | None = None,
        mount: Mount | None = None,
    ) -> None:
        self._times = StageTimes() if times is None else times
        self.grid: OccupancyGrid | None = None
        self.frames = 0
        self.stages = make_stages(camera, configuration, self._times)
        self._slam = make_slam(camera, configuration.stereo_slam, mount, self._times)

    def process(self, frame: StereoFrame) -> list[FrameResult]:
        """Take in the next frame; returns the tracking results that are ready, oldest first."""
        self.frames += 1
        results = self._slam.process(frame)
        for keyframe in [r.keyframe for r in results if r.keyframe is not None]:
            assert self._slam.mount is not None
            self.stages.process(keyframe, self._slam.mount)
            self.draw(len(keyframe.cloud.point_id))
        return results

    def draw(self, points: int) -> None:
        """Draw the map: the grid folds new evidence in when it is asked for. points: of the cloud,
        for who counts them.
        """
        with self._times.measure(MAP):
            self.grid = self.stages.grid()

    def close(self) -> None:
        """End what runs beside."""
        self._slam.close()
